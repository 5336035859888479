"""Invalid checkpoints raise an error before the run is resumed. Oracle: argument and value in the message."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reported import raises
from tiny_state import state
from vggtgeo.models.onnx.bounds import Refusals

from vggtgeo.results.checkpoints import CHECKPOINT, Checkpoints, RunSoFar, load_checkpoint
from vggtgeo.results.run_folder import open_run_folder
from vggtgeo.results.tracking_loop import RunCallbacks
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.tracking.tracker import FramePose
from vggtgeo.slam.window_recorder import WindowRecorder

FACTS = {"identity": {"seed": "0"}, "frames": 1, "last": 0, "digest": "0"}


def run(**other: Any) -> RunSoFar:
    """A run of one frame."""
    slam = state()
    slam = replace(slam, tracker=replace(slam.tracker, frames=(FramePose(0, 0.0, 0, np.eye(4), True, 8),)))
    return RunSoFar(**({"slam": slam, "callbacks": {}, "notices": (), "refused": {}, "seconds": {}} | other), **TIMES)


TIMES = {"tracking": 1.0, "whole": 1.0}


def asked(folder: Path, kept: RunSoFar, facts: dict[str, Any]) -> RunSoFar | None:
    """The run that goes on from this one."""
    CHECKPOINT.write(folder / "kept.npz", kept, facts)
    return load_checkpoint(Checkpoints(folder / "kept.npz", resume=True), {"seed": "0"})


def test_an_unchanged_one_is_read(tmp_path: Path) -> None:
    """Else the others would prove nothing."""
    found = asked(tmp_path, run(), FACTS)
    assert found is not None
    assert len(found.slam.frames) == 1


@pytest.mark.parametrize(
    "facts", [{"identity": {"seed": 5}}, {"identity": []}, {"frames": "many"}, {"last": None}, {"digest": 7}]
)
def test_facts_of_another_kind(facts: dict[str, Any], tmp_path: Path) -> None:
    """What the header says of a run has its types."""
    with raises("kept.npz", "--no-resume"):
        asked(tmp_path, run(), FACTS | facts)


def test_times_that_are_none(tmp_path: Path) -> None:
    """A NaN would end the run when its summary is written, after all its work."""
    with raises("`seconds`", "{'align': nan}"):
        asked(tmp_path, run(seconds={"align": float("nan")}), FACTS)


def test_a_state_that_does_not_fit(tmp_path: Path) -> None:
    """What is wrong with the state ends with what to do, too."""
    slam = run().slam
    kept = run(slam=replace(slam, tracker=replace(slam.tracker, velocity=np.full((4, 4), np.nan))))
    with raises("`velocity`", 16):
        asked(tmp_path, kept, FACTS)


def test_callbacks_that_kept_nothing() -> None:
    """A callback that keeps records goes on from records."""
    callbacks = RunCallbacks((WindowRecorder(),), Clock())
    with raises("`WindowRecorder`", "NoneType"):
        callbacks.resume(run())


@pytest.mark.parametrize("refused", [{"weather": (1, 2, 3, 4)}, {"depth": (1, 2)}, {"depth": (1, 2, 3, -4)}])
def test_refusals_of_other_networks(refused: dict[str, tuple[int, ...]]) -> None:
    """Counts are those of the networks that play."""
    with raises("`refused`", "depth"):
        run(refused=refused).restore_refusals({"depth": Refusals()})


def test_a_place_that_is_no_file(tmp_path: Path) -> None:
    """What lies there is named; a run would neither go on from it nor keep its state there."""
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for name, found in (("folder", "a folder"), ("pipe", "a pipe"), ("link", "a broken link")):
        with raises(name):
            load_checkpoint(Checkpoints(tmp_path / name), {})
        (tmp_path / "out" / "unfinished").mkdir(parents=True, exist_ok=True)
        (tmp_path / name).rename(tmp_path / "out" / "unfinished" / "checkpoint.npz")
        with raises("checkpoint.npz"), open_run_folder(tmp_path / "out"):
            pass
        place = tmp_path / "out" / "unfinished" / "checkpoint.npz"
        place.rmdir() if found == "a folder" else place.unlink()


def test_a_setting_that_differs_is_named(tmp_path: Path) -> None:
    """The shortest of those that differ is named, with both values."""
    CHECKPOINT.write(tmp_path / "kept.npz", run(), {**FACTS, "identity": {"points": "Matcher(seed=0)", "seed": "0"}})
    kept = Checkpoints(tmp_path / "kept.npz", resume=True)
    with raises("`seed`", 5, 0):
        load_checkpoint(kept, {"points": "Matcher(seed=5)", "seed": "5"})
