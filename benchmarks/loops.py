"""Measure a closed loop of RGB-D keyframes with surfaces: the cost of adjustment, derivative and covariances against
its length.

    taskset -c 1 .venv/bin/python benchmarks/loops.py [--keyframes 125 250 500 1000] [--solvers chosen jacobi]
        [--parts solve gradient covariances observability] [--out runs/loops]

The loop is that of `benchmarks/simulated_loop.py`: points, depth priors, aligned surfaces, edges around the loop, and
an initial guess that drifts, so that the loop does not close. Each cell is measured in a separate process, in float64,
on one core:

- solve: until it converges; time per iteration, the linear solver that the graph chose, and the RMS errors of the
  camera centres before and after.
- gradient: `jax.value_and_grad` of a loss of the solution by every float leaf; the time beyond the solve, in iterations
  of the solve.
- covariances: of every pose and landmark, with the same linear algebra, and the error that they predict.
- observability: at the true values; above 300 keyframes by sparse solvers.

Time is the median of three runs after the first. Memory is the peak of the process. The slope is that of a straight
line through the logarithms of time and edges: 1 is linear. Prints Markdown and writes it to `loops.md`.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from simulated_loop import simulate_loop
from vggtgeo.solvers.conjugate_gradients import ConjugateGradients
from vggtgeo.solvers.reduced_solvers import AbstractReducedSolver

import vggtgeo as vg
from vggtgeo.bundle.analysis.observability import DENSE_KEYFRAMES

SOLVERS: dict[str, Callable[[vg.Problem], AbstractReducedSolver]] = {
    "chosen": vg.choose_reduced_solver,
    "jacobi": lambda problem: ConjugateGradients(),
}
PARTS = ("solve", "gradient", "covariances", "observability")
HEADER = (
    "| keyframes | edges | surfaces | linear solver | iterations | ms per iteration | error before, mm | after, mm "
    "| expected, mm | backward, iterations | covariances, s | observability, s "
    "| memory GB: solve | gradient | covariances | observability |\n" + "|---" * 16 + "|"
)


def main() -> None:
    """Measure every row, print and write the table."""
    options = _options()
    if options.cell:
        print(json.dumps(_measure(int(options.cell[0]), *options.cell[1:])))
        return
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    print(HEADER, flush=True)
    for name in options.solvers:
        for keyframes in options.keyframes:
            rows.append(_row(keyframes, name, options.parts))
            print(_markdown(rows[-1]), flush=True)
    (options.out / "loops.json").write_text(json.dumps(rows, indent=1))
    several = len(options.keyframes) > 1 and "solve" in options.parts
    slopes = [f"Slope of {name}: {_slope(rows, name):.2f}." for name in options.solvers if several]
    print("\n" + "\n".join(slopes))
    (options.out / "loops.md").write_text("\n".join([HEADER, *map(_markdown, rows), "", *slopes]) + "\n")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, nargs="+", default=[125, 250, 500, 1000])
    parser.add_argument("--solvers", nargs="+", choices=SOLVERS, default=["chosen"])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=Path, default=Path("runs/loops"))
    parser.add_argument("--cell", nargs=3, help=argparse.SUPPRESS)
    return parser.parse_args()


def _row(keyframes: int, solver: str, parts: list[str]) -> dict[str, Any]:
    """Return all cells of one size, each measured in a separate process."""
    row: dict[str, Any] = {"solver": solver}
    for part in parts:
        command = [sys.executable, __file__, "--cell", str(keyframes), solver, part]
        row |= json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    if {"both_ms", "solve_ms"} <= row.keys():
        row["backward"] = (row["both_ms"] - row["solve_ms"]) / (row["solve_ms"] / row["iterations"])
    return row


def _measure(keyframes: int, name: str, part: str) -> dict[str, Any]:
    jax.config.update("jax_enable_x64", True)
    window, surfaces = simulate_loop(keyframes)
    problem, initial, _ = window.pack(terms=(surfaces,), kernel=vg.kernels.Huber(1.5))
    reduced = SOLVERS[name](problem)
    solver = vg.SchurLevenbergMarquardt(reduced_solver=reduced)
    solve = lambda problem, state: vg.solve(problem, state, solver=solver)
    measured = {"solve": _solve, "gradient": _gradient, "covariances": _covariances, "observability": _observability}
    found = measured[part](problem, window.truth() if part == "observability" else initial, solve, reduced)
    if "state" in found:
        state = found.pop("state")
        found["error_mm"] = [1e3 * float(np.sqrt(np.mean(window.errors(s) ** 2))) for s in (initial, state)]
    found |= {"keyframes": keyframes, "edges": len(problem.edges.source), "surfaces": len(surfaces.first)}
    found[f"{part}_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return found


def _solve(problem: vg.Problem, initial: vg.State, solve: Any, reduced: AbstractReducedSolver) -> dict[str, Any]:
    milliseconds, found = _timed(solve, problem, initial)
    folded = ", folded" if getattr(reduced, "place", None) is not None else ""
    reach = f" of reach {reduced.reach}{folded}" if hasattr(reduced, "reach") else ""
    return {
        "label": type(reduced).__name__ + reach,
        "iterations": int(found.iterations),
        "result": found.result,
        "solve_ms": milliseconds,
        "state": found.state,
    }


def _gradient(problem: vg.Problem, initial: vg.State, solve: Any, _: AbstractReducedSolver) -> dict[str, Any]:
    moving, rest = eqx.partition(problem, eqx.is_inexact_array)

    def loss(moving: Any, state: vg.State) -> tuple[jax.Array, jax.Array]:
        solution = solve(eqx.combine(moving, rest), state)
        found = solution.state
        value = jnp.sum(jnp.sin(found.poses.wxyz_xyz)) + jnp.sum(found.inverse_depth**2) + jnp.sum(found.intrinsics)
        return value, solution.gradient_residual

    milliseconds, ((_, left), _) = _timed(jax.value_and_grad(loss, has_aux=True), moving, initial)
    return {"both_ms": milliseconds, "gradient_residual": float(left)}


def _covariances(problem: vg.Problem, initial: vg.State, solve: Any, reduced: AbstractReducedSolver) -> dict[str, Any]:
    few = range(0, problem.num_keyframes, max(problem.num_keyframes // 4, 1))
    asked = list(few) if isinstance(reduced, ConjugateGradients) else None
    estimate = lambda problem, state: vg.covariances(problem, state, reduced_solver=reduced, keyframes=asked)
    milliseconds, found = _timed(estimate, problem, jax.jit(solve)(problem, initial).state)
    expected = jnp.sqrt(jnp.mean(jnp.trace(found.poses[:, :3, :3], axis1=1, axis2=2)))
    return {"covariances_s": milliseconds / 1e3, "asked": len(found.poses), "expected_mm": 1e3 * float(expected)}


def _observability(problem: vg.Problem, state: vg.State, _: Any, __: AbstractReducedSolver) -> dict[str, Any]:
    observe = jax.jit(vg.observability) if problem.num_keyframes <= DENSE_KEYFRAMES else vg.observability
    milliseconds, found = _timed_run(observe, problem, state)
    return {"observability_s": milliseconds / 1e3, "eigenvalues": found.to_dict()["eigenvalues"][:6]}


def _timed(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Return the milliseconds of a compiled run, and its result."""
    return _timed_run(jax.jit(function), *arguments)


def _timed_run(run: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    found, times = jax.block_until_ready(run(*arguments)), []
    for _ in range(3):
        start = time.perf_counter()
        jax.block_until_ready(run(*arguments))
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times)), found


def _slope(rows: list[dict[str, Any]], solver: str) -> float:
    points = [(row["edges"], row["solve_ms"] / row["iterations"]) for row in rows if row["solver"] == solver]
    return float(np.polyfit(*np.log(np.array(points)).T, 1)[0])


def _markdown(row: dict[str, Any]) -> str:
    number = lambda name, digits: f"{row[name]:.{digits}f}" if name in row else "-"
    cells = [*(str(row[name]) for name in ("keyframes", "edges", "surfaces")), row.get("label", row["solver"])]
    cells += [str(row.get("iterations", "-"))]
    cells += [f"{row['solve_ms'] / row['iterations']:.1f}" if "solve_ms" in row else "-"]
    cells += [f"{error:.1f}" for error in row.get("error_mm", [np.nan] * 2)]
    cells += [number("expected_mm", 1), number("backward", 1), number("covariances_s", 2)]
    cells += [number("observability_s", 2)]
    cells += [number(f"{part}_gb", 2) for part in PARTS]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
