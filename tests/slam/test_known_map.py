"""Maps that outlast their run: saved, loaded, found again, extended, or left as they are."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_run import ROLES, SETTINGS
from reported import raises
from same_leaves import differences
from typer.testing import CliRunner
from vggtgeo.models.classical import OrbMatcher, SiftMatcher
from vggtgeo.models.roles import Features

import vggtgeo as vg
from vggtgeo.cli.main import make_app
from vggtgeo.datasets import without_depth
from vggtgeo.geometry import rigid
from vggtgeo.results.result import Result
from vggtgeo.simulation.sequence import write_tum_folder
from vggtgeo.slam.known_map import as_map, entered, save_map
from vggtgeo.slam.local_mapping import merge_pending_window
from vggtgeo.slam.state import Slam, submaps_by_size

FRAMES, HALF = 14, 7
FIXED = replace(SETTINGS, keyframes=replace(SETTINGS.keyframes, localise_only=True))


@cache
def sequence(seed: int = 0) -> Any:
    return vg.simulate("room", FRAMES, seed, (320, 240), rate=10.0)


def run(start: int = 0, end: int | None = None, seed: int = 0, **options: Any) -> Slam:
    """The last state of a run over some frames."""
    given = {"roles": ROLES, "settings": SETTINGS, **options}
    frames = sequence(seed) if given["roles"].metric else without_depth(sequence(seed))
    *_, slam = vg.run(frames, **given, start=start, end=end)
    return merge_pending_window(slam)


@cache
def first_half() -> Slam:
    return run(0, HALF)


@pytest.fixture
def known(tmp_path: Path) -> Slam:
    """The map of the first half, as it was read."""
    save_map(tmp_path / "room.map", first_half())
    return vg.load_map(tmp_path / "room.map")


def worst_error(slam: Slam) -> float:
    """Metres between the places of the frames and the true ones in the world of the first half."""
    truth = sequence().ground_truth().poses
    places = [rigid.invert(slam.pose(record))[:3, 3] for record in slam.frames if record.tracked]
    true = [(rigid.invert(truth[0]) @ truth[record.frame])[:3, 3] for record in slam.frames if record.tracked]
    return float(np.linalg.norm(np.array(places) - true, axis=1).max())


class Squared(SiftMatcher):
    """SIFT's key points with other vectors of the same length, as those of another network have."""

    def describe(self, image: np.ndarray) -> Features:
        found = super().describe(image)
        vectors = found.descriptors.vectors[:, ::-1] ** 4
        vectors = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        return replace(found, descriptors=replace(found.descriptors, vectors=vectors))


@pytest.mark.parametrize("points", [OrbMatcher(), Squared()])
def test_a_map_of_another_matcher_is_refused_at_once(known: Slam, points: Any) -> None:
    """Descriptors of another length, or of another meaning; oracle: the argument that the error names."""
    with raises("known_map"):
        next(vg.run(sequence(), replace(ROLES, points=points), SETTINGS, start=HALF, known_map=known))


def test_a_map_comes_back_to_the_bit(known: Slam) -> None:
    """All fields of the map, and none of the run; its keyframes are of frames before any run. Oracle: the state."""
    assert list(differences(as_map(first_half()), known)) == []
    assert (known.frames, known.window.members, known.window.solved, known.notes) == ((), (), None, ())
    count = len(first_half().keyframes)
    assert [keyframe.frame for keyframe in known.keyframes] == list(range(-count, 0))
    for before, after in zip(first_half().keyframes, known.keyframes, strict=True):
        moved = replace(before.compressed(), frame=after.frame, timestamp=after.timestamp, recorded=before.timestamp)
        assert list(differences(moved, after)) == []


def test_the_state_of_a_run_is_a_map(known: Slam) -> None:
    """A run goes on in the map of another that is still in memory, whose frames and clock are not its own: it yielded
    nothing before, as no time came after theirs. Oracle: the map that was saved and read.
    """
    camera = sequence().camera
    assert list(differences(entered(first_half(), camera, ROLES.points), entered(known, camera, ROLES.points))) == []
    with raises("known_map"):
        entered(known.with_map(keyframes=()), camera, ROLES.points)


def test_the_second_half_goes_on_in_the_map(known: Slam) -> None:
    """Frames that follow are found in the map and extend it: one submap, in its world; oracle: the truth."""
    slam = run(HALF, known_map=known)
    assert len(submaps_by_size(slam)) == 1
    assert [record.tracked for record in slam.frames] == [True] * (FRAMES - HALF)
    assert worst_error(slam) < 0.02
    assert len(slam.keyframes) > len(known.keyframes)
    assert f"frame {HALF} " in slam.notes[0]
    assert "is the first that was found in the map" in slam.notes[0]


def test_known_space_gets_no_second_keyframes(known: Slam) -> None:
    """The same frames again add none: the map grows with space; oracle: the number of keyframes, and the truth."""
    slam = run(0, HALF, known_map=known)
    assert len(slam.keyframes) == len(known.keyframes)
    assert all(record.tracked for record in slam.frames)
    assert worst_error(slam) < 0.02


def test_localising_leaves_the_map_as_it_is(known: Slam) -> None:
    """Frames are placed, and no keyframe, match, tie or camera changes, however far they lead; oracle: the map."""
    # Without factors, so that going from keyframe to keyframe would add them anew.
    known = known.with_map(factors=())
    slam = vg.finish(run(0, settings=FIXED, known_map=known), ROLES, FIXED)
    assert len({record.reference for record in slam.frames}) > 1
    assert list(differences(known.map, slam.map)) == []
    assert list(differences(known.intrinsics, slam.intrinsics)) == []
    assert np.mean([record.tracked for record in slam.frames]) > 0.5
    assert worst_error(slam) < 0.03


@pytest.mark.long
def test_a_whole_run_in_a_map(known: Slam, tmp_path: Path) -> None:
    """`vg.reconstruct` in a map writes its folder, its map holds both halves, and a third run finds itself in both;
    oracle: the truth, the files, the numbers.
    """
    given, later = {"roles": ROLES, "settings": SETTINGS}, vg.RunOptions(start=HALF, dense="none")
    result = vg.reconstruct(sequence(), **given, known_map=known, options=later)
    result.save(tmp_path / "out")
    result.save_map(tmp_path / "both.map")
    assert len(result.trajectory) == FRAMES - HALF
    assert Result.load(tmp_path / "out").summary["frames"] == FRAMES - HALF
    assert len(list((tmp_path / "out/images").iterdir())) == len(result.keyframes)
    both = vg.load_map(tmp_path / "both.map")
    again = vg.reconstruct(sequence(), **given, known_map=both, options=vg.RunOptions(dense="none"))
    assert len(again.keyframes) == len(result.keyframes)
    assert worst_error(again.record.slam) < 0.02


@pytest.mark.long
@pytest.mark.usefixtures("uncompiled")
def test_the_command_saves_and_takes_a_map(tmp_path: Path) -> None:
    """`--save-map`, then `--map --localise-only` on the same frames: all are placed, no keyframe is added; oracle: the
    summaries.
    """
    for _ in write_tum_folder(vg.simulate("room", 3, 0, (160, 120), rate=20.0), tmp_path / "room"):
        pass
    found = []
    for more in (["--save-map", str(tmp_path / "a.map")], ["--map", str(tmp_path / "a.map"), "--localise-only"]):
        command = ["run", str(tmp_path / "room"), "-o", str(tmp_path / "out"), "--dense", "none", "--json", *more]
        done = CliRunner().invoke(make_app(), command)
        assert done.exit_code in (0, 3), done.output
        found.append(json.loads(done.stdout))
    assert [one["frames_tracked"] for one in found] == [3, 3]
    assert [one["keyframes"] for one in found] == [1, 1]
    assert found[1]["notes"] == ["frame 0 (0.000000.png) is the first that was found in the map"]
