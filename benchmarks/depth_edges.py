"""Edges of depth against edges of pictures: what the verdict sees of it where they belong together, and where not.

    D=../shared/data
    .venv/bin/python benchmarks/depth_edges.py $D/corridor-office $D/building-walk $D/icl-office $D/redkitchen
    .venv/bin/vggtgeo simulate corridor -o runs/corridor --frames 60 --size 320x240    # a simulated scene
    .venv/bin/python benchmarks/depth_edges.py runs/corridor

A row for each 40 frames of a clip: by how much edges lie elsewhere
(`vggtgeo/slam/trust/edges.py`, which tells of more than 0.3), of the frames as they are, with pictures that are
mirrored, or moved by an editor's stabiliser, and with depth of three frames before.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from edited_videos import mirrored, stabilised

from vggtgeo.datasets import open_sequence
from vggtgeo.simulation.degradations import Degradation, Recording, as_it_is
from vggtgeo.slam.trust.evidence import EvidenceRecorder

FRAMES, LATE = 40, 3


def late(recording: Recording, rng: np.random.Generator) -> Recording:
    """Each picture with the depth of `LATE` frames before."""
    del rng
    frames = recording.frames
    return replace(recording, frames=[replace(f, depth=frames[max(k - LATE, 0)].depth) for k, f in enumerate(frames)])


CHANGES: dict[str, Degradation] = {"as it is": as_it_is, "mirrored": mirrored, "stabilised": stabilised, "late": late}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="+", type=Path)
    print(f"| clip | from | {' | '.join(CHANGES)} |\n|---|---|" + "---|" * len(CHANGES))
    for path in parser.parse_args().clips:
        sequence = open_sequence(path)
        truth = sequence.ground_truth()
        assert truth is not None
        for start in range(0, len(sequence) - FRAMES + 1, FRAMES):
            recording = Recording(list(sequence.frames(start, start + FRAMES)), sequence.camera, truth)
            cells = [share(change(recording, np.random.default_rng(0))) for change in CHANGES.values()]
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
