"""Compare robust kernels and second-order corrections: pose errors with 0 to 40 % of false matches, simulated.

    .venv/bin/python benchmarks/robustness.py [--seeds 5] [--size small] [--tables kernels corrections lines]
        [--out runs/robustness] [--bench ../shared/bench]

The problems are those of `problems.py`, with false matches of two kinds: *near* (10 to 60 px wrong; lines turned too)
and *gross* (anywhere in the image). All kernels have a width of 1.5 px. Columns: median over the seeds of the RMSE of
the camera centres in mm at the end of `solve` (at most 50 iterations), for each share of false matches; in brackets the
worst seed and the mean number of iterations. Rows marked *graduated* go through wider kernels first. The second table
compares, on Huber and Cauchy, plain reweighting, the whole correction of Triggs (0.95 of it), and the adaptive part of
it that is the default. The third compares lines with one inverse depth per sample with lines of two ends.
"""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from scipy.spatial.transform import Rotation

import vggtgeo as vg

SHARES = (0.0, 0.1, 0.2, 0.3, 0.4)
KINDS = {"near": "offset", "gross": "uniform"}
KERNELS: dict[str, Callable[[], Any]] = {
    "Huber": vg.kernels.Huber,
    "Cauchy": vg.kernels.Cauchy,
    "Geman-McClure": vg.kernels.GemanMcClure,
    "Barron, alpha = -1": lambda: vg.kernels.Barron(alpha=-1.0),
}
ITERATIONS = 50
TABLES = ("kernels", "corrections", "lines")
Problems = dict[tuple[str, float], list[tuple[Any, Any, np.ndarray]]]


def main() -> None:
    """Solve every problem with every setting and print the tables."""
    options = _options()
    jax.config.update("jax_enable_x64", True)
    problems = _problems(options)
    tables = {"kernels": _kernels, "corrections": _corrections, "lines": _lines}
    options.out.mkdir(parents=True, exist_ok=True)
    written: list[str] = []
    for name in options.tables:
        for row in tables[name](problems, options):
            print(row, flush=True)
            written.append(row)
        written.append("")
    (options.out / "robustness.md").write_text("\n".join(written))


def _kernels(problems: Problems, options: argparse.Namespace) -> Iterator[str]:
    del options
    yield _header("kernel")
    for name, kernel in KERNELS.items():
        for graduation in (None, vg.Graduation()):
            label = name + (", graduated" if graduation else "")
            solver = vg.SchurLevenbergMarquardt(max_iterations=ITERATIONS)
            yield _row(label, problems, kernel(), solver, graduation)


def _corrections(problems: Problems, options: argparse.Namespace) -> Iterator[str]:
    del options
    yield _header("correction")
    corrections = {
        "plain reweighting": {"max_correction": 0.0},
        "Triggs": {"fixed_correction": True},
        "adaptive": {},
    }
    for name in ("Huber", "Cauchy"):
        for label, flags in corrections.items():
            solver = vg.SchurLevenbergMarquardt(max_iterations=ITERATIONS, **flags)
            yield _row(f"{name}, {label}", problems, KERNELS[name](), solver, None)


def _lines(problems: Problems, options: argparse.Namespace) -> Iterator[str]:
    yield _header("lines")
    for label, ends in (("a depth a sample", False), ("two ends", True)):
        chosen = _problems(options, ends) if ends else problems
        for name in ("Huber", "Cauchy"):
            solver = vg.SchurLevenbergMarquardt(max_iterations=ITERATIONS)
            yield _row(f"{name}, {label}", chosen, KERNELS[name](), solver, None)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bench", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "bench")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--size", default="small")
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--out", type=Path, default=Path("runs/robustness"))
    return parser.parse_args()


def _problems(options: argparse.Namespace, two_ends: bool = False) -> Problems:
    """Yield `(problem, initial, true poses)` of each seed, by kind and share."""
    spec = importlib.util.spec_from_file_location("problems", options.bench / "problems.py")
    if spec is None or spec.loader is None or not (options.bench / "problems.py").is_file():
        raise SystemExit(f"`--bench` must be a folder with problems.py, got {options.bench}")
    generator = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generator)
    folder = options.out / "problems"
    folder.mkdir(parents=True, exist_ok=True)
    found: Problems = {}
    for kind, how in KINDS.items():
        for share in SHARES:
            found[kind, share] = []
            for seed in range(options.seeds):
                path = folder / f"{options.size}-{how}-{share}-{seed}{'-ends' * two_ends}.npz"
                if not path.exists():
                    arrays = generator.generate(options.size, seed, how, share)
                    np.savez(path, **arrays, **({"var_segment": _segments(arrays)} if two_ends else {}))
                problem, initial, _ = vg.load_problem(path)
                found[kind, share].append((problem, initial, np.load(path)["T_gt"]))
    return found


def _segments(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Return the segment of each landmark: after the points come line samples, by keyframe, segment and sample."""
    keyframes, points, segments, samples = arrays["sizes"]
    number = np.repeat(np.arange(keyframes * segments), samples)
    return np.concatenate([np.full(keyframes * points, -1), number])


def _header(first: str) -> str:
    columns = [f"{kind} {share:.0%}" for kind in KINDS for share in SHARES]
    return "\n".join(["| " + " | ".join([first, *columns]) + " |", "|---" * (len(columns) + 1) + "|"])


def _row(label: str, problems: Problems, kernel: Any, solver: Any, graduation: Any) -> str:
    run: Callable[..., Any] = jax.jit(
        lambda problem, initial: vg.solve(problem, initial, solver=solver, graduation=graduation)
    )
    cells = []
    for entries in problems.values():
        errors, iterations = [], []
        for problem, initial, truth in entries:
            robust = (*problem.edge_terms, *problem.slot_terms)
            changed = {term.name: eqx.tree_at(lambda t: t.kernel, term, kernel) for term in robust}
            terms = tuple(changed.get(term.name, term) for term in problem.terms)
            solution = run(problem.with_terms(terms), initial)
            errors.append(_position_error(np.asarray(solution.state.poses.wxyz_xyz), truth))
            iterations.append(int(solution.iterations))
        cells.append(f"{np.median(errors):.1f} ({np.max(errors):.0f}; {np.mean(iterations):.0f} it.)")
    return "| " + " | ".join([label, *cells]) + " |"


def _position_error(poses: np.ndarray, truth: np.ndarray) -> float:
    """Return the RMSE of the camera centres, mm; the first pose is fixed at the true one, the scale by the depth
    priors.
    """
    centres = [-Rotation.from_quat(p[:, [1, 2, 3, 0]]).inv().apply(np.array(p[:, 4:])) for p in (poses, truth)]
    return 1e3 * float(np.sqrt(np.mean(np.sum((centres[0] - centres[1]) ** 2, 1))))


if __name__ == "__main__":
    main()
