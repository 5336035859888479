"""Programs that are kept between processes: what runs is what was written, and nothing is kept that has no lasting
name.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vggtgeo as vg
from vggtgeo.compilation import program_cache
from vggtgeo.compilation.program_cache import CachedProgram
from vggtgeo.slam.window.sliding_window import solve_jit

TRACED: list[str] = []


class Pair(NamedTuple):
    sum: jax.Array
    scaled: jax.Array


def pair(first: jax.Array, second: jax.Array, factor: float) -> Pair:
    TRACED.append("pair")
    return Pair(first + second, factor * first)


def _as_pair(first: jax.Array, second: jax.Array, factor: float) -> Pair:
    return Pair(first, second)


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Where programs are kept, of this module, too."""
    place = tmp_path / "programs"
    monkeypatch.setattr(program_cache, "_folder", lambda: place)
    monkeypatch.setattr(program_cache, "LASTING", (*program_cache.LASTING, __name__.split(".")[0]))
    TRACED.clear()
    return place


ONE, TWO = np.arange(3.0), np.full(3, 2.0)


def _expected(found: Pair, factor: float) -> None:
    np.testing.assert_array_equal(found.sum, ONE + TWO)
    np.testing.assert_array_equal(found.scaled, factor * ONE)


def test_another_process_traces_nothing(folder: Path) -> None:
    """A second program object is a second process: it reads what the first wrote; oracle: NumPy, and a count."""
    _expected(CachedProgram(pair, _as_pair)(ONE, TWO, 3.0), 3.0)
    _expected(CachedProgram(pair, _as_pair)(jnp.asarray(ONE), jnp.asarray(TWO), 3.0), 3.0)
    assert TRACED == ["pair"]
    assert len(list(folder.iterdir())) == 1


def test_shapes_and_static_parts_have_programs_of_their_own(folder: Path) -> None:
    program = CachedProgram(pair, _as_pair)
    for factor in (3.0, 4.0, 3.0):
        _expected(program(ONE, TWO, factor), factor)
    assert program(np.ones(2), np.ones(2), 3.0).sum.shape == (2,)
    assert len(list(folder.iterdir())) == 3


def test_a_program_takes_what_a_program_returned(folder: Path) -> None:
    """Without a second compilation: such arrays name their device, which is another case for JAX's own `jit`. Oracle:
    JAX's count.
    """
    compiled: list[str] = []
    count = lambda name, seconds, **_: compiled.append(name) if "backend_compile" in name else None
    program = CachedProgram(pair, _as_pair)
    first = program(jnp.asarray(ONE), jnp.asarray(TWO), 3.0)
    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        again = program(first.sum, first.scaled, 3.0)
    finally:
        jax.monitoring.unregister_event_duration_listener(count)
    np.testing.assert_array_equal(again.sum, ONE + TWO + 3 * ONE)
    assert compiled == []


ELSEWHERE = """
import jax, numpy as np
jax.config.update("jax_num_cpu_devices", 2)
import test_program_cache as own
from vggtgeo.compilation import program_cache
program_cache.LASTING = (*program_cache.LASTING, "test_program_cache")
program = program_cache.CachedProgram(own.pair, own._as_pair)
for device in (*jax.devices(), jax.devices()[0]):
    found = program(jax.device_put(own.ONE, device), jax.device_put(own.TWO, device), 3.0)
    assert found.sum.devices() == {device}, found.sum.devices()
    np.testing.assert_array_equal(found.sum, own.ONE + own.TWO)
"""


@pytest.mark.long
def test_arrays_on_another_device_stay_there(tmp_path: Path) -> None:
    """On two devices of one processor; oracle: NumPy, and where the result lies."""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", ELSEWHERE]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert len(list((tmp_path / "programs").iterdir())) == 1


def test_changed_sources_have_another_program(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    CachedProgram(pair, _as_pair)(ONE, TWO, 3.0)
    monkeypatch.setattr(program_cache, "_sources", lambda: "changed")
    CachedProgram(pair, _as_pair)(ONE, TWO, 3.0)
    assert TRACED == ["pair", "pair"]
    assert len(list(folder.iterdir())) == 2


def test_traced_arguments_pass_through(folder: Path) -> None:
    program = CachedProgram(pair, _as_pair)
    slope = jax.grad(lambda first: jnp.sum(program(first, jnp.asarray(TWO), 3.0).scaled))(jnp.asarray(ONE))
    np.testing.assert_array_equal(slope, np.full(3, 3.0))
    assert not folder.exists()


def test_without_a_cache_nothing_is_kept() -> None:
    """JAX's own switches decide: its folder, and whether it keeps anything."""
    assert program_cache._folder() == Path(jax.config.jax_compilation_cache_dir) / "programs"
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        assert program_cache._folder() is None
    finally:
        jax.config.update("jax_enable_compilation_cache", True)


@pytest.mark.long
def test_a_kept_solve_is_the_solve(folder: Path) -> None:
    """The whole solution, read from a file; oracle: `solve` under `jit`, to the last digit."""
    window = vg.simulate_window(noise=0.5)
    problem, initial, _ = window.pack()
    solver = vg.SchurLevenbergMarquardt(max_iterations=8, record_iterations=True)
    for _ in range(2):
        found = CachedProgram(solve_jit._function, solve_jit._result)(problem, initial, solver)
    assert len(list(folder.iterdir())) == 1
    expected = jax.jit(lambda p, i: vg.solve(p, i, solver=solver, diagnosis=False))(problem, initial)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)
