"""Measure global bundle adjustment against its size: time per iteration and memory from 50 to 1600 keyframes.

    taskset -c 1 .venv/bin/python benchmarks/scale.py [--generator ../shared/bench/problems.py] [--out runs/scale]
        [--keyframes 50 100 200 400 800 1600] [--dense-up-to 200] [--iterations 10] [--ceres BINARY] [--table FILE]

The problems are those of the generator's size `global` (128 points and 8 lines of 8 samples per keyframe, edges to the
4 keyframes before and after), made once and kept in the output folder. Each row is measured in a separate process, in
float64: a whole jitted `solve` of `--iterations` iterations, run four times. Wall time is the median of the last three,
processor time their least (the one to read where the core is shared). With `--ceres`, Ceres solves the same files
(SPARSE_SCHUR, analytic, cached edges, one thread); inverse depths may become negative in both. Prints Markdown, and
writes it to `scale.md` and the plot to `scale.png` beside the problems.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

SOLVERS = ("chosen", "dense", "jacobi")
LABELS = {
    "chosen": "band (chosen)",
    "dense": "dense",
    "jacobi": "conjugate gradients, block Jacobi",
    "ceres": "Ceres SPARSE_SCHUR",
}
HEADER = (
    "| keyframes | edges | solver | ms per iteration | processor ms | us per edge | energy | compile s | memory GB |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


def main() -> None:
    """Measure every row, print the table, draw the plot."""
    options = _options()
    if options.row:
        print(json.dumps(_measure(Path(options.row[0]), options.row[1], options.iterations)))
        return
    options.out.mkdir(parents=True, exist_ok=True)
    rows = json.loads(options.table.read_text()) if options.table else _all_rows(options)
    (options.out / "scale.json").write_text(json.dumps(rows, indent=1))
    _draw(rows, options.out / "scale.png")
    table = "\n".join([HEADER, *(_markdown(row) for row in rows)])
    (options.out / "scale.md").write_text(table + "\n")
    print(table)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    beside = Path(__file__).resolve().parents[2] / "shared" / "bench" / "problems.py"
    parser.add_argument("--generator", type=Path, default=beside)
    parser.add_argument("--out", type=Path, default=Path("runs/scale"))
    parser.add_argument("--keyframes", type=int, nargs="+", default=[50, 100, 200, 400, 800, 1600])
    parser.add_argument("--solvers", nargs="+", choices=SOLVERS, default=SOLVERS)
    parser.add_argument("--dense-up-to", type=int, default=200, help="keyframes")
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--ceres", type=Path, help="binary of the generator's Ceres solver")
    parser.add_argument("--table", type=Path, help="a scale.json to print and draw again instead of measuring")
    parser.add_argument("--row", nargs=2, metavar=("PROBLEM", "SOLVER"), help=argparse.SUPPRESS)
    return parser.parse_args()


def _all_rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    rows = []
    for keyframes in options.keyframes:
        path = _problem(options.generator, options.out, keyframes)
        for solver in options.solvers:
            if solver == "dense" and keyframes > options.dense_up_to:
                continue
            command = [sys.executable, __file__, "--row", str(path), solver, "--iterations", str(options.iterations)]
            rows.append(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout))
            print(_markdown(rows[-1]), file=sys.stderr)
        if options.ceres:
            rows.append(_ceres(options.ceres, path, rows[-1], options.iterations))
    return rows


def _problem(generator: Path, folder: Path, keyframes: int) -> Path:
    """Return the file of the problem with `keyframes` keyframes; make it if it does not exist."""
    path = folder / f"sequence-{keyframes}.npz"
    if not path.exists():
        spec = importlib.util.spec_from_file_location("problems", generator)
        if spec is None or spec.loader is None or not generator.is_file():
            raise SystemExit(f"`--generator` must be the path of problems.py, got {generator}")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        module.SIZES["sequence"] = {**module.SIZES["global"], "N": keyframes}
        arrays = module.generate("sequence")
        module.to_bin(arrays, str(path.with_suffix(".bin")))
        np.savez(path, **arrays)
    return path


def _measure(path: Path, name: str, iterations: int) -> dict[str, Any]:
    """Measure one row: compile, then run four times."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from vggtgeo.solvers.conjugate_gradients import ConjugateGradients
    from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
    from vggtgeo.solvers.reduced_solvers import DenseCholesky

    from vggtgeo.bundle.problem_file import load_problem
    from vggtgeo.bundle.solution import solve
    from vggtgeo.bundle.solver_choice import choose_reduced_solver

    problem, state, _ = load_problem(path)
    problem = dataclasses.replace(problem, positive_depth=False)
    reduced = {"dense": DenseCholesky, "jacobi": ConjugateGradients}.get(name, lambda: choose_reduced_solver(problem))()
    solver = SchurLevenbergMarquardt(rtol=0.0, max_iterations=iterations, reduced_solver=reduced)
    start = time.perf_counter()
    run = jax.jit(lambda problem, state: solve(problem, state, solver=solver)).lower(problem, state).compile()
    compile_seconds = time.perf_counter() - start
    walls, processors = [], []
    for _ in range(4):
        wall, processor = time.perf_counter(), time.process_time()
        solution = jax.block_until_ready(run(problem, state))
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    count = int(solution.iterations)
    return {
        "keyframes": problem.num_keyframes,
        "edges": len(problem.edges.source),
        "solver": name,
        "wall_ms": 1e3 * float(np.median(walls[1:])) / count,
        "processor_ms": 1e3 * min(processors[1:]) / count,
        "energy": float(solution.energy),
        "compile_s": compile_seconds,
        "memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def _ceres(binary: Path, path: Path, beside: dict[str, Any], iterations: int) -> dict[str, Any]:
    flags = ["--solver", "sparse", "--jac", "cached", "--threads", "1", "--iters", str(iterations), "--ftol", "1e-15"]
    command = [str(binary), str(path.with_suffix(".bin")), *flags]
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()[-1])
    used = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    # Its processor time is that of the whole process: take the share of the minimiser.
    share = found["min_ms"] / (found["total_ms"] + found["build_ms"])
    return {
        "keyframes": beside["keyframes"],
        "edges": beside["edges"],
        "solver": "ceres",
        "wall_ms": found["ms_per_iter"],
        "processor_ms": 1e3 * used * share / found["iters"],
        "energy": found["c1"],
        "compile_s": 0.0,
        "memory_gb": found["peakRSS_MB"] / 1024,
    }


def _markdown(row: dict[str, Any]) -> str:
    cells = [
        *(str(row["keyframes"]), str(row["edges"]), LABELS[row["solver"]]),
        *(f"{row['wall_ms']:.1f}", f"{row['processor_ms']:.1f}", f"{1e3 * row['processor_ms'] / row['edges']:.1f}"),
        *(f"{row['energy']:.9e}", f"{row['compile_s']:.1f}", f"{row['memory_gb']:.2f}"),
    ]
    return "| " + " | ".join(cells) + " |"


def _draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw the time per iteration against edges, both logarithmic, with a line of slope 1."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 4.5), layout="constrained")
    for solver, label in LABELS.items():
        points = sorted((row["edges"], row["processor_ms"]) for row in rows if row["solver"] == solver)
        if points:
            axes.loglog(*zip(*points, strict=True), "o-", label=label)
    first = min((row["edges"], row["processor_ms"]) for row in rows)
    last = max(row["edges"] for row in rows)
    axes.loglog([first[0], last], [first[1], first[1] * last / first[0]], "k:", linewidth=1, label="linear in edges")
    axes.set(xlabel="edges", ylabel="ms per iteration (processor time)", title="Global bundle adjustment, one core")
    axes.legend()
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
