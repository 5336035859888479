"""JAX as a notebook has it: without 64-bit types, until somebody asks for them."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
import rerun as rr

import vggtgeo as vg
from vggtgeo.compilation.process_settings import in_double_precision
from vggtgeo.slam.settings.groups import WindowSettings
from vggtgeo.viewing.callback import RerunCallback


@pytest.mark.long
def test_a_run_with_everything_compiled_and_recorded(tmp_path: Path) -> None:
    """A run from warm-up to report and recording, in a session without 64-bit types, which stays as it was."""
    stream = rr.RecordingStream("single precision")
    stream.save(str(tmp_path / "run.rrd"))
    settings = vg.SlamSettings(window=WindowSettings(size=4, point_slots=96, line_slots=48))  # as in test_pipeline.py
    with jax.enable_x64(False):
        frames = vg.simulate("room", 16, size=(160, 120), rate=6.0)
        result = vg.reconstruct(frames, settings=settings, callbacks=(RerunCallback(stream),))
        result.save(tmp_path / "run")
        assert not jax.config.jax_enable_x64
    assert len(result.keyframes) > 2
    assert vg.read(tmp_path / "run").to_dict()["frames"] == len(result.trajectory)


def test_what_callers_set_to_find_their_faults_does_not_reach_a_run() -> None:
    """NaN that means none, compiled programs and mixed types were errors of JAX in a session with its switches for
    debugging; those are as before afterwards. Oracle: each switch inside and after.
    """

    @in_double_precision
    def inside() -> tuple[bool, bool]:
        mixed = jnp.arange(3) * jnp.full(3, jnp.nan)  # integers and numbers, and no error of either kind
        return jax.config.jax_disable_jit, bool(jnp.isnan(mixed + jnp.inf).all())

    with jax.debug_nans(True), jax.debug_infs(True), jax.disable_jit(), jax.numpy_dtype_promotion("strict"):
        assert inside() == (False, True)
        assert jax.config.jax_debug_nans
        assert jax.config.jax_debug_infs
        assert jax.config.jax_disable_jit
        assert jax.config.jax_numpy_dtype_promotion == "strict"
