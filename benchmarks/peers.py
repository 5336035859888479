"""Compare this solver with others on one window: time per iteration, and energy against time, interleaved on one core.

    .venv/bin/python benchmarks/peers.py [--sizes small medium large] [--rounds 5] [--core 0] [--out runs/peers]
        [--bench ../shared/bench] [--jaxls-python PYTHON]

The problems come from `problems.py` of the bench folder. Its C++ solvers (Ceres with analytic derivatives and cached
edges; a hand-written solver of the same algorithm) are built where cmake, Ceres and Eigen are installed, and left out
otherwise. In every round each solver runs once, 50 iterations in float64 and one thread, so that other load on the
machine affects all of them; figures are medians over the rounds, ratios are medians of the rounds' ratios. jaxls is
measured when a Python with it is given (three runs in a row: it takes a minute to compile). All solve the same problem
without bounds; the rows of this solver tell where inverse depths are kept positive, the default of `solve`, and where
the columns come from automatic differentiation of the residuals, as for a user's term. Writes `peers.md`, `peers.json`
and `energy.png`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

ITERATIONS = 50
OURS = {
    "vggtgeo": {},
    "vggtgeo, plain reweighting": {"max_correction": 0.0},
    "vggtgeo, depths kept positive": {"positive_depth": True},
    "vggtgeo, float32": {"dtype": "float32"},
    "vggtgeo, derived columns": {"derived": True},
}


class Worker:
    """A Python process that compiles a solve once and runs it on request."""

    def __init__(self, problem: Path, flags: dict[str, Any]):
        command = [sys.executable, __file__, "--worker", str(problem), json.dumps(flags)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.compile_seconds = self._answer()["compile_s"]

    def run(self) -> dict[str, Any]:
        """Run once more."""
        assert self.process.stdin is not None
        print("go", file=self.process.stdin, flush=True)
        return self._answer()

    def close(self) -> None:
        """End the process."""
        self.process.communicate("")

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("a worker ended early; its message is above")
        answer: dict[str, Any] = json.loads(line)
        return answer


def main() -> None:
    """Measure, print and write the table, draw the energies."""
    options = _options()
    if options.worker:
        _work(Path(options.worker[0]), json.loads(options.worker[1]))
        return
    os.sched_setaffinity(0, {options.core})
    options.out.mkdir(parents=True, exist_ok=True)
    binaries = _build(options.bench, options.out / "build")
    results = {size: _measure(size, binaries, options) for size in options.sizes}
    (options.out / "peers.json").write_text(json.dumps(results, indent=1))
    table = "\n\n".join(_table(size, rows) for size, rows in results.items())
    (options.out / "peers.md").write_text(table + "\n")
    print(table)
    _draw(results, options.out / "energy.png")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bench", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "bench")
    parser.add_argument("--sizes", nargs="+", default=["small", "medium", "large"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--core", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/peers"))
    parser.add_argument("--jaxls-python", type=Path, help="interpreter of an environment with jaxls")
    parser.add_argument("--worker", nargs=2, help=argparse.SUPPRESS)
    return parser.parse_args()


def _build(bench: Path, folder: Path) -> dict[str, list[str]]:
    """Return the command line of each C++ solver that could be built."""
    for command in (["cmake", "-S", str(bench), "-B", str(folder)], ["cmake", "--build", str(folder)]):
        if subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode:
            print("the C++ solvers could not be built and are left out", file=sys.stderr)
            return {}
    count = str(ITERATIONS)
    ceres = [
        "--solver",
        "dense",
        "--jac",
        "cached",
        "--threads",
        "1",
        "--iters",
        count,
        "--ftol",
        "1e-14",
        "--hist",
        "1",
    ]
    return {
        "Ceres": [str(folder / "ceres_solver"), "PROBLEM", *ceres],
        "hand-written C++": [str(folder / "hand_solver_double"), "PROBLEM", count, "1", "1e-14", "1"],
    }


def _measure(size: str, binaries: dict[str, list[str]], options: argparse.Namespace) -> dict[str, Any]:
    """Return rows of one size by solver: times per iteration and energies of the rounds, and the compile time of this
    solver.
    """
    folder = options.out / "problems"
    problem = folder / f"{size}.npz"
    if not problem.exists():
        generate = [sys.executable, str(options.bench / "problems.py"), size, "--seed", str(options.seed)]
        subprocess.run([*generate, "--out", str(folder)], check=True, stdout=subprocess.DEVNULL)
    workers = {name: Worker(problem, flags) for name, flags in OURS.items()}
    rows: dict[str, Any] = {name: {"ms": [], "compile_s": worker.compile_seconds} for name, worker in workers.items()}
    rows |= {name: {"ms": []} for name in binaries}
    for _ in range(options.rounds):
        answers = {name: worker.run() for name, worker in workers.items()}
        answers |= {name: _peer(command, problem) for name, command in binaries.items()}
        for name, answer in answers.items():
            rows[name]["ms"].append(answer["ms"])
            rows[name]["history"] = answer["history"]
    for worker in workers.values():
        worker.close()
    if options.jaxls_python:
        rows["jaxls"] = _jaxls(options, folder, size)
    return rows


def _peer(command: list[str], problem: Path) -> dict[str, Any]:
    binary = str(problem.with_suffix(".bin"))
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    words = [binary if word == "PROBLEM" else word for word in command]
    text = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True, env=environment).stdout
    *lines, last = text.splitlines()
    summary = json.loads(last)
    history = [float(found) for line in lines for found in re.findall(r"cost (\S+)", line)]
    if len(history) == summary["iters"]:  # the energy of the start is missing
        history = [summary["c0"], *history]
    return {"ms": summary["ms_per_iter"], "history": history}


def _jaxls(options: argparse.Namespace, folder: Path, size: str) -> dict[str, Any]:
    command = [str(options.jaxls_python), str(options.bench / "jaxls_solver.py"), size, "dense_cholesky"]
    environment = {**os.environ, "PROBLEMS": str(folder.resolve())}
    text = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment).stdout
    found = json.loads(text.splitlines()[-1])
    return {"ms": [found["ms_per_iter"]], "history": [found["c0"], found["c1"]], "compile_s": found["compile_ms"] / 1e3}


def _work(path: Path, flags: dict[str, Any]) -> None:
    """Compile, print how long it took, then run once for every line of standard input."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

    from vggtgeo.bundle.problem_file import load_problem
    from vggtgeo.bundle.solution import solve
    from vggtgeo.geometry.camera_models import Pinhole

    problem, state, _ = load_problem(path, flags.get("dtype", "float64"))
    problem = dataclasses.replace(problem, positive_depth=flags.get("positive_depth", False))
    if flags.get("derived"):
        # The hand-written derivatives serve the pinhole itself; a subclass gets automatic derivatives.
        problem = dataclasses.replace(problem, camera=type("AnyPinhole", (Pinhole,), {}))
    correction = flags.get("max_correction", SchurLevenbergMarquardt.max_correction)
    solver = SchurLevenbergMarquardt(max_iterations=ITERATIONS, rtol=0.0, max_correction=correction)
    start = time.perf_counter()
    run = jax.jit(lambda problem, state: solve(problem, state, solver=solver)).lower(problem, state).compile()
    print(json.dumps({"compile_s": time.perf_counter() - start}), flush=True)
    for _ in sys.stdin:
        start = time.perf_counter()
        solution = jax.block_until_ready(run(problem, state))
        seconds = time.perf_counter() - start
        count = int(solution.iterations)
        history = np.asarray(solution.history, float)[: count + 1].tolist()
        print(json.dumps({"ms": 1e3 * seconds / count, "history": history}), flush=True)


def _best(rows: dict[str, Any]) -> float:
    """Return the least energy of the rows in double precision."""
    return min(min(row["history"]) for name, row in rows.items() if "float32" not in name)


def _table(size: str, rows: dict[str, Any]) -> str:
    best = _best(rows)
    reference = rows.get("Ceres")
    lines = [
        f"{size}: best energy {best:.9e}",
        "",
        "| solver | ms per iteration | times faster than Ceres | energy after 50, above best | above Ceres after 50 "
        "| most above Ceres, iterations 2 to 50 | iterations, ms to 1e-4 | compile s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        ms = float(np.median(row["ms"]))
        history = np.asarray(row["history"])
        near = np.nonzero(history <= best * (1 + 1e-4))[0]
        reached = f"{near[0]}, {near[0] * ms:.0f}" if len(near) and len(history) > 2 else "-"
        cells = [name, f"{ms:.2f}", "-", f"{history[-1] / best - 1:.1e}", "-", "-", reached]
        if reference and name != "Ceres":
            pairs = min(len(row["ms"]), len(reference["ms"]))
            cells[2] = f"{np.median(np.divide(reference['ms'][:pairs], row['ms'][:pairs])):.1f}"
            theirs = np.asarray(reference["history"])
            cells[4] = f"{history[-1] / theirs[-1] - 1:.1e}"
            common = min(len(history), len(theirs))
            cells[5] = f"{np.max(history[2:common] / theirs[2:common] - 1):.1e}" if common > 2 else "-"
        cells.append(f"{row['compile_s']:.1f}" if "compile_s" in row else "-")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _draw(results: dict[str, Any], path: Path) -> None:
    """Draw the energy above the best known against time, one panel for each size."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(
        1, len(results), figsize=(5 * len(results), 4), layout="constrained", squeeze=False
    )
    for axes, (size, rows) in zip(panels[0], results.items(), strict=True):
        best = _best(rows)
        for name, row in rows.items():
            above = np.asarray(row["history"]) / best - 1
            if len(above) > 2:
                axes.loglog(np.arange(1, len(above)) * np.median(row["ms"]), above[1:].clip(1e-9), label=name)
        axes.set(xlabel="ms", ylabel="energy / best - 1", title=size)
        axes.grid(alpha=0.3)
    panels[0][0].legend(fontsize=8)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
