"""`vggtgeo solve`: a bundle-adjustment problem from a file, solved and timed."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vggtgeo.cli.options import EXIT_FAILED, JsonOption, QuietOption
from vggtgeo.io.errors import InputError

if TYPE_CHECKING:
    from vggtgeo.bundle.problem import Problem, State
    from vggtgeo.bundle.solution import Solution


@dataclass(frozen=True)
class Report:
    """The output of `--json`. Energies are `1/2 sum rho`, always computed in float64."""

    iterations: int
    energy_initial: float
    energy_final: float
    compile_s: float
    """Seconds of tracing and compilation (little if the code was in the JIT cache)."""
    ms_per_iteration: float | None
    """Median time of the compiled solve over the repetitions, per iteration; None without iterations."""
    dtype: str
    result: str
    """Name of the termination code."""

    @property
    def sentence(self) -> str:
        """The report as text."""
        pace = "" if self.ms_per_iteration is None else f", {self.ms_per_iteration:.3g} ms each"
        return (
            f"{self.result}: energy {self.energy_initial:.6e} -> {self.energy_final:.6e} in {self.iterations} "
            f"iterations{pace} ({self.dtype}, compiled in {self.compile_s:.1f} s)"
        )


def solve(
    problem: Annotated[
        Path, typer.Argument(metavar="PROBLEM", help="Problem (.npz), see docs/reference/problem-file.md.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Solution (.npz): T, k, d.")],
    max_steps: Annotated[int, typer.Option(min=1, max=1_000_000, help="Most iterations (tried steps).")] = 50,
    dtype: Annotated[Literal["float64", "float32"], typer.Option(help="Precision of the solve.")] = "float64",
    repeat: Annotated[int, typer.Option(min=1, max=100_000, help="Runs to take the median time of.")] = 1,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Solve the bundle-adjustment problem in PROBLEM."""
    from vggtgeo.results.output_checks import check_can_be_written

    if output.exists() and problem.exists() and output.samefile(problem):
        raise InputError(f"`{output}` is the problem itself; give another name for the solution with `-o`")
    check_can_be_written(output.parent)
    report = solve_file(problem, output, max_steps, dtype, repeat)
    if as_json or not quiet:
        typer.echo(json.dumps(asdict(report), allow_nan=False) if as_json else report.sentence)
    if report.result == "nonfinite_step":
        raise typer.Exit(EXIT_FAILED)


def solve_file(problem: Path, output: Path, max_steps: int, dtype: str, repeat: int) -> Report:
    """Solve the problem in the file `problem` in precision `dtype` and write the solution to `output`.

    Raises:
        InputError: the file is invalid, or its initial energy is not finite (then nothing is written).

    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from vggtgeo.bundle.objective import energy
    from vggtgeo.bundle.problem_file import load_problem, save_solution

    exact, start, index = load_problem(problem)
    # Load again in the precision of the solve: the loader reports values that it cannot represent by their name.
    cast, cast_start, _ = (exact, start, index) if dtype == "float64" else load_problem(problem, dtype)
    energy_of = jax.jit(energy)
    initial = float(energy_of(exact, start))
    if not np.isfinite(initial):
        raise InputError(f"the initial energy of `{problem}` is {initial}; look for NaN or infinity in its arrays")
    solution, compile_s, run_s = timed_solve(cast, cast_start, max_steps, repeat)
    wide: State = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), solution.state)
    state, iterations = replace(wide, poses=wide.poses.normalize()), int(solution.iterations)
    save_solution(output, state, index)
    return Report(
        iterations=iterations,
        energy_initial=initial,
        energy_final=float(energy_of(exact, state)),
        compile_s=compile_s,
        ms_per_iteration=1e3 * run_s / iterations if iterations else None,
        dtype=dtype,
        result=solution.result,
    )


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
