"""JAX as a notebook has it: without 64-bit types, until somebody asks for them."""

from __future__ import annotations

from pathlib import Path

import jax
import pytest
import rerun as rr

import vggtgeo as vg
from vggtgeo.viewing.callback import RerunCallback


@pytest.mark.long
def test_a_run_with_everything_compiled_and_recorded(tmp_path: Path) -> None:
    """A run from warm-up to report and recording, in a session without 64-bit types, which stays as it was."""
    stream = rr.RecordingStream("single precision")
    stream.save(str(tmp_path / "run.rrd"))
    with jax.enable_x64(False):
        frames = vg.simulate("room", 24, size=(160, 120), rate=6.0)
        result = vg.reconstruct(frames, callbacks=(RerunCallback(stream),))
        result.save(tmp_path / "run")
        assert not jax.config.jax_enable_x64
    assert len(result.keyframes) > 2
    assert vg.read(tmp_path / "run").to_dict()["frames"] == len(result.trajectory)
