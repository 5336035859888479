"""Measure what the verdict cannot detect: whether the true fault explains the corner tracks better than the run does.

    .venv/bin/python benchmarks/verdict_oracle.py RUN... [--out runs/verdict-bank]

The runs are those that `verdict_bank.py judge --verbose` prints. For each, a table has a row for each window:

- run, corners: RMS distance of the run's positions, and of those that the verdict's corners prefer, from the true ones
  after alignment, in the worst window, cm (without depth % of its extent). The verdict compares the difference of both
  with 5 cm (without depth with 6 % of the extent).
- gain of the fault: minus twice the log likelihood ratio of an adjustment with the true parameters of the simulated
  fault, poses free, to one without any fault, with the number of observations that count as one. It needs no estimate.
  Below 28 it is chance at the verdict's level, 10^-6: nothing in the corner tracks shows the fault.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from verdict_bank import read

from vggtgeo.compilation.process_settings import in_double_precision, program_settings
from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.slam.verdict.alternatives import START, explain, scores, with_own_noise
from vggtgeo.slam.verdict.claim import KNOTS, Claim, Tracks, extent, tracks_of_windows
from vggtgeo.slam.verdict.corner_adjustment import (
    DRIFT,
    FOCAL,
    OFFSET,
    RADIAL,
    SIZE,
    Unknowns,
    solve,
    start_of,
)
from vggtgeo.slam.verdict.judge import aligned

Truth = tuple[np.ndarray, np.ndarray]
"""Weights of the knots, [m, KNOTS], instead of those linear in time, and `theta`."""


@dataclass(frozen=True, eq=False)
class WithTruth(Tracks):
    """Corner tracks with a known fault: its weights may be any function of the observation."""

    shares: np.ndarray

    @property
    def knots(self) -> np.ndarray:  # type: ignore[override]
        """Return the given weights."""
        return self.shares


def truth_of(case: dict[str, Any], tracks: Tracks, numbers: np.ndarray) -> Truth | None:
    """Return the true effect of the fault on these corners; None for a fault without parameters. numbers: of the
    window's frames.
    """
    between = lambda least, most: least * (most / least) ** case["severity"]
    shares, theta, frame = np.zeros((len(tracks.frame), KNOTS)), np.zeros(SIZE), numbers[tracks.frame]
    name, count, depth = case["degradation"], case["given_frames"], np.nan_to_num(tracks.depth)
    if name == "other_lens":
        shares[:, 0] = frame >= count // 2
        theta[FOCAL.start] = np.log(1 + between(0.03, 0.7))
    elif name == "distortion":
        theta[RADIAL] = -between(0.02, 0.35)
    elif name == "depth_drift":
        shares[:, 0], theta[DRIFT.start] = np.log1p(between(0.03, 0.6) * frame / count), 1.0
    elif name == "depth_bent":
        bend = between(0.01, 0.3) / 2.0
        true = (np.sqrt(1 + 4 * bend * depth) - 1) / (2 * bend)  # measured: true (1 + bend true)
        shares[:, 0], theta[DRIFT.start] = np.log1p(bend * true), 1.0
    elif name == "depth_offset":
        theta[OFFSET] = between(0.02, 0.8)
    elif name == "centimetres":
        shares[:, 0], theta[DRIFT.start] = 1.0, np.log(0.1)
    else:
        return None
    return shares, theta


@dataclass(frozen=True)
class Window:
    """True errors of the run and of the preferred motion in one window, and the gain of the fault."""

    run: float
    corners: float
    gain: float


def window(case: dict[str, Any], tracks: Tracks, claim: Claim, true: np.ndarray) -> Window:
    """Compare one window. true: float64 [f, 4, 4], camera -> world, of its frames."""
    best = explain(tracks).best
    start = replace(START, pixel=START.pixel * max(tracks.size) / 320.0)
    free = with_own_noise(solve(tracks, start_of(tracks), start))
    there, metric = rigid.centres(tracks.poses), bool(np.isfinite(tracks.depth).any())
    fitted = umeyama(true[:, :3, 3], there, not metric)
    poses = rigid.invert(fitted.trajectory(Trajectory(tracks.times, true)).poses)
    unit = 0.01 if metric else 0.01 * extent(tracks.poses)
    errors = (_distance(found, poses, not metric) / unit for found in (tracks.poses, best.unknowns.poses))
    truth, gain = truth_of(case, tracks, claim.frames[tracks.rows]), 0.0
    if truth is not None:
        shares, theta = truth
        own = {one.name: getattr(tracks, one.name) for one in fields(tracks)}
        planted = WithTruth(**own, shares=shares)
        starts = (replace(free.unknowns, theta=theta), replace(_started(tracks, poses), theta=theta))
        fits = [solve(planted, one, free.noise, steps=40) for one in starts]
        plain = solve(tracks, free.unknowns, free.noise, steps=40)
        gain = plain.energy - min(fit.energy for fit in fits)
    elif case["degradation"] == "cut":
        gain = free.energy - solve(tracks, _started(tracks, poses), free.noise).energy
    return Window(*errors, gain / scores(free).as_one)


def _distance(poses: np.ndarray, true: np.ndarray, with_scale: bool) -> float:
    places, there = rigid.centres(poses), rigid.centres(true)
    return float(np.sqrt(np.mean(np.sum((umeyama(places, there, with_scale).points(places) - there) ** 2, 1))))


def _started(tracks: Tracks, poses: np.ndarray) -> Unknowns:
    """Triangulate the points again from other poses, in the coordinates of the claimed ones."""
    points = start_of(replace(tracks, poses=poses)).points
    local = np.column_stack([points[:, :2], np.ones(len(points))]) * np.exp(-points[:, 2:])
    anchor = tracks.frame[tracks.first]
    moved = tracks.poses[anchor] @ rigid.invert(poses[anchor])
    inside = np.einsum("tij,tj->ti", moved[:, :3, :3], local) + moved[:, :3, 3]
    z = np.maximum(inside[:, 2], 1e-3)
    return Unknowns(poses, np.column_stack([inside[:, :2] / z[:, None], -np.log(z)]), np.zeros(SIZE))


def row(name: str, out: Path) -> str:
    """Return a row of the table."""
    case, truth = json.loads((out / name / "case.json").read_text()), np.load(out / name / "truth.npz")
    slam, evidence = (read(out / name / f"{part}.pkl") for part in ("slam", "evidence"))
    claim = Claim.of(slam)
    corners = aligned(slam, claim, evidence)
    found = []
    if corners is not None:
        row_of = {int(frame): place for place, frame in enumerate(truth["frames"])}
        true = truth["poses"][[row_of[int(frame)] for frame in claim.frames]]
        height, width = slam.keyframes[0].size
        for tracks in tracks_of_windows(claim, corners, (width, height)):
            found.append(window(case, tracks, claim, true[tracks.rows]))
    cells = [f"{max(getattr(each, field) for each in found):.3g}" for field in ("run", "corners", "gain") if found]
    return f"| {name} | {case['outcome']} | {100 * case['ate']:.1f} | {' | '.join(cells or ['-'] * 3)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="names of runs of the bank")
    parser.add_argument("--out", type=Path, default=Path("runs/verdict-bank"))
    options = parser.parse_args()
    print("| run | outcome | ATE, cm | run | corners | gain of the fault |")
    print("|---|---|---|---|---|---|", flush=True)
    for name in options.runs:
        with program_settings():
            print(in_double_precision(row)(name, options.out), flush=True)


if __name__ == "__main__":
    main()
