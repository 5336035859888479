"""A lens that zooms or is changed, a depth camera whose unit changes: what they cost, and whether they are told.

    D=../shared/data
    .venv/bin/python benchmarks/sensor_drift.py $D/building-walk $D/corridor-office $D/redkitchen $D/icl-office

The first 40 frames of each clip, with depth and without: as they are; enlarged steadily, by 1.3 in the end, depth with
them; enlarged at once, by 1.7 from the middle on; with depth that is longer and longer, by 1.4 in the end; with depth
that is 1.2 times as long from the middle on. ATE after SE(3) with depth, after Sim(3) without. Oracle: what was done.
Lens, unit: the logarithms of their changes that the verdict measures, with depth with their standard deviations; at
once: of the largest single enlargement; sudden: with depth the largest sum of either over up to twenty places between
keyframes. They are what the bars of `sensor_drift.py`, without depth `zoom.py`, `enlargement.py` and `sensor_jumps.py`
of `vggtgeo/slam/trust/` rest on.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from degraded_clips import judged, print_table

from vggtgeo.datasets.views import SequenceView
from vggtgeo.simulation.degradations import DEGRADATIONS
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.enlargement import beyond_neighbours
from vggtgeo.slam.trust.evidence import EvidenceRecorder
from vggtgeo.slam.trust.sensor_drift import changes
from vggtgeo.slam.trust.sensor_jumps import WITHIN, neighbour_factors
from vggtgeo.slam.trust.zoom import largest_change

CHANGES = {name: DEGRADATIONS[name] for name in ("base", "zooming", "changed_lens", "growing_depth", "jumping_depth")}
COLUMNS = ("cm", "verdict", "lens", "unit", "at once", "sudden", "reasons")


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
    yield "" if slam is None or not sequence.has_depth else _sudden(slam)
    yield "; ".join(result.verdict.reasons)


def _measured(has_depth: bool, slam: Slam | None) -> tuple[str, str]:
    """Of the lens and of the unit of depth."""
    if slam is None:
        return "", ""
    if not has_depth:
        return f"{largest_change(slam)[0]:.3f}", ""
    lens, unit = changes(slam, range(len(slam.keyframes)))
    told = lambda one: "" if one is None else f"{one.value:.3f} +- {one.sigma:.3f}"
    return told(lens), told(unit)


def _sudden(slam: Slam) -> str:
    """Of the lens and of the unit of depth, over any places that the verdict looks at together."""
    curves = np.cumsum(np.nan_to_num(np.vstack([np.zeros(2), neighbour_factors(slam)])), axis=0)
    lengths = range(1, min(WITHIN, len(curves) - 1) + 1)
    largest = [np.abs(curves[length:] - curves[:-length]).max(0) for length in lengths]
    return ", ".join(f"{value:.3f}" for value in np.max(largest, axis=0)) if largest else ""


if __name__ == "__main__":
    print_table(__doc__, CHANGES, COLUMNS, cells)
