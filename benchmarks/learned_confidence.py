"""A confidence learned through bundle adjustment, against uniform, saliency and an oracle, on held-out windows.

    python benchmarks/learned_confidence.py

Everything is simulated. Each of five seeds trains a network of its own (`vggtgeo.learning`) on the same training
windows, and compares it on windows of rooms and offices that nobody else sees. Writes `docs/learned-confidence.png`
and `docs/learned-confidence.json`, and prints the table.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

import vggtgeo as vg
from vggtgeo.io.files import atomic_path, write_json
from vggtgeo.learning import Batch, PoseErrors, TrackedWindow, compare, stack, tracked_windows, train

TRAINING = (("room", 101), ("office", 102), ("staircase", 103), ("room", 104))
HELD_OUT = (("room", 200), ("office", 300))
"""Scenes; the seed of the comparison is added to theirs."""
SIZE, FRAMES, WINDOWS = (320, 240), 600, 12
METHODS = PoseErrors._fields
NAMES = {"uniform": "uniform", "saliency": "saliency", "learned": "learned", "oracle": "oracle (knows the outliers)"}


def main() -> None:
    """Train and compare, then write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    began = time.perf_counter()
    training = stack(windows_of(TRAINING))
    rows, losses = [], []
    for seed in range(arguments.seeds):
        held_out = stack(windows_of([(scene, number + seed) for scene, number in HELD_OUT]))
        errors, loss = one_seed(training, held_out, seed, arguments.steps)
        rows.append(errors)
        losses.append(loss)
        assert np.isfinite(list(errors.values())).all()
        print(seed, {name: round(value, 2) for name, value in errors.items()}, flush=True)
    table = np.array([[row[name] for name in METHODS] for row in rows])
    print(markdown(table))
    facts = {"windows": {"training": len(training.truth), "held out a seed": len(held_out.truth)}, "simulated": True}
    write_json(arguments.out / "learned-confidence.json", {"error_mm": rows, "steps": arguments.steps, **facts})
    draw(table, np.array(losses), arguments.out / "learned-confidence.png")
    print(f"{time.perf_counter() - began:.0f} s")


def windows_of(scenes: list[tuple[str, int]] | tuple[tuple[str, int], ...]) -> list[TrackedWindow]:
    """The windows of all scenes."""
    found: list[TrackedWindow] = []
    for scene, seed in scenes:
        found += tracked_windows(vg.simulate(scene, FRAMES, seed, SIZE, rate=10.0), WINDOWS, seed=seed)
    return found


def one_seed(training: Batch, held_out: Batch, seed: int, steps: int) -> tuple[dict[str, float], list[float]]:
    """Errors of each method on the held-out windows, millimetres, and the losses of the training."""
    networks, losses = zip(*train(training, seed=seed, steps=steps), strict=True)
    return compare(held_out, networks[-1]).to_dict(), list(losses)


def markdown(table: np.ndarray) -> str:
    """Mean and standard deviation over the seeds, and how far the learned confidence is ahead, seed by seed."""
    learned = table[:, METHODS.index("learned")]
    lines = ["| confidence | pose error, mm | learned is ahead by, mm |", "|---|---|---|"]
    for name, column in zip(METHODS, table.T, strict=True):
        ahead = "" if name == "learned" else spread(column - learned)
        lines.append(f"| {NAMES[name]} | {spread(column)} | {ahead} |")
    return "\n".join(lines)


def spread(values: np.ndarray) -> str:
    """Mean and standard deviation."""
    return f"{values.mean():.1f} ± {values.std(ddof=1) if len(values) > 1 else 0.0:.1f}"


def draw(table: np.ndarray, losses: np.ndarray, path: Path) -> None:
    """The errors seed by seed, and the course of the training."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[3, 2])
    colours = {"uniform": "#8a8f98", "saliency": "#c8650b", "learned": "#1f5fbf", "oracle": "#2f7d4f"}
    for x, name in enumerate(METHODS):
        left.plot(np.full(len(table), x), table[:, x], "o", color=colours[name], ms=5, alpha=0.8)
        left.hlines(table[:, x].mean(), x - 0.28, x + 0.28, color=colours[name], lw=2.5)
    for row in table:
        left.plot(range(len(METHODS)), row, color="#bbbbbb", lw=0.7, zorder=0)
    left.set_xticks(range(len(METHODS)), [NAMES[name].split(" (")[0] for name in METHODS])
    left.set_ylabel("pose error after adjustment [mm]")
    left.set_ylim(bottom=0)
    left.set_title("held-out windows, a line a seed (simulated)", loc="left", fontsize=10)
    width = max(losses.shape[1] // 16, 1)
    smooth = np.apply_along_axis(lambda row: np.convolve(row, np.ones(width) / width, "valid"), 1, losses)
    right.plot(1e3 * np.exp(smooth.T), lw=1.2, color=colours["learned"], alpha=0.7)
    right.set_xlabel("step")
    right.set_ylabel("pose error, training [mm]")
    right.set_title(f"training, mean over {width} steps", loc="left", fontsize=10)
    for axes in (left, right):
        axes.grid(color="#e3e3e3", lw=0.7)
        axes.set_axisbelow(True)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=130)


if __name__ == "__main__":
    main()
