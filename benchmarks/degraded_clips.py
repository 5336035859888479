"""Degrade clips, run them and print a table: shared by several benchmarks."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

import vggtgeo as vg
from vggtgeo.benchmark.inputs import RenderedWalk
from vggtgeo.datasets.views import SequenceView
from vggtgeo.io.errors import InputWarning
from vggtgeo.simulation.degradations import Degradation, Recording


def degraded_clips(
    folder: Path, count: int, changes: Mapping[str, Degradation], depth_alone: bool = False
) -> Iterator[tuple[str, SequenceView]]:
    """Yield the first frames of a clip with each change applied: with depth where the clip has it, and without depth
    except for the changes of `depth_alone`.
    """
    clip = vg.read(folder)
    truth = clip.ground_truth()
    if truth is None:
        raise SystemExit(f"`clips` must have a ground truth, got {folder}")
    if depth_alone and not clip.has_depth:
        raise SystemExit(f"`clips` must have depth to change, got {folder}")
    frames = list(clip.frames(0, min(count, len(clip))))
    for name, change in changes.items():
        changed = change(Recording(frames, clip.camera, truth), np.random.default_rng(0))
        walk = RenderedWalk(clip.name, changed)
        inputs = (True,) if depth_alone else (True, False) if clip.has_depth else (False,)
        for has_depth in inputs:
            yield name, SequenceView(walk, clip.camera, has_depth)


def judged(sequence: SequenceView, settings: vg.SlamSettings | None = None) -> tuple[vg.Result, float]:
    """Return the result and its ATE: metres, after SE(3) with depth, after Sim(3) without; NaN where nothing was
    tracked.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        result = vg.reconstruct(sequence, settings=settings, options=vg.RunOptions(dense="none"))
    truth = result.summary.get("truth")
    alignment = "ate_se3_m" if sequence.has_depth else "ate_sim3_m"
    return result, truth[alignment]["rmse"] if truth else float("nan")


def print_table(
    text: str | None,
    changes: Mapping[str, Degradation],
    columns: tuple[str, ...],
    cells: Callable[[SequenceView], Iterable[str]],
    depth_alone: bool = False,
) -> None:
    """Print a row for each clip of the command line, change, and input (with and without depth).

    text: docstring of the benchmark. columns: headings of the cells that `cells` returns for a sequence.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument(
        "--changes", nargs="*", choices=changes, default=list(changes), help="which changes to apply, by default all"
    )
    options = parser.parse_args()
    changes = {name: changes[name] for name in options.changes}
    print(f"| {' | '.join(('clip', 'input', 'change', *columns))} |\n" + "|---" * (3 + len(columns)) + "|")
    for folder in options.clips:
        for name, sequence in degraded_clips(folder, options.frames, changes, depth_alone):
            kind = "RGB-D" if sequence.has_depth else "RGB"
            print(f"| {' | '.join((sequence.name, kind, name, *cells(sequence)))} |", flush=True)
