"""`vggtgeo solve`: solve a bundle-adjustment problem from a file, and measure the time."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from vggtgeo.cli.options import EXIT_FAILED, JsonOption, QuietOption
from vggtgeo.io.errors import InputError

if TYPE_CHECKING:
    from vggtgeo.bundle.problem import Problem, State
    from vggtgeo.bundle.solution import Solution


def solve(
    problem: Annotated[
        Path, typer.Argument(metavar="PROBLEM", help="Problem (.npz), see docs/reference/problem-file.md.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Solution (.npz): T, k, d.")],
    max_steps: Annotated[int, typer.Option(min=1, max=1_000_000, help="Maximum iterations (tried steps).")] = 50,
    dtype: Annotated[Literal["float64", "float32"], typer.Option(help="Precision of the solve.")] = "float64",
    repeat: Annotated[
        int, typer.Option(min=1, max=100_000, help="Number of solves; their median time is printed.")
    ] = 1,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Solve the bundle-adjustment problem in PROBLEM."""
    from vggtgeo.results.output_checks import check_can_be_written

    if output.exists() and problem.exists() and output.samefile(problem):
        raise InputError(f"`-o` must not be the problem itself, got `{output}`; give another name for the solution")
    check_can_be_written(output.parent)
    report = solve_file(problem, output, max_steps, dtype, repeat)
    if as_json:
        typer.echo(json.dumps(report, allow_nan=False))
    elif not quiet:
        pace = "" if report["ms_per_iteration"] is None else f", {report['ms_per_iteration']:.3g} ms each"
        typer.echo(
            f"{report['result']}: energy {report['energy_initial']:.6e} -> {report['energy_final']:.6e} in "
            f"{report['iterations']} iterations{pace} ({dtype}, compiled in {report['compile_s']:.1f} s)"
        )
    if report["result"] == "nonfinite_step":
        raise typer.Exit(EXIT_FAILED)


def solve_file(problem: Path, output: Path, max_steps: int, dtype: str, repeat: int) -> dict[str, Any]:
    """Solve the problem in the file `problem` in precision `dtype` and write the solution to `output`.

    Returns the object of `--json`: energies are `1/2 sum rho`, always computed in float64; `compile_s` is small if the
    program was in the JIT cache; `ms_per_iteration` is the median over the solves, None without iterations.

    Raises:
        InputError: the file is invalid, or its initial energy is not finite (then nothing is written).

    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from vggtgeo.bundle.objective import energy
    from vggtgeo.bundle.problem_file import load_problem, save_solution

    exact, start, index = load_problem(problem)
    # Load again in the precision of the solve, since the loader reports values that it cannot represent.
    cast, cast_start, _ = (exact, start, index) if dtype == "float64" else load_problem(problem, dtype)
    energy_of = jax.jit(energy)
    initial = float(energy_of(exact, start))
    if not np.isfinite(initial):
        raise InputError(
            f"the initial energy of `{problem}` must be finite, got {initial}: are there NaN in its arrays?"
        )
    solution, compile_s, run_s = timed_solve(cast, cast_start, max_steps, repeat)
    wide: State = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), solution.state)
    state, iterations = replace(wide, poses=wide.poses.normalize()), int(solution.iterations)
    save_solution(output, state, index)
    return {
        "iterations": iterations,
        "energy_initial": initial,
        "energy_final": float(energy_of(exact, state)),
        "compile_s": compile_s,
        "ms_per_iteration": 1e3 * run_s / iterations if iterations else None,
        "dtype": dtype,
        "result": solution.result,
    }


def timed_solve(problem: Problem, start: State, max_steps: int, repeat: int) -> tuple[Solution, float, float]:
    """Return solution, seconds of compilation, and median seconds of `repeat` >= 1 compiled solves."""
    import jax
    import numpy as np

    from vggtgeo.bundle.solution import solve
    from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

    solver = SchurLevenbergMarquardt(max_iterations=max_steps)
    solve_one = jax.jit(lambda problem, start: solve(problem, start, solver=solver))
    began = time.perf_counter()
    compiled = solve_one.lower(problem, start).compile()
    compile_s = time.perf_counter() - began
    solutions, seconds = [], []
    for _ in range(repeat):
        began = time.perf_counter()
        solutions.append(jax.block_until_ready(compiled(problem, start)))
        seconds.append(time.perf_counter() - began)
    return solutions[-1], compile_s, float(np.median(seconds))
