"""Line segments: what they give, where there is texture and where there is hardly any.

    .venv/bin/python benchmarks/lines.py [--data ../shared/data] [--sources building-walk poor corridor]
        [--variants none lines] [--without-picture | --rgb-only] [--points 80]

Sources: the clips by their names; `poor`, those pieces of the two HoloLens clips where a frame has fewer than 100
matches with the frame three before it; `corridor`, the simulated one with bare white walls and equal doors, with exact
truth. `--without-picture` tracks by key points (and segments) alone, as without an alignment of the picture as a whole;
`--rgb-only` gives no depth either. `--points` leaves that many key points a frame, the best spread over the image.

Printed as Markdown: frames tracked, and those in whose pose lines took part; ATE RMSE and the worst frame in cm after
SE(3) alignment (without depth Sim(3)), of all frames; how far a frame's pose against its keyframe was off when it was
tracked, before any adjustment, in cm, median and 95th percentile; and milliseconds of tracking a frame, key points and
keyframes not counted in.
"""

from __future__ import annotations

import argparse
import zlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import jax
import numpy as np
from vggtgeo.models.classical import NoDepth, SiftMatcher
from vggtgeo.models.roles import Features

from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.frame import Sequence
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.simulation import simulate
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.run import finish, frame_trajectory, run
from vggtgeo.slam.settings.groups import LineSettings
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam

VARIANTS = {
    "none": LineSettings(use_lines=False),
    "lines": LineSettings(),
}
CLIPS = ("building-walk", "corridor-office")
FEW, APART, SHORTEST, HOLE = 100, 3, 12, 3
"""A piece: at least so many frames with fewer matches than this with the frame so many before, with holes so long."""


@dataclass(frozen=True)
class Piece:
    """Frames `start` to below `end` of a sequence."""

    name: str
    sequence: Sequence
    start: int = 0
    end: int | None = None


@dataclass(frozen=True)
class RememberingMatcher(SiftMatcher):
    """Describes each image once for all runs."""

    memory: dict[int, Features] = field(default_factory=dict)

    def describe(self, image: np.ndarray) -> Features:
        """Key points of an image, at hand if it was seen before."""
        key = zlib.crc32(image.tobytes())
        if key not in self.memory:
            self.memory[key] = super().describe(image)
        return self.memory[key]


def main() -> None:
    """Run what was asked for and print the table as it grows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--sources", nargs="+", default=["building-walk", "poor", "corridor"])
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--without-picture", action="store_true")
    parser.add_argument("--rgb-only", action="store_true")
    parser.add_argument("--points", type=int, default=SiftMatcher().count)
    parser.add_argument("--frames", type=int, default=240, help="of each source, at most")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # as the program does
    matcher = RememberingMatcher(count=arguments.points)
    roles = Roles(points=matcher)
    if arguments.rgb_only:
        roles = replace(roles, depth=NoDepth())
    elif arguments.without_picture:
        roles = replace(roles, alignment=None)
    columns = (
        "source",
        "frames",
        "lines in",
        "tracked",
        "by lines too",
        "ATE",
        "worst",
        "tracking, median",
        "95th",
        "ms",
    )
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    for source in arguments.sources:
        for piece in pieces(source, arguments.data, arguments.frames, matcher):
            for variant in arguments.variants:
                print(line(piece, variant, roles), flush=True)


def pieces(source: str, data: Path, frames: int, matcher: SiftMatcher) -> Iterator[Piece]:
    """What a source stands for."""
    if source == "corridor":
        yield Piece("corridor, simulated", simulate("corridor", frames, 0, (480, 360), rate=10.0))
    elif source != "poor":
        yield Piece(source, open_sequence(data / source), 0, frames)
    else:
        for clip in CLIPS:
            sequence = open_sequence(data / clip)
            for start, end in poor_pieces(sequence, frames, matcher):
                yield Piece(f"{clip} {start}-{end - 1}", sequence, start, end)


def poor_pieces(sequence: Sequence, frames: int, matcher: SiftMatcher) -> list[tuple[int, int]]:
    """Ranges of frames with few matches, the longest holes between them closed."""
    features = [matcher.describe(frame.image) for frame in sequence.frames(0, frames)]
    matches = [len(matcher.match(*pair)) for pair in zip(features, features[APART:], strict=False)]
    poor = APART + np.nonzero(np.array(matches) < FEW)[0]
    groups = np.split(poor, np.nonzero(np.diff(poor) > HOLE)[0] + 1) if len(poor) else []
    ranges = [(max(int(group[0]) - APART, 0), int(group[-1]) + 1) for group in groups]
    return [(start, end) for start, end in ranges if end - start >= SHORTEST]


def line(piece: Piece, variant: str, roles: Roles) -> str:
    """One run, as a line of the table."""
    settings = SlamSettings(line=VARIANTS[variant])
    clock = Clock()
    states = run(piece.sequence, roles, settings, start=piece.start, end=piece.end, clock=clock)
    last: Slam = deque(states, maxlen=1).pop()
    slam = finish(last, roles, settings)
    truth = piece.sequence.ground_truth()
    assert truth is not None
    tracked = sum(record.tracked for record in slam.frames)
    report = evaluate_trajectory(frame_trajectory(slam), truth)
    error = report.se3 if slam.metric else report.sim3
    errors = error.statistics
    off = 100 * np.percentile(tracking_errors(last, truth, error.alignment.scale), (50, 95))
    cells = [
        piece.name,
        str(len(slam.frames)),
        variant,
        str(tracked),
        str(sum(record.evidence.lines > 0 for record in slam.frames)),
        f"{100 * errors.rmse:.2f}",
        f"{100 * errors.maximum:.2f}",
        *(f"{value:.2f}" for value in off),
        f"{1000 * clock.seconds['track'] / len(slam.frames):.0f}",
    ]
    return "| " + " | ".join(cells) + " |"


def tracking_errors(slam: Slam, truth: Trajectory, scale: float) -> np.ndarray:
    """Metres between a frame's centre as tracked and the true one, seen from its keyframe, [n]; scale: of the map."""
    nearest = lambda time: truth.poses[np.argmin(np.abs(truth.timestamps - time))]
    found = []
    for record in slam.frames:
        reference, relative = record.arrival or (record.reference, record.relative)
        if record.tracked and slam.keyframes[reference].frame != record.frame:
            true = rigid.invert(nearest(record.timestamp)) @ nearest(slam.keyframes[reference].timestamp)
            found.append(np.linalg.norm(scale * rigid.centre(relative) - rigid.centre(true)))
    return np.array(found)


if __name__ == "__main__":
    main()
