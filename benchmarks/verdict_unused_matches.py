"""Match keyframes that the map has not linked, and measure what these matches would add to the verdict.

    .venv/bin/python benchmarks/verdict_unused_matches.py [--bank runs/verdict-bank] [--pairs 60] [--verbose]

For each run of `verdict_bank.py`, up to `--pairs` pairs of keyframes without a match in the map are matched by SIFT,
the most similar views first. RANSAC finds the pose of the second relative to the first, from the points whose depth the
map has. A pair is reliable with 30 inliers that are half of its matches, as for a relocalisation. It contradicts the
run where the positions differ by more than two standard deviations and by more than the thresholds (`thresholds.py`). A
run is doubted where at least three pairs are reliable and most of them contradict it. Prints the numbers of wrong and
right runs that are doubted, and how many of them the verdict called good.
"""

from __future__ import annotations

import argparse
import json
import pickle
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from vggtgeo.models.classical import SiftMatcher

from vggtgeo.geometry import rigid
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.thresholds import MAX_PLACE_ERROR, MAX_PLACE_ERROR_SHARE, SIGMAS

MIN_INLIERS, MIN_SHARE, MIN_PAIRS = 30, 0.5, 3
MAX_ERROR = 2.5
"""Largest error of an inlier, pixels."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", type=Path, default=Path("runs/verdict-bank"))
    parser.add_argument("--pairs", type=int, default=60, help="pairs to match in each run")
    parser.add_argument("--verbose", action="store_true", help="print each run with a reliable pair")
    options = parser.parse_args()
    matcher, found = SiftMatcher(), []
    cv2.setRNGSeed(0)
    for state in sorted(options.bank.glob("*/slam.pkl")):
        known = json.loads((state.parent / "outcome.json").read_text())
        contradict = contradictions(pickle.loads(state.read_bytes()), matcher, options.pairs)
        doubted = len(contradict) >= MIN_PAIRS and np.mean(contradict) > 0.5
        found.append((known["outcome"], known.get("level"), len(contradict) > 0, doubted))
        if options.verbose and contradict:
            share = f"{sum(contradict)} of {len(contradict)} pairs contradict it"
            print(f"{state.parent.name}: {known['outcome']}, called {known.get('level')}, {share}", flush=True)
    print("| outcome | runs | with reliable pairs | doubted | of these called good |\n|---|---|---|---|---|")
    for outcome in ("wrong", "mild", "good"):
        own = [row for row in found if row[0] == outcome]
        silent = sum(level == "good" and doubted for _, level, _, doubted in own)
        print(f"| {outcome} | {len(own)} | {sum(row[2] for row in own)} | {sum(row[3] for row in own)} | {silent} |")


def contradictions(slam: Slam, matcher: SiftMatcher, most: int) -> list[bool]:
    """Return, for each reliable pair, whether it contradicts the run."""
    linked = {pair.key for pair in slam.map.pairs if len(pair.points.index_i)}
    centres = np.array([rigid.centre(keyframe.pose) for keyframe in slam.keyframes])
    extent = float(np.sqrt(np.mean(np.sum((centres - centres.mean(0)) ** 2, axis=1)))) if len(centres) else 0.0
    matters = MAX_PLACE_ERROR if slam.metric else MAX_PLACE_ERROR_SHARE * extent

    def change(pair: tuple[Keyframe, Keyframe]) -> float:
        places = np.linalg.norm(rigid.centre(pair[0].pose) - rigid.centre(pair[1].pose))
        return float(rigid.angle_between(pair[0].pose, pair[1].pose) + 0.3 * places / max(extent, 1e-9))

    pairs = [pair for pair in combinations(slam.keyframes, 2) if (pair[0].number, pair[1].number) not in linked]
    found = []
    for first, second in sorted(pairs, key=change)[:most]:
        measured = _measured(first, second, matcher, slam.intrinsics)
        if measured is not None:
            relative, sigma = measured
            claim = second.pose @ rigid.invert(first.pose)
            off = np.linalg.norm(rigid.centre(relative) - rigid.centre(claim))
            found.append(bool(off - SIGMAS * sigma > matters))
    return found


def _measured(
    first: Keyframe, second: Keyframe, matcher: SiftMatcher, intrinsics: np.ndarray
) -> tuple[np.ndarray, float] | None:
    """Return the motion first -> second [4, 4] and the deviation of its translation; None if it is not reliable."""
    matches = matcher.match(first.features, second.features)
    inverse = first.points.inverse_depth[matches.index_i]
    known = np.isfinite(inverse) & (inverse > 0)
    if np.count_nonzero(known) < MIN_INLIERS:
        return None
    rays = (matches.pixels_i[known] - intrinsics[2:]) / intrinsics[:2]
    points = np.column_stack([rays, np.ones(len(rays))]) / inverse[known, None]
    (fx, fy, cx, cy), pixels = intrinsics, matches.pixels_j[known]
    camera = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points, pixels, camera, None, iterationsCount=300, reprojectionError=MAX_ERROR
    )
    if not found or inliers is None or len(inliers) < max(MIN_INLIERS, MIN_SHARE * len(pixels)):
        return None
    points, pixels = points[inliers[:, 0]], pixels[inliers[:, 0]]
    turn, shift = cv2.solvePnPRefineLM(points, pixels, camera, None, turn, shift)
    expected, jacobian = cv2.projectPoints(points, turn, shift, camera, None)
    noise = max(1.48 * float(np.median(np.abs(expected[:, 0] - pixels))), 0.3)
    covariance = noise**2 * np.linalg.inv(jacobian[:, :6].T @ jacobian[:, :6])
    variance = np.trace(covariance[3:, 3:]) + np.trace(covariance[:3, :3]) * float(np.sum(shift**2))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return motion, float(np.sqrt(variance))


if __name__ == "__main__":
    main()
