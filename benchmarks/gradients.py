"""Measure what a backward pass costs: the gradient of a loss through `solve` by every float leaf, in iterations of the
solve.

    .venv/bin/python benchmarks/gradients.py [--sizes small medium] [--rounds 5] [--iterations 10 40]
        [--bench ../shared/bench] [--out runs/gradients]

For each size and number of iterations: the time of `solve` alone, the time of `jax.value_and_grad` of a loss of its
state, and the difference in units of one iteration of the solve (medians over interleaved rounds); this includes the
polish that the derivative needs. Memory is what XLA reserves for the compiled program beyond its arguments and results:
it must not grow with the iterations. The size `global` is 200 keyframes, solved and differentiated by a band matrix.
Writes `gradients.md` and `gradients.json`, on any device that JAX has.
"""

from __future__ import annotations

import argparse
import json
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

import vggtgeo as vg

HEADER = (
    "| size | iterations | ms per iteration | forward and backward, ms | backward, iterations | memory of solve MB "
    "| of both MB | compile s, solve | both |\n|---|---|---|---|---|---|---|---|---|"
)


def main() -> None:
    """Measure every row, print and write the table."""
    options = _options()
    jax.config.update("jax_enable_x64", True)
    options.out.mkdir(parents=True, exist_ok=True)
    print(HEADER, flush=True)
    rows = [_row(size, count, options) for size in options.sizes for count in options.iterations]
    (options.out / "gradients.json").write_text(json.dumps(rows, indent=1))
    (options.out / "gradients.md").write_text("\n".join([HEADER, *map(_markdown, rows)]) + "\n")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bench", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "bench")
    parser.add_argument("--sizes", nargs="+", default=["small", "medium"])
    parser.add_argument("--iterations", type=int, nargs="+", default=[10, 40])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/gradients"))
    return parser.parse_args()


def _row(size: str, iterations: int, options: argparse.Namespace) -> dict[str, Any]:
    path = options.out / "problems" / f"{size}.npz"
    if not path.exists():
        generate = [sys.executable, str(options.bench / "problems.py"), size, "--out", str(path.parent)]
        subprocess.run(generate, check=True, stdout=subprocess.DEVNULL)
    problem, state, _ = vg.load_problem(path)
    moving, rest = eqx.partition(problem, eqx.is_inexact_array)
    chosen = vg.choose_reduced_solver(problem)
    solver = vg.SchurLevenbergMarquardt(max_iterations=iterations, rtol=0.0, reduced_solver=chosen)

    def loss(moving: Any, state: Any) -> jax.Array:
        found = vg.solve(eqx.combine(moving, rest), state, solver=solver).state
        return jnp.sum(jnp.sin(found.poses.wxyz_xyz)) + jnp.sum(found.inverse_depth**2) + jnp.sum(found.intrinsics)

    solve, solve_seconds = _compiled(lambda m, s: vg.solve(eqx.combine(m, rest), s, solver=solver), moving, state)
    both, both_seconds = _compiled(jax.value_and_grad(loss), moving, state)
    times: dict[str, list[float]] = {"solve": [], "both": []}
    for _ in range(options.rounds + 1):
        for name, run in (("solve", solve), ("both", both)):
            start = time.perf_counter()
            jax.block_until_ready(run(moving, state))
            times[name].append(1e3 * (time.perf_counter() - start))
    alone, together = (np.array(times[name][1:]) for name in ("solve", "both"))
    count = int(solve(moving, state).iterations)
    row = {
        "size": size,
        "iterations": count,
        "ms_per_iteration": float(np.median(alone)) / count,
        "both_ms": float(np.median(together)),
        "backward_iterations": float(np.median((together - alone) / alone)) * count,
        "solve_mb": solve.memory_analysis().temp_size_in_bytes / 1e6,
        "both_mb": both.memory_analysis().temp_size_in_bytes / 1e6,
        "compile_s": [solve_seconds, both_seconds],
    }
    print(_markdown(row), flush=True)
    return row


def _compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    start = time.perf_counter()
    return jax.jit(function).lower(*arguments).compile(), time.perf_counter() - start


def _markdown(row: dict[str, Any]) -> str:
    cells = [row["size"], str(row["iterations"]), f"{row['ms_per_iteration']:.2f}", f"{row['both_ms']:.1f}"]
    cells += [f"{row['backward_iterations']:.1f}", f"{row['solve_mb']:.1f}", f"{row['both_mb']:.1f}"]
    cells += [f"{seconds:.1f}" for seconds in row["compile_s"]]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
