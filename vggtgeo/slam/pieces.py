"""Pieces of map: a camera that was lost and not found begins one of its own, which joins the rest when they meet."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.factors import MeasuredRelativePose
from vggtgeo.slam.relocalisation import relocalise
from vggtgeo.slam.settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking import Sight, Track
from vggtgeo.slam.window_prior import WindowPrior

TRIED = 2
"""Keyframes of the other pieces that are verified for each new keyframe."""


def join_pieces(slam: Slam, sight: Sight, roles: Roles, settings: SlamSettings) -> Slam:
    """Where the newest keyframe, seen as `sight`, shows a place of an earlier piece, move its piece there.

    Only where lengths are metres: two pieces of free scale would need a similarity, which no one keyframe pair tells
    well enough.
    """
    if len(slam.origins) < 2 or not slam.metric:
        return slam
    place = relocalise(sight, slam.keyframes[: slam.origins[-1]], slam, roles, TRIED)
    return slam if place is None else _joined(slam, place)


def _joined(slam: Slam, place: Track) -> Slam:
    """The last piece carried by one rigid motion of the world, so that the newest keyframe is where it was found."""
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
        held=slam.window[:1],
        prior=None if slam.prior is None else _carried_prior(slam.prior, carried),
        solved=None,
        notes=(*slam.notes, note),
    )


def _carried_prior(known: WindowPrior, carried: np.ndarray) -> WindowPrior:
    """The window's prior after a rigid motion of the world: left tangents do not see it, linearisation points do."""
    poses = rigid.to_matrix(np.asarray(known.prior.poses.wxyz_xyz, np.float64)) @ carried
    moved = eqx.tree_at(lambda p: p.poses.wxyz_xyz, known.prior, jnp.asarray(rigid.to_quaternion(poses)))
    return WindowPrior(known.keyframes, moved)
