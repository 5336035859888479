"""The record of a run: frames that were lost or left out, runs that never began, a path no longer than its error.

Each defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from corner_walk import Walk, walk
from reported import pattern

from vggtgeo.geometry import rigid
from vggtgeo.io.errors import LeftOutWarning
from vggtgeo.slam.global_map.pose_uncertainty import PoseUncertainty
from vggtgeo.slam.verdict.judge import check_extent, check_frozen, check_input, check_record, stated_share


def test_lost_frames_count_by_what_they_cost(healthy: Walk) -> None:
    """Two lost frames mark their segment; a tenth of them the run; most of them fail it; a second origin is told."""
    lose = lambda rows: replace(healthy.claim, tracked=~np.isin(np.arange(40), rows))
    assert [(f.start, f.end, f.local) for f in check_record(lose([7, 8]))] == [(7, 8, True)]
    assert [f.local for f in check_record(lose(np.arange(10, 16)))] == [True, False]
    assert "failed" in {f.level for f in check_record(lose(np.arange(8, 40)))}
    assert [f.check for f in check_record(replace(healthy.claim, submaps=2))] == ["submaps"]


def test_many_losses_are_one_sentence(healthy: Walk) -> None:
    """Every fourth frame lost, once two in a row: one reason; each loss marks its own segment. Oracle: the frames."""
    lost = np.arange(40) % 4 == 2
    lost[11] = True
    findings = check_record(replace(healthy.claim, tracked=~lost))
    (reason,) = [finding for finding in findings if not finding.local]
    assert all(re.search(pattern(number), reason.text) for number in (11, 40, 10))
    assert [(f.start, f.end) for f in findings if f.local] == [(n, n + (n == 10)) for n in range(2, 40, 4)]


def test_a_run_that_never_began_has_failed(healthy: Walk) -> None:
    """No map, or one tracked frame: failed."""
    never = replace(healthy.claim, tracked=np.arange(40) == 0)
    assert [f.level for f in check_record(never)] == ["failed"]
    assert [f.level for f in check_record(replace(healthy.claim, started=False))] == ["failed"]


def test_a_single_frame_is_no_run(healthy: Walk) -> None:
    """Nothing was compared with it, unless it was found in a map; two frames were."""
    first = lambda count: replace(
        healthy.claim,
        **{name: getattr(healthy.claim, name)[:count] for name in ("frames", "times", "poses", "tracked")},
    )
    assert [f.level for f in check_record(first(1))] == ["degraded"]
    assert not check_record(replace(first(1), began_in_known_map=True))
    assert not check_record(first(2))


def test_a_run_that_is_found_nowhere_in_a_map_says_so(healthy: Walk) -> None:
    """In a known map the reason is that no frame, or one alone, was found there; oracle: the sentence."""
    for found in (0, 1):
        claim = replace(healthy.claim, tracked=np.arange(40) < found, began_in_known_map=True)
        (finding,) = check_record(claim)
        assert finding.level == "failed"
        assert re.match(rf"{found} of 40\b", finding.text)


def test_a_camera_that_is_a_guess_is_reported(healthy: Walk) -> None:
    """An unknown camera of which too little was seen is a reason of its own; oracle: the claim."""
    assert [f.check for f in check_record(replace(healthy.claim, guessed=True))] == ["camera"]


@pytest.mark.parametrize(("still", "told"), [(False, True), (True, False)])
def test_pictures_that_are_shown_again_while_the_camera_moves(still: bool, told: bool) -> None:
    """Fifteen frames with the very same corners are reported where the camera moved before and after, and not where it
    was at rest anyway; corners at rest with the noise of new pictures are not the same. Oracle: what was planted.
    """
    here = walk(40)
    poses = np.tile(here.claim.poses[:1], (40, 1, 1)) if still else here.claim.poses.copy()
    poses[12:27] = poses[11]
    corners = list(here.evidence)
    corners[12:27] = [replace(here.evidence[11], frame=row) for row in range(12, 27)]
    claim = replace(here.claim, poses=poses)
    assert [one.check for one in check_frozen(claim, corners)] == ["frozen"] * told
    # Lost frames tell no speed, whatever their poses.
    lost = replace(claim, tracked=np.arange(40) < 27, poses=np.r_[poses[:27], np.tile(poses[26:27], (13, 1, 1))])
    assert [one.check for one in check_frozen(lost, corners)] == ["frozen"] * told
    rng = np.random.default_rng(0)
    moved = [
        replace(one, pixels=(one.pixels + 0.05 * rng.standard_normal(one.pixels.shape)).astype(np.float32))
        for one in corners
    ]
    assert check_frozen(claim, moved) == []


def test_frames_left_out_are_told() -> None:
    """A tenth of the frames left out by the reader is told, one of a hundred is not."""
    assert check_input([LeftOutWarning("unreadable"), "something else"], 99) == ()
    assert [f.level for f in check_input([LeftOutWarning("repeated", 30)], 30)] == ["degraded"]


def test_a_path_without_depth_and_shorter_than_its_error_is_told(healthy: Walk) -> None:
    """Of free scale, places that are known to two thirds of their spread are told, and those known to a third are not;
    with metres it is no matter of scale. Oracle: the spread of the walk's own path.
    """
    free = replace(healthy.claim, metric=False)
    spread = float(np.sqrt(rigid.centres(free.poses).var(0).sum()))
    sigma = np.where(np.arange(len(free)) % 3, np.nan, spread / 1.5)
    known = lambda places: stated_share(free, PoseUncertainty(free.times, places, np.zeros(len(free))))
    assert [f.check for f in check_extent(free, known(sigma))] == ["extent"]
    assert re.search(pattern("67"), check_extent(free, known(sigma))[0].text)
    assert check_extent(free, known(sigma / 2)) == []
    assert check_extent(free, stated_share(free, None)) == []
    assert check_extent(healthy.claim, known(sigma)) == []
