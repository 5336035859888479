"""Pieces of map: a camera that was lost and not found begins one of its own, which joins the rest when they meet."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.factors import Factor, MeasuredBaseline, MeasuredRelativePose
from vggtgeo.slam.keyframe import Keyframe, Slots
from vggtgeo.slam.relocalisation import relocalise
from vggtgeo.slam.settings import Roles, SlamSettings
from vggtgeo.slam.state import FramePose, Slam
from vggtgeo.slam.tracking import Sight, Track
from vggtgeo.slam.window_prior import WindowPrior

TRIED = 2
"""Keyframes of the other pieces that are verified for each new keyframe."""
LEAST_SHARED = 20
"""Key points with a depth in both pieces that tell the ratio of their units."""
MOST_SCALE_ERROR = 0.03
"""Largest standard error of that ratio; at 3 m it moves what is joined by 9 cm, which the adjustment then mends."""


def join_pieces(slam: Slam, sight: Sight, roles: Roles, settings: SlamSettings) -> Slam:
    """Where the newest keyframe, seen as `sight`, shows a place of an earlier piece, move its piece there.

    By a rigid motion where lengths are metres, else by a similarity: each piece of free scale has a unit of its own.
    """
    if len(slam.origins) < 2:
        return slam
    place = relocalise(sight, slam.keyframes[: slam.origins[-1]], slam, roles, TRIED)
    if place is None:
        return slam
    if slam.metric:
        return _joined(slam, place, slam.window[:1])
    ratio = unit_ratio(slam, place, roles)
    return slam if ratio is None else _joined(scaled_piece(slam, ratio), place, slam.window[:2])


def unit_ratio(slam: Slam, place: Track, roles: Roles) -> float | None:
    """By what the last piece must be multiplied to have the unit of the keyframe that its newest one was found by.

    The median, over key points that both keyframes know the depth of, of depth as the old one has it over depth as the
    new one has it, in the new camera. None where they are too few, or disagree.
    """
    old, new = place.keyframe, slam.keyframes[-1]
    matches = roles.points.match(old.features, new.features)
    matches = matches.select(matches.index_j >= 0)
    before, after = old.points.inverse_depth[matches.index_i], new.points.inverse_depth[matches.index_j]
    known = np.isfinite(before) & np.isfinite(after)
    matches, before, after = matches.select(known), before[known], after[known]
    local = rigid.unproject(matches.pixels_i, before, np.eye(4), slam.intrinsics)
    depth = local @ place.relative[2, :3] + place.relative[2, 3]
    ahead = depth > 0
    if np.count_nonzero(ahead) < LEAST_SHARED:
        return None
    logs = np.log(depth[ahead] * after[ahead])
    middle = float(np.median(logs))
    # Standard error of a median: 1.25 sigma / sqrt(n), sigma from the median absolute deviation.
    error = 1.25 * 1.48 * float(np.median(np.abs(logs - middle))) / np.sqrt(len(logs))
    return float(np.exp(middle)) if error < MOST_SCALE_ERROR else None


def scaled_piece(slam: Slam, ratio: float) -> Slam:
    """The state with all lengths of the last piece multiplied by `ratio`; its own unit, the baseline, is given up."""
    origin = slam.origins[-1]
    inside = lambda number: number >= origin
    keyframes = tuple(_scaled(k, ratio) if inside(k.number) else k for k in slam.keyframes)
    frames = tuple(_scaled_record(record, ratio) if inside(record.reference) else record for record in slam.frames)
    own = lambda factor: all(inside(number) for number in factor.keyframes)
    factors = tuple(_scaled_factor(factor, ratio) if own(factor) else factor for factor in slam.factors)
    kept = tuple(f for f in factors if not (isinstance(f, MeasuredBaseline) and own(f)))
    velocity = _longer(slam.velocity, ratio)
    return replace(slam, keyframes=keyframes, frames=frames, factors=kept, velocity=velocity, prior=None, solved=None)


def _joined(slam: Slam, place: Track, held: tuple[int, ...]) -> Slam:
    """The last piece carried by one rigid motion of the world, so that the newest keyframe is where it was found.

    held: members of the window that stay where they are; of free scale two, which hold the unit.
    """
    origin, newest = slam.origins[-1], slam.keyframes[-1]
    carried = rigid.invert(newest.pose) @ place.pose
    keyframes = tuple(
        replace(keyframe, pose=rigid.orthonormal(keyframe.pose @ carried)) if keyframe.number >= origin else keyframe
        for keyframe in slam.keyframes
    )
    note = (
        f"the piece of map that began at frame {slam.keyframes[origin].frame} is joined to the one before at frame "
        f"{newest.frame}"
    )
    tie = MeasuredRelativePose(place.keyframe.number, newest.number, place.relative, place.information)
    return replace(
        slam,
        keyframes=keyframes,
        origins=slam.origins[:-1],
        factors=(*slam.factors, tie),
        held=held,
        prior=None if slam.prior is None else _carried_prior(slam.prior, carried),
        solved=None,
        notes=(*slam.notes, note),
    )


def _carried_prior(known: WindowPrior, carried: np.ndarray) -> WindowPrior:
    """The window's prior after a rigid motion of the world: left tangents do not see it, linearisation points do."""
    poses = rigid.to_matrix(np.asarray(known.prior.poses.wxyz_xyz, np.float64)) @ carried
    moved = eqx.tree_at(lambda p: p.poses.wxyz_xyz, known.prior, jnp.asarray(rigid.to_quaternion(poses)))
    return WindowPrior(known.keyframes, moved)


def _longer(motion: np.ndarray, ratio: float) -> np.ndarray:
    changed = motion.copy()
    changed[:3, 3] *= ratio
    return changed


def _scaled(keyframe: Keyframe, ratio: float) -> Keyframe:
    nearer = lambda slots: replace(slots, inverse_depth=slots.inverse_depth / ratio)
    points: Slots = nearer(keyframe.points)
    samples: Slots = nearer(keyframe.samples)
    line_depths = keyframe.line_depths * ratio
    return replace(
        keyframe, pose=_longer(keyframe.pose, ratio), points=points, samples=samples, line_depths=line_depths
    )


def _scaled_record(record: FramePose, ratio: float) -> FramePose:
    arrival = None if record.arrival is None else (record.arrival[0], _longer(record.arrival[1], ratio))
    return replace(record, relative=_longer(record.relative, ratio), arrival=arrival)


def _scaled_factor(factor: Factor, ratio: float) -> Factor:
    if not isinstance(factor, MeasuredRelativePose):
        return factor
    by = np.repeat([1.0 / ratio, 1.0], 3)
    return replace(factor, pose=_longer(factor.pose, ratio), information=factor.information * np.outer(by, by))
