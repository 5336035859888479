"""Compare the measured depth of a clip with matches that are triangulated between its true poses.

    .venv/bin/python benchmarks/depth_at_true_poses.py ../shared/data/icl-office-kt0 ../shared/data/icl-office

SIFT features of every fifth frame are matched with the next seven of these, where the camera moved by 3 cm or more.
Prints for each range of depth the number of matches, their share of the information on the scale of the path, and the
median of the triangulated over the measured depth, weighted by that information. 1 is right; above it the measured
depth is too short, and the path of a run with this depth is too small, too.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
from vggtgeo.models.classical import SiftMatcher

from vggtgeo.datasets import Sequence, open_sequence
from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, nearest_in_time
from vggtgeo.geometry import pinhole, rigid

RANGES = np.array([0.3, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 8.0])
"""Limits of the ranges of depth, metres."""
EVERY, NEXT, MIN_BASELINE = 5, 7, 0.03
MAX_ERROR = 8.0
"""Pixels between a match and the projection with the measured depth; more is a wrong match, or an edge of the depth."""


def main() -> None:
    """Print a table for each clip."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="+", type=Path)
    for clip in parser.parse_args().clips:
        depth, ratio, information = np.concatenate(list(_compared(open_sequence(clip))), axis=1)
        print(f"\n{clip.name}: depth, m | matches | information, % | triangulated / measured")
        for low, high in (*pairwise(RANGES), (RANGES[0], RANGES[-1])):
            own = (depth >= low) & (depth < high)
            if np.count_nonzero(own) > 20:
                share = 100 * information[own].sum() / information.sum()
                median = np.quantile(ratio[own], 0.5, weights=information[own], method="inverted_cdf")
                print(f"{low} to {high} | {np.count_nonzero(own)} | {share:.0f} | {median:.3f}")


def _compared(sequence: Sequence) -> Iterator[np.ndarray]:
    """Yield the matches of each pair, float64 [3, m]: measured depth, triangulated over measured, information."""
    truth, matcher, intrinsics = sequence.ground_truth(), SiftMatcher(), np.array(sequence.camera.intrinsics)
    frames = [frame for frame in islice(sequence.frames(), 0, None, EVERY) if frame.depth is not None]
    times = np.array([frame.timestamp for frame in frames])
    timed, rows = nearest_in_time(times, truth.timestamps, MAX_TIME_DIFFERENCE)
    frames, poses = [frames[k] for k in timed], rigid.invert(truth.poses[rows])
    features = [matcher.describe(frame.image) for frame in frames]
    for first in range(len(frames)):
        for second in range(first + 1, min(first + 1 + NEXT, len(frames))):
            relative = poses[second] @ rigid.invert(poses[first])
            if np.linalg.norm(relative[:3, 3]) < MIN_BASELINE:
                continue
            found = matcher.match(features[first], features[second])
            depth = pinhole.at_pixels(frames[first].depth, found.pixels_i).astype(np.float64)
            depth = np.where(depth > 0, depth, np.nan)
            predicted = rigid.project(
                rigid.unproject(found.pixels_i, 1 / depth, np.eye(4), intrinsics), relative, intrinsics
            )
            inverse, information = rigid.triangulate(found.pixels_i, found.pixels_j, relative, intrinsics)
            good = (np.linalg.norm(predicted - found.pixels_j, axis=1) < MAX_ERROR) & (inverse > 0)
            # The scale `s` of the path moves the inverse depth by itself: its information is that of `log`.
            yield np.stack([depth, 1 / (inverse * depth), information / depth**2])[:, good]


if __name__ == "__main__":
    main()
