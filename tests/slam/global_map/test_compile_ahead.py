"""What `vggtgeo warm-up`, and a run beside its frames, compile is what the end of a run calls."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from invoked import invoke
from recorded_run import SETTINGS, recorded_run

import vggtgeo as vg
from vggtgeo.slam.global_map import compile_ahead, global_adjustment
from vggtgeo.slam.global_map.compile_ahead import compile_before_runs
from vggtgeo.slam.settings.table import updated
from vggtgeo.slam.sparse_map.factors import MeasuredBaseline
from vggtgeo.slam.state import Slam


class _Ready(np.ndarray):
    """An energy that is computed."""

    def block_until_ready(self) -> None:
        """Return at once."""


class _Called(Exception):
    """Ends an adjustment where it would solve."""


def _program(*args: Any) -> tuple[Any, ...]:
    """Structure and shapes: those of which a program is compiled."""
    leaves, structure = jax.tree.flatten(args)
    return structure, tuple((np.shape(leaf), getattr(leaf, "dtype", type(leaf))) for leaf in leaves)


def _compiled(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """The programs of the solver that are compiled from here on, none of them really."""
    programs: list[tuple[Any, ...]] = []

    def solve(*args: Any) -> Any:
        programs.append(_program(*args))
        return SimpleNamespace(energy=np.zeros(1).view(_Ready))

    for name in ("warm_up", "compile_alignment", "keyframe_sigma"):
        monkeypatch.setattr(compile_ahead, name, lambda *_: None)
    monkeypatch.setattr(compile_ahead, "solve_jit", solve)
    return programs


def _with_or_without_depth(metric: bool) -> Slam:
    """A recorded run, its map with or without depth."""
    slam = recorded_run().states[-1]
    factors = (() if metric else (MeasuredBaseline(0, 1, 1.0, 1e-3),)) + slam.map.factors
    return slam.with_map(metric=metric, factors=factors)


def _check_asked(
    monkeypatch: pytest.MonkeyPatch, compiled: list[tuple[Any, ...]], metric: bool, settings: vg.SlamSettings
) -> None:
    """Check that the last adjustment begins with a program that was compiled."""

    def called(*args: Any) -> Any:
        assert _program(*args) in compiled
        raise _Called

    monkeypatch.setattr(global_adjustment, "solve_jit", called)
    with pytest.raises(_Called):
        global_adjustment.adjust_all(_with_or_without_depth(metric), settings)


def test_the_program_of_the_end_is_compiled_before(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that the last adjustment of a map with depth asks for a program that was compiled. Oracle: structure and
    # shapes of what the adjustment of a recorded run solves.
    compiled = _compiled(monkeypatch)
    compile_before_runs(SETTINGS, 320, 240)
    _check_asked(monkeypatch, compiled, metric=True, settings=SETTINGS)


@pytest.mark.parametrize("metric", [True, False])
def test_the_program_of_the_end_is_compiled_during_the_run(monkeypatch: pytest.MonkeyPatch, metric: bool) -> None:
    # Proves that the callback compiles what the last adjustment of a map with depth and of one without asks for, once.
    # Oracle: structure and shapes of what the adjustment of a recorded run solves.
    compiled, slam = _compiled(monkeypatch), _with_or_without_depth(metric)
    settings = updated(SETTINGS, {"refinement": {"global_adjustment": True}})
    ahead, count = compile_ahead.CompileAhead(settings), len(slam.frames)
    ahead.on_begin("a walk", -(-4 * count // 3))
    for _ in range(2):
        ahead.on_frame(slam, recorded_run().frames[-1])
    ahead.on_adjust(slam)
    assert len(compiled) == 1
    _check_asked(monkeypatch, compiled, metric, settings)


def test_a_map_without_depth_is_adjusted_by_programs_compiled_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that no round of the last adjustment, nor its search for shutter and lens, needs another program. Oracle:
    # structure and shapes of all that it solves.
    compiled, slam = _compiled(monkeypatch), _with_or_without_depth(metric=False)
    compile_before_runs(SETTINGS, 320, 240)
    solve, asked = global_adjustment.solve_jit, []

    def solved(*args: Any) -> Any:
        asked.append(_program(*args))
        return solve(*args)

    monkeypatch.setattr(global_adjustment, "solve_jit", solved)
    global_adjustment.adjust_all(slam, SETTINGS, uncertainty=False)
    assert len(asked) > global_adjustment.ROUNDS + 3, "shutter, camera or lens were not searched"
    assert set(asked) <= set(compiled)


def test_the_command_takes_the_size_of_images(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that `vggtgeo warm-up` compiles for the default settings and the size that was asked for.
    asked: list[Any] = []
    monkeypatch.setattr(compile_ahead, "compile_before_runs", lambda *given: asked.append(given))
    assert invoke("warm-up", "--size", "320x240").exit_code == 0
    assert asked[0][1:] == (320, 240)
    assert asked[0][0].window.size == vg.SlamSettings().window.size
    assert invoke("warm-up", "--size", "large").exit_code == 2
