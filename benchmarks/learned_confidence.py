"""Compare a confidence learned through bundle adjustment with uniform, saliency and oracle weights, on held-out
windows.

    python benchmarks/learned_confidence.py
    python benchmarks/learned_confidence.py --slide 5 --seeds 3 --steps 100
    python benchmarks/learned_confidence.py --slide 5 --seeds 3 --steps 100
        --clips ../shared/data/redkitchen ../shared/data/building-walk --held-out ../shared/data/corridor-office

Each seed trains one network (`vggtgeo.learning`) on the same training windows, and compares it on windows of rooms and
offices outside the training set. Everything is simulated, unless clips with depth and true poses are given.

With `--slide` the loss is the pose error after that many slid windows (`vggtgeo.slide`). Clips are adjusted without
their depth, in the unit of the distance between the first two keyframes: depth only tells which matches are right, and
the start of the inverse depths.

Writes `NAME.png` and `NAME.json` into `--out` (`learned-confidence`, `slid-confidence`) and prints the table.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

import vggtgeo as vg
from vggtgeo.io.files import atomic_path, write_json
from vggtgeo.learning import (
    Batch,
    PoseErrors,
    TrackedWindow,
    compare,
    error_and_gradient,
    recorded_windows,
    slid_error_and_gradient,
    stack,
    stack_sequences,
    tracked_windows,
    train,
)
from vggtgeo.learning.training import Judge

TRAINING = (("room", 101), ("office", 102), ("staircase", 103), ("room", 104))
HELD_OUT = (("room", 200), ("office", 300))
"""Training and test scenes; the seed of the comparison is added to their seeds."""
SIZE, FRAMES, WINDOWS = (320, 240), 600, 12
KEYFRAMES, POINTS = 4, 24
METHODS = PoseErrors._fields
NAMES = {"uniform": "uniform", "saliency": "saliency", "learned": "learned", "oracle": "oracle (knows the outliers)"}


def main() -> None:
    """Train and compare, then write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    parser.add_argument(
        "--slide", type=int, default=1, help="number of windows, each solved with the prior of the window before"
    )
    parser.add_argument(
        "--clips", nargs="+", default=[], help="recordings with depth and ground truth for the training"
    )
    parser.add_argument("--held-out", nargs="+", default=[], help="recordings to compare on")
    arguments = parser.parse_args()
    if arguments.clips and (arguments.slide == 1 or not arguments.held_out):
        parser.error("`--clips` needs `--slide` of 2 or more, and `--held-out`")
    jax.config.update("jax_enable_x64", True)
    began = time.perf_counter()
    slid = arguments.slide > 1
    judge = slid_error_and_gradient if slid else error_and_gradient
    training = batch_of(arguments.clips or TRAINING, 0, arguments.slide)
    rows, losses = [], []
    for seed in range(arguments.seeds):
        held_out = batch_of(arguments.held_out or HELD_OUT, seed, arguments.slide)
        errors, loss = one_seed(training, held_out, seed, arguments.steps, judge)
        rows.append(errors)
        losses.append(loss)
        assert np.isfinite(list(errors.values())).all()
        print(seed, {name: round(value, 2) for name, value in errors.items()}, flush=True)
    table = np.array([[row[name] for name in METHODS] for row in rows])
    print(markdown(table))
    facts = {
        "windows": {"training": len(training.truth), "held out per seed": len(held_out.truth)},
        "simulated": not arguments.clips,
    }
    facts |= {"slid": arguments.slide, "loss": np.round(losses, 4).tolist()} if slid else {}
    name = ("slid-confidence-clips" if arguments.clips else "slid-confidence") if slid else "learned-confidence"
    write_json(arguments.out / f"{name}.json", {"error_mm": rows, "steps": arguments.steps, **facts})
    source = "clips, without depth" if arguments.clips else "simulated"
    draw(table, np.array(losses), arguments.out / f"{name}.png", source)
    print(f"{time.perf_counter() - began:.0f} s")


def batch_of(scenes: Sequence[tuple[str, int] | str], seed: int, slide: int) -> Batch:
    """Return the windows of all scenes or clips, stacked; with `slide`, sequences of that many windows."""
    keyframes = KEYFRAMES + slide - 1
    count = WINDOWS // (2 if slide > 1 else 1)
    found: list[TrackedWindow] = []
    for scene in scenes:
        if isinstance(scene, str):
            found += recorded_windows(vg.open_sequence(scene), count, keyframes=keyframes, points=POINTS, seed=seed)
        else:
            name, number = scene[0], scene[1] + seed
            sequence = vg.simulate(name, FRAMES, number, SIZE, rate=10.0)
            found += tracked_windows(sequence, count, keyframes=keyframes, points=POINTS, seed=number)
    if slide == 1:
        return stack(found)
    return stack_sequences(found, KEYFRAMES, depth=not isinstance(scenes[0], str))


def one_seed(
    training: Batch, held_out: Batch, seed: int, steps: int, judge: Judge
) -> tuple[dict[str, float], list[float]]:
    """Return the errors of each method on the held-out windows, millimetres, and the losses of the training."""
    networks, losses = zip(*train(training, seed=seed, steps=steps, judge=judge), strict=True)
    return compare(held_out, networks[-1], judge).to_dict(), list(losses)


def markdown(table: np.ndarray) -> str:
    """Return the mean and standard deviation over the seeds, and by how much the learned confidence is better, seed by
    seed.
    """
    learned = table[:, METHODS.index("learned")]
    lines = ["| confidence | pose error, mm | learned is better by, mm |", "|---|---|---|"]
    for name, column in zip(METHODS, table.T, strict=True):
        ahead = "" if name == "learned" else spread(column - learned)
        lines.append(f"| {NAMES[name]} | {spread(column)} | {ahead} |")
    return "\n".join(lines)


def spread(values: np.ndarray) -> str:
    """Return the mean and the standard deviation as text."""
    return f"{values.mean():.1f} ± {values.std(ddof=1) if len(values) > 1 else 0.0:.1f}"


def draw(table: np.ndarray, losses: np.ndarray, path: Path, source: str) -> None:
    """Draw the errors seed by seed, and the loss during training."""
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
    left.set_title(f"held-out windows, one line per seed ({source})", loc="left", fontsize=10)
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
