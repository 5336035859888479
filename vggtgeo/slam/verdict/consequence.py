"""How far the motion that the corners of a window prefer is from that of the run."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.geometry import rigid
from vggtgeo.slam.verdict.corner_adjustment import Fit, solve, start_of


@dataclass(frozen=True)
class Consequence:
    """How far a motion is from the claim, RMS over frames, and the standard deviations of the same.

    places: after alignment, in the unit of the map. turn: from frame to frame, rad.
    """

    places: float
    turn: float
    places_sigma: float = 0.0
    turn_sigma: float = 0.0


def differences(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return the differences from the claim: places after alignment [f, 3], turns between frames, rad [f - 1, 3]."""
    poses, claimed = fit.unknowns.poses, fit.tracks.poses
    places, theirs = rigid.centres(poses), rigid.centres(claimed)
    fitted = umeyama(places, theirs, not fit.tracks.with_depth)
    step = lambda poses: poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2)
    turns = Rotation.from_matrix(step(poses) @ np.swapaxes(step(claimed), 1, 2)).as_rotvec()
    return fitted.scale * places @ fitted.rotation.T + fitted.translation - theirs, np.asarray(turns)


def difference(fit: Fit) -> Consequence:
    """Return the difference of a fit from the claim, noise included."""
    return Consequence(*(float(np.sqrt(np.mean(np.sum(one**2, 1)))) for one in differences(fit)))


def confirmed(best: Fit) -> Consequence:
    """Return the difference from the claim that two halves of the tracks confirm.

    Each half is fitted by itself with what is free in `best`.

    Errors of tracks, mistracked corners among them, are independent between the halves: the mean product of what both
    differ from the claim by is free of their noise, and half of what they differ from each other by is the standard
    deviation of their mean. Both begin at the claimed poses, not at one wrong minimum.
    """
    even = np.arange(len(best.tracks.first)) % 2 == 0
    halves = (best.tracks.subset(half) for half in (even, ~even))
    starts = ((half, replace(start_of(half), theta=best.unknowns.theta)) for half in halves)
    fits = [solve(*start, best.noise, best.columns) for start in starts]
    pairs = list(zip(*map(differences, fits), strict=True))
    common = (max(float(np.mean(np.sum(one * other, 1))), 0.0) for one, other in pairs)
    apart = (0.25 * float(np.mean(np.sum((one - other) ** 2, 1))) for one, other in pairs)
    return Consequence(*(float(np.sqrt(square)) for square in (*common, *apart)))
