"""Joining of submaps: one starts after tracking loss, and is joined to the others when a place is recognized."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.connected import submap_of
from vggtgeo.slam.sparse_map.factors import MeasuredBaseline, MeasuredRelativePose
from vggtgeo.slam.sparse_map.units import longer, ratio_of_units, scaled_factor, scaled_keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.relocalisation import relocalise
from vggtgeo.slam.tracking.track import FrameData, Track, TrackingInput
from vggtgeo.slam.tracking.tracker import scaled_record
from vggtgeo.slam.window.window import WindowPrior

TRIED = 2
"""Keyframes of other submaps that are verified for each new keyframe."""


def join_submaps(slam: Slam, data: FrameData, roles: Roles, settings: SlamSettings) -> Slam:
    """Join the newest submap to an earlier one if the newest keyframe, with frame data `data`, shows a place of it.

    By a rigid motion if lengths are metres, else by a similarity: each submap without metric depth has its own scale.
    """
    if len(slam.map.roots) < 2:
        return slam
    label = submap_of(slam.map)
    others = [keyframe for keyframe in slam.keyframes if label[keyframe.number] != label[-1]]
    if not others:
        return slam
    place = relocalise(TrackingInput(data, slam.intrinsics, roles), others, slam.tracker, TRIED)
    if place is None:
        return slam
    if slam.metric:
        return _joined(slam, place, slam.window.members[:1])
    ratio = unit_ratio(slam, place, roles)
    if ratio is None:
        return slam
    return _joined(scale_submap(slam, ratio, newest_submap(slam)), place, slam.window.members[:2])


def unit_ratio(slam: Slam, place: Track, roles: Roles) -> float | None:
    """Return the scale ratio of the newest submap to the keyframe by which it was recognized; None if unknown."""
    old, new = place.keyframe, slam.keyframes[-1]
    matches = roles.points.match(old.features, new.features)
    return ratio_of_units(old, new, matches.select(matches.index_j >= 0), place.relative, slam.intrinsics)


def scale_submap(slam: Slam, ratio: float, inside: Callable[[int], bool]) -> Slam:
    """Return the state with all lengths of a submap multiplied by `ratio`, without its own scale anchor (the baseline).

    inside: whether a keyframe, by its number, belongs to the submap.
    """
    keyframes = tuple(scaled_keyframe(k, ratio) if inside(k.number) else k for k in slam.keyframes)
    frames = tuple(scaled_record(record, ratio) if inside(record.reference) else record for record in slam.frames)
    own = lambda factor: all(inside(number) for number in factor.keyframes)
    factors = tuple(scaled_factor(factor, ratio) if own(factor) else factor for factor in slam.map.factors)
    # The baseline fixed the old scale; the rest of the map fixes the new one.
    kept = tuple(f for f in factors if not (isinstance(f, MeasuredBaseline) and own(f)))
    velocity = longer(slam.tracker.velocity, ratio) if inside(len(keyframes) - 1) else slam.tracker.velocity
    return replace(
        slam,
        map=replace(slam.map, keyframes=keyframes, factors=kept),
        tracker=replace(slam.tracker, frames=frames, velocity=velocity),
        window=replace(slam.window, prior=None, solved=None),
    )


def newest_submap(slam: Slam) -> Callable[[int], bool]:
    """Return a function that tells whether a keyframe, by its number, belongs to the newest submap."""
    label = submap_of(slam.map)
    return lambda number: bool(label[number] == label[-1])


def _joined(slam: Slam, place: Track, held: tuple[int, ...]) -> Slam:
    """Return the state with the newest submap moved rigidly, so that the newest keyframe is where it was recognized.

    held: members of the window that are fixed; two for a map without metric depth, which fix the scale.
    """
    inside, newest = newest_submap(slam), slam.keyframes[-1]
    # World -> camera poses change their world from the right.
    carried = rigid.invert(newest.pose) @ place.pose
    keyframes = tuple(
        replace(keyframe, pose=rigid.orthonormal(keyframe.pose @ carried)) if inside(keyframe.number) else keyframe
        for keyframe in slam.keyframes
    )
    began = next(keyframe.frame for keyframe in slam.keyframes if inside(keyframe.number))
    note = f"the submap that began at frame {began} is joined to the one before at frame {newest.frame}"
    tie = MeasuredRelativePose(place.keyframe.number, newest.number, place.relative, place.information)
    return replace(
        slam,
        map=replace(
            slam.map,
            keyframes=keyframes,
            roots=tuple(origin for origin in slam.map.roots if not inside(origin)),
            factors=(*slam.map.factors, tie),
        ),
        window=replace(
            slam.window,
            held=held,
            prior=None if slam.window.prior is None else _carried_prior(slam.window.prior, carried),
            solved=None,
        ),
        notes=(*slam.notes, note),
    )


def _carried_prior(known: WindowPrior, carried: np.ndarray) -> WindowPrior:
    """Return the window's prior after a rigid motion of the world: it changes linearisation points, but no left
    tangents.
    """
    poses = rigid.to_matrix(np.asarray(known.prior.poses.wxyz_xyz, np.float64)) @ carried
    moved = eqx.tree_at(lambda p: p.poses.wxyz_xyz, known.prior, jnp.asarray(rigid.to_quaternion(poses)))
    return WindowPrior(known.keyframes, moved)
