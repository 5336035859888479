"""The rolling shutter that the last adjustment found: did it bend what was matched and tracked before?

The poses are of the middle of each image, and so are the corners that judge them: without depth, where the median of
the map is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vggtgeo.slam.camera.rolling_shutter import at_once
from vggtgeo.slam.global_map.frame_motions import frame_motions
from vggtgeo.slam.global_map.pose_uncertainty import median_depths
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import FrameEvidence
from vggtgeo.slam.trust.finding import Finding

MOST_SHIFT = 7.0
"""Pixels by which one match in ten is off, or more. Keyframes are matched within 8 px of the tracked motion: what is
farther off is lost. Where it was 6.2 px and less, twelve pieces of clips were 0.5 to 2.7 cm off, as were four with 7.3
to 11.6 (`benchmarks/rolling_shutter.py`); but with rows drawn a little differently, 9.7 px were 36 cm."""


def corners_at_once(slam: Slam, evidence: Sequence[FrameEvidence]) -> list[FrameEvidence]:
    """The corners of frames where they would have been if each image were of one moment.

    evidence: of the frames of the run, in their order.
    """
    readout = slam.camera.readout
    if readout is None:
        return list(evidence)
    intrinsics, size = np.asarray(slam.intrinsics, np.float64), slam.keyframes[0].size
    depths = median_depths(slam)
    found = []
    for noted, motion, record in zip(evidence, frame_motions(slam), slam.frames, strict=True):
        depth = noted.depth.astype(np.float64)
        known = np.isfinite(depth) & (depth > 0) & slam.metric
        inverse = 1 / np.where(known, depth, depths[record.reference])
        pixels = at_once(noted.pixels, inverse, motion, intrinsics, size, readout)
        found.append(replace(noted, pixels=pixels.astype(np.float32)))
    return found


def check_shutter(estimate: Estimate) -> list[Finding]:
    """A shutter so slow, for how the camera moves, that frames were tracked by what is not there."""
    readout = estimate.readout
    if readout is None or readout.shift <= MOST_SHIFT:
        return []
    lines = "columns" if readout.columns else "rows"
    text = (
        f"the camera reads its {lines} out one by one, over about {1000 * abs(readout.seconds):.0f} ms (a rolling "
        f"shutter), in which one match in ten moves by {readout.shift:.0f} px or more: move slower, or film with a "
        "shorter readout"
    )
    return [Finding("rolling shutter", "degraded", text)]
