"""Measure windows per second for batches of windows: one after the other, in one program, or on several devices.

    .venv/bin/python benchmarks/batches.py [--sizes small medium] [--batches 1 4 16 64] [--precisions float64 float32]
        [--iterations 10] [--rounds 5] [--cpu-devices 2] [--bench ../shared/bench] [--out runs/batches]

Every window of a batch is the problem of `problems.py` from a different start, and takes the same number of iterations.
Modes: *alone* (one `solve` after the other, called from Python), *in turn* (`solve_batch`, the default on a CPU), *in
one program* (`vmap`, the default on a GPU), *shared out* (in turn on each of several devices). Rounds interleave the
modes, and the table has the median. *Alone* and *in turn* are timed on at most 16 windows: the time per window does not
depend on their number, and 4096 windows would take minutes on a GPU. For *in one program* the table also has the
operations and bytes per second, as XLA counts them for one iteration of one window (XLA counts before caches, so the
traffic is an upper bound); `--peak-gflops` and `--peak-gbytes` turn them into fractions of a roofline. On a GPU:
`--batches 1 16 256 4096`.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import vggtgeo as vg

LONE = 16
"""Largest number of windows of a batch that are solved one by one."""
HEADER = (
    "| size | precision | batch | mode | ms per window | windows per second | times one alone "
    "| Gflop/s | GB/s | of roofline |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def main() -> None:
    """Measure every row, print and write the table."""
    options = _options()
    jax.config.update("jax_enable_x64", True)
    if jax.config.jax_platforms in (None, "cpu"):
        jax.config.update("jax_num_cpu_devices", options.cpu_devices)
    options.out.mkdir(parents=True, exist_ok=True)
    print(HEADER, flush=True)
    rows = [
        row for size in options.sizes for precision in options.precisions for row in _rows(size, precision, options)
    ]
    (options.out / "batches.json").write_text(json.dumps(rows, indent=1))
    (options.out / "batches.md").write_text("\n".join([HEADER, *map(_markdown, rows)]) + "\n")
    _draw(rows, options.out / "batches.png")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bench", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "bench")
    parser.add_argument("--sizes", nargs="+", default=["small", "medium"])
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4, 16, 64])
    parser.add_argument("--precisions", nargs="+", default=["float64", "float32"])
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--cpu-devices", type=int, default=2)
    parser.add_argument("--peak-gflops", type=float, help="of the device, in the precision measured")
    parser.add_argument("--peak-gbytes", type=float, help="memory bandwidth of the device, GB/s")
    parser.add_argument("--out", type=Path, default=Path("runs/batches"))
    return parser.parse_args()


def _rows(size: str, precision: str, options: argparse.Namespace) -> list[dict[str, Any]]:
    problem, state = _load(size, precision, options)
    solver = vg.SchurLevenbergMarquardt(max_iterations=options.iterations, rtol=0.0)
    rows = []
    for batch in options.batches:
        problems, states = _batch(problem, state, batch)
        ways = _ways(problems, states, solver, batch)
        times: dict[str, list[float]] = {name: [] for name in ways}
        for run, _ in ways.values():
            jax.block_until_ready(run())
        for _ in range(options.rounds):
            for name, (run, windows) in ways.items():
                start = time.perf_counter()
                jax.block_until_ready(run())
                times[name].append((time.perf_counter() - start) / windows)
        cost = _cost(problems, states, solver, batch)
        for name, seconds in times.items():
            ratio = float(np.median(np.divide(times["alone"], seconds)))
            row = {"size": size, "precision": precision, "batch": batch, "way": name, "ms": 1e3 * np.median(seconds)}
            row |= {"times_alone": ratio}
            if name == "in one program":
                row |= _rates(cost, float(np.median(seconds)), options)
            rows.append(row)
            print(_markdown(row), flush=True)
    return rows


def _load(size: str, precision: str, options: argparse.Namespace) -> tuple[Any, Any]:
    path = options.out / f"{size}.npz"
    if not path.exists():
        source = options.bench / "problems.py"
        spec = importlib.util.spec_from_file_location("problems", source)
        if spec is None or spec.loader is None or not source.is_file():
            raise SystemExit(f"`--bench` must be a folder with problems.py, got {options.bench}")
        generator = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(generator)
        np.savez(path, **generator.generate(size))
    problem, state, _ = vg.load_problem(path, precision)
    return problem, state


def _batch(problem: Any, state: Any, count: int) -> tuple[Any, Any]:
    """Return the problem `count` times, and different inverse depths to start each from."""
    noise = np.random.default_rng(0).normal(0, 0.05, (count, *state.inverse_depth.shape))
    starts = state.inverse_depth * jnp.exp(jnp.asarray(noise, state.inverse_depth.dtype))
    repeat = lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf)))
    states = eqx.tree_at(lambda s: s.inverse_depth, jax.tree.map(repeat, state), starts)
    return jax.tree.map(repeat, problem), states


def _ways(problems: Any, states: Any, solver: Any, count: int) -> dict[str, tuple[Callable[[], Any], int]]:
    """Return, by name, functions that solve the windows, and how many windows each solves."""
    few = min(count, LONE)
    first = jax.tree.map(lambda leaf: leaf[:few], (problems, states))
    one = jax.jit(lambda problem, state: vg.solve(problem, state, solver=solver).energy)
    singles = [jax.tree.map(lambda leaf, n=n: leaf[n], first) for n in range(few)]
    batched = lambda **how: jax.jit(lambda p, s: vg.batches.solve_batch(p, s, solver=solver, **how).energy)
    in_turn, together = batched(at_once=1), batched(at_once=count)
    ways: dict[str, tuple[Callable[[], Any], int]] = {
        "alone": (lambda: [one(*single).block_until_ready() for single in singles], few),
        "in turn": (lambda: in_turn(*first), few),
        "in one program": (lambda: together(problems, states), count),
    }
    devices = tuple(jax.devices())
    if len(devices) > 1 and count % len(devices) == 0:
        shared = batched(devices=devices)
        ways["shared out"] = lambda: shared(problems, states), count
    return ways


def _cost(problems: Any, states: Any, solver: Any, count: int) -> dict[str, float]:
    """Return operations and bytes of one iteration of one window, as XLA counts those of the compiled program."""
    single = eqx.tree_at(lambda s: s.max_iterations, solver, 1)
    run = jax.jit(lambda p, s: vg.batches.solve_batch(p, s, solver=single, at_once=count).energy)
    found = run.lower(problems, states).compile().cost_analysis() or {}
    return {"flops": found.get("flops", 0.0) / count, "bytes": found.get("bytes accessed", 0.0) / count}


def _rates(cost: dict[str, float], seconds: float, options: argparse.Namespace) -> dict[str, float]:
    """Return operations and bytes per second, and their fractions of the roofline where the peaks are given."""
    rate = options.iterations / seconds / 1e9
    rates = {"gflops": cost["flops"] * rate, "gbytes": cost["bytes"] * rate}
    if options.peak_gflops and options.peak_gbytes:
        floor = max(cost["flops"] / options.peak_gflops, cost["bytes"] / options.peak_gbytes) / 1e9
        rates["roofline"] = floor * options.iterations / seconds
    return rates


def _markdown(row: dict[str, Any]) -> str:
    cells = [row["size"], row["precision"], str(row["batch"]), row["way"], f"{row['ms']:.2f}", f"{1e3 / row['ms']:.0f}"]
    cells.append(f"{row['times_alone']:.2f}")
    cells += [f"{row[name]:.1f}" if name in row else "" for name in ("gflops", "gbytes")]
    cells.append(f"{row['roofline']:.0%}" if "roofline" in row else "")
    return "| " + " | ".join(cells) + " |"


def _draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw windows per second against the size of the batch."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    kinds = sorted({(row["size"], row["precision"]) for row in rows})
    figure, panels = pyplot.subplots(1, len(kinds), figsize=(4 * len(kinds), 3.6), layout="constrained", squeeze=False)
    for axes, (size, precision) in zip(panels[0], kinds, strict=True):
        for way in dict.fromkeys(row["way"] for row in rows):
            here = [r for r in rows if (r["size"], r["precision"], r["way"]) == (size, precision, way)]
            axes.plot([r["batch"] for r in here], [1e3 / r["ms"] for r in here], "o-", label=way)
        axes.set(xscale="log", xlabel="windows in the batch", ylabel="windows per second", title=f"{size}, {precision}")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    panels[0][0].legend(fontsize=8)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
