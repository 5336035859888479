"""Invalid checkpoints raise an error before the run is resumed. Oracle: argument and value in the message."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from reported import raises
from tiny_state import state

from vggtgeo.results.checkpoints import CHECKPOINT, Checkpoints, RunSoFar, load_checkpoint
from vggtgeo.slam.tracking.tracker import FramePose

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


def test_a_setting_that_differs_is_named(tmp_path: Path) -> None:
    """The shortest of those that differ is named, with both values."""
    CHECKPOINT.write(tmp_path / "kept.npz", run(), {**FACTS, "identity": {"points": "Matcher(seed=0)", "seed": "0"}})
    kept = Checkpoints(tmp_path / "kept.npz", resume=True)
    with raises("`seed`", 5, 0):
        load_checkpoint(kept, {"points": "Matcher(seed=5)", "seed": "5"})
