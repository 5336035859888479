"""A lens that zooms or is changed, a depth camera whose unit changes: what they cost, and whether they are told.

    D=../shared/data
    .venv/bin/python benchmarks/sensor_drift.py $D/building-walk $D/corridor-office $D/redkitchen $D/icl-office

The first 40 frames of each clip, with depth and without: as they are; enlarged steadily, by 1.3 in the end, depth with
them; enlarged at once, by 1.7 from the middle on; with depth that is longer and longer, by 1.4 and by 1.15 in the end;
with depth that is 1.2 times as long from the middle on. ATE after SE(3) with depth, after Sim(3) without. Oracle: what
was done. Lens, unit: the largest logarithms of their changes between two keyframes of up to a hundred, with depth with
their standard deviations; at once: of the largest single enlargement. They are what the bars of `sensor_drift.py`,
without depth `zoom.py`, and `enlargement.py` of `vggtgeo/slam/trust/` rest on.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from degraded_clips import judged, print_table

from vggtgeo.datasets.views import SequenceView
from vggtgeo.simulation.degradations import DEGRADATIONS, Recording, with_depths
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.enlargement import beyond_neighbours
from vggtgeo.slam.trust.evidence import EvidenceRecorder
from vggtgeo.slam.trust.sensor_drift import MOST_AHEAD, WITHIN, Curve, Ratios, statements, way_ahead
from vggtgeo.slam.trust.zoom import largest_change


def warming_depth(recording: Recording, rng: np.random.Generator) -> Recording:
    """Depth that is longer and longer, by 1.15 in the end."""
    del rng
    last = len(recording.frames) - 1
    return with_depths(recording, lambda depth, row: depth * 1.15 ** (row / last))


CHANGES = {
    **{name: DEGRADATIONS[name] for name in ("base", "zooming", "changed_lens", "growing_depth", "jumping_depth")},
    "warming_depth": warming_depth,
}
COLUMNS = ("cm", "verdict", "lens", "unit", "at once", "reasons")


def cells(sequence: SequenceView) -> Iterator[str]:
    """What came of it, and what was measured of the sensors."""
    result, error = judged(sequence)
    yield from (f"{100 * error:.1f}", result.verdict.level)
    slam = None if result.record is None else result.record.slam
    yield from _measured(sequence.has_depth, slam)
    recorder = EvidenceRecorder(sequence.camera)
    for frame in sequence.frames():
        recorder.add(frame)
    yield f"{beyond_neighbours(np.array([noted.enlarged for noted in recorder.frames], np.float64)).max():.3f}"
    yield "; ".join(result.verdict.reasons)


def _measured(has_depth: bool, slam: Slam | None) -> tuple[str, str]:
    """Of the lens and of the unit of depth."""
    if slam is None:
        return "", ""
    if not has_depth:
        return f"{largest_change(slam)[0]:.3f}", ""
    said, ahead = statements(slam), way_ahead(slam)
    return _largest(said.focal, ahead), _largest(said.unit, ahead)


def _largest(ratios: Ratios, ahead: np.ndarray) -> str:
    """Of the keyframes that the verdict compares, whether or not it is beyond chance."""
    found = [(0.0, 0.0)]
    for start in range(0, max(len(ahead) - WITHIN // 2, 1), WITHIN // 2):
        own = ahead[start : start + WITHIN]
        curve = Curve.of(ratios.among(start, start + len(own)), len(own))
        compared = (curve.part[:, None] == curve.part) & (np.abs(own - own[:, None]) < MOST_AHEAD)
        apart = np.abs(curve.value - curve.value[:, None])
        apart = np.where(compared & np.isfinite(apart), apart, 0.0)
        a, b = np.unravel_index(np.argmax(apart), apart.shape)
        spread = curve.covariance[a, a] + curve.covariance[b, b] - 2 * curve.covariance[a, b]
        found.append((float(apart[a, b]), float(np.sqrt(spread))))
    value, sigma = max(found)
    return f"{value:.3f} +- {sigma:.3f}"


if __name__ == "__main__":
    print_table(__doc__, CHANGES, COLUMNS, cells)
