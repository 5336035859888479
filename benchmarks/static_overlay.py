"""Paint bars, text and a board over clips, and measure the error with and without the search for static overlays.

    D=../shared/data
    .venv/bin/python benchmarks/static_overlay.py $D/building-walk $D/corridor-office $D/redkitchen $D/icl-office

The first 40 frames of each clip, with depth and without, unchanged and painted over; `camera.static_overlay` off and
on. ATE after SE(3) with depth, after Sim(3) without.
"""

from __future__ import annotations

from collections.abc import Iterator

from degraded_clips import judged, print_table

import vggtgeo as vg
from vggtgeo.datasets.views import SequenceView
from vggtgeo.simulation.degradations import DEGRADATIONS

PAINTED = {name: DEGRADATIONS[name] for name in ("base", "bars", "text", "board")}
COLUMNS = ("off: cm", "verdict", "on: cm", "verdict", "still")


def cells(sequence: SequenceView) -> Iterator[str]:
    """Return the cells without the search, and with it."""
    yield from _run(sequence, False)[:2]
    yield from _run(sequence, True)


def _run(sequence: SequenceView, static_overlay: bool) -> list[str]:
    """Return the ATE in cm, the verdict, and the share of the image that is masked."""
    settings = vg.SlamSettings(camera=vg.settings.CameraSettings(static_overlay=static_overlay))
    result, error = judged(sequence, settings)
    return [f"{100 * error:.1f}", result.verdict.level, f"{100 * result.summary.get('static_overlay', 0.0):.0f} %"]


if __name__ == "__main__":
    print_table(__doc__, PAINTED, COLUMNS, cells)
