"""Measure the error that a rolling shutter causes, with and without its estimation, and the estimated readout time.

    D=../shared/data
    .venv/bin/python benchmarks/rolling_shutter.py $D/building-walk $D/corridor-office $D/redkitchen

The first 40 frames of each clip, with depth and without: unchanged, and with each row rendered from where the camera
was at its time, over 10, 20 and 30 ms more than the camera's own readout (by the clip's depth and ground truth). ATE in
cm after SE(3) with depth, after Sim(3) without. Oracle: the added readout time.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from degraded_clips import judged, print_table

import vggtgeo as vg
from vggtgeo.datasets.views import SequenceView
from vggtgeo.simulation.degradations import as_it_is, rolling_shutter

CHANGES = {"base": as_it_is, **{f"{1000 * s:.0f} ms": partial(rolling_shutter, seconds=s) for s in (0.01, 0.02, 0.03)}}
COLUMNS = ("cm, without", "cm", "verdict", "found, ms", "shift, px", "reasons")


def cells(sequence: SequenceView) -> Iterator[str]:
    """Return the error without and with the estimation, and the estimated readout time."""
    never = vg.SlamSettings(refinement=vg.settings.GlobalMapSettings(rolling_shutter=False))
    yield f"{100 * judged(sequence, never)[1]:.1f}"
    result, error = judged(sequence)
    yield from (f"{100 * error:.1f}", result.verdict.level)
    found = result.summary.get("rolling_shutter")
    yield from ("", "") if found is None else (f"{1000 * found['seconds']:.1f}", f"{found['shift']:.1f}")
    yield "; ".join(result.verdict.reasons)


if __name__ == "__main__":
    print_table(__doc__, CHANGES, COLUMNS, cells)
