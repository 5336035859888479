"""Edges of depth against edges of pictures: what the verdict sees of it where they belong together, and where not.

    D=../shared/data
    .venv/bin/python benchmarks/depth_edges.py $D/corridor-office $D/building-walk $D/icl-office $D/redkitchen
    .venv/bin/vggtgeo simulate corridor -o runs/corridor --frames 60 --size 320x240    # a simulated scene
    .venv/bin/python benchmarks/depth_edges.py runs/corridor
    .venv/bin/python benchmarks/depth_edges.py $D/* --changes blurred noisy dark compressed covered "noisy depth" coarse

A row for each 40 frames of a clip: by how much edges lie elsewhere
(`vggtgeo/slam/trust/edges.py`, which tells of more than 0.3), of the frames as they are, with pictures that are
mirrored, or moved by an editor's stabiliser, and with depth of three frames before. The third command disturbs
pictures or depth that belong together: blur of 2 px, noise of 20 of 255 levels, a twelfth of the light, JPEG of
quality 10, the left half covered; depth with noise of 3 %, and of one pixel in eight.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from edited_videos import mirrored, stabilised
from wrong_depth import from_an_eighth, of_depth

from vggtgeo.datasets import open_sequence
from vggtgeo.simulation.degradations import (
    Degradation,
    Recording,
    as_it_is,
    compressed,
    dark,
    with_depths,
    with_images,
)
from vggtgeo.slam.trust.evidence import EvidenceRecorder

FRAMES, LATE = 40, 3


def late(recording: Recording, rng: np.random.Generator) -> Recording:
    """Each picture with the depth of `LATE` frames before."""
    del rng
    frames = recording.frames
    return replace(recording, frames=[replace(f, depth=frames[max(k - LATE, 0)].depth) for k, f in enumerate(frames)])


def noisy(recording: Recording, rng: np.random.Generator) -> Recording:
    """Pictures with noise of 20 levels."""
    return with_images(
        recording, lambda image, _: np.clip(image + rng.normal(0, 20, image.shape), 0, 255).astype(np.uint8)
    )


def half_covered(recording: Recording, rng: np.random.Generator) -> Recording:
    """Pictures whose left half is grey, as behind a finger."""
    del rng

    def change(image: np.ndarray, row: int) -> np.ndarray:
        del row
        covered = image.copy()
        covered[:, : image.shape[1] // 2] = 90
        return covered

    return with_images(recording, change)


def noisy_depth(recording: Recording, rng: np.random.Generator) -> Recording:
    """Depth with noise of 3 %."""
    return with_depths(recording, lambda depth, _: depth * np.exp(rng.normal(0, 0.03, depth.shape)))


def of_pictures(change: Callable[[np.ndarray], np.ndarray]) -> Degradation:
    """Each picture changed."""
    return lambda recording, rng: with_images(recording, lambda image, row: change(image))


CHANGES: dict[str, Degradation] = {
    **{"as it is": as_it_is, "mirrored": mirrored, "stabilised": stabilised, "late": late},
    "blurred": of_pictures(lambda image: cv2.GaussianBlur(image, (0, 0), 2.0)),
    **{"noisy": noisy, "dark": dark, "compressed": of_pictures(lambda image: compressed(image, 10))},
    **{"covered": half_covered, "noisy depth": noisy_depth, "coarse": of_depth(from_an_eighth)},
}
FIRST = list(CHANGES)[:4]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="+", type=Path)
    parser.add_argument("--changes", nargs="+", choices=list(CHANGES), default=FIRST, metavar="CHANGE")
    given = parser.parse_args()
    print(f"| clip | from | {' | '.join(given.changes)} |\n|---|---|" + "---|" * len(given.changes))
    for path in given.clips:
        sequence = open_sequence(path)
        truth = sequence.ground_truth()
        assert truth is not None
        for start in range(0, len(sequence) - FRAMES + 1, FRAMES):
            recording = Recording(list(sequence.frames(start, start + FRAMES)), sequence.camera, truth)
            cells = [share(CHANGES[change](recording, np.random.default_rng(0))) for change in given.changes]
            print(f"| {path.name} | {start} | {' | '.join(cells)} |", flush=True)


def share(recording: Recording) -> str:
    """The mean, and of how many frames."""
    recorder = EvidenceRecorder(recording.camera)
    for frame in recording.frames:
        recorder.add(frame)
    known = [noted.edges_elsewhere for noted in recorder.frames if noted.edges_elsewhere is not None]
    return f"{np.mean(known):.2f} ({len(known)})" if known else "-"


if __name__ == "__main__":
    main()
