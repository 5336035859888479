"""Joining of submaps: one starts after tracking loss, and is joined to the others when a place is recognized.

While the run goes on, by the newest keyframe (`join_submaps`); at the end by all that look alike (`join_at_end`). There
each verified pair of keyframes of two submaps gives a similarity between them: the relative pose of its matches, and
the ratio of the scales of both. That one is taken which most keyframes agree with, and at least two: one that only
looks like another place agrees with no other.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.global_map.drift_correction import Loop
from vggtgeo.slam.global_map.loops import verified_loops
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.factors import MeasuredBaseline, MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import (
    RATIO_SIGMA,
    longer,
    measured_ratio,
    scaled_factor,
    scaled_keyframe,
    scaled_motion,
    submap_of,
)
from vggtgeo.slam.state import Slam, submaps_by_size
from vggtgeo.slam.tracking.frame_tracking import FrameData, TrackingInput
from vggtgeo.slam.tracking.relocalisation import relocalise
from vggtgeo.slam.tracking.tracking_state import scaled_record
from vggtgeo.slam.window.sliding_window import WindowPrior

TRIED = 2
"""Keyframes of other submaps that are verified for each keyframe, those that look most like it."""
MIN_AGREEING = 2
"""Keyframes of a submap that must agree on where it is."""


def join_submaps(slam: Slam, data: FrameData, roles: Roles, settings: SlamSettings) -> Slam:
    """Join the newest submap to an earlier one if the newest keyframe, with frame data `data`, shows a place of it.

    By a rigid motion if lengths are metres, else by a similarity: each submap without metric depth has its own scale.
    """
    if len(slam.map.roots) < 2:
        return slam
    label = submap_of(slam.map)
    numbers = set(np.flatnonzero(label == label[-1]).tolist())
    others = [keyframe for keyframe in slam.keyframes if keyframe.number not in numbers]
    place = relocalise(TrackingInput(data, slam.intrinsics, roles), others, slam.tracker, TRIED) if others else None
    if place is None:
        return slam
    old, new, fixed = place.keyframe, slam.keyframes[-1], slam.window.members[:1]
    if not slam.metric:
        matches = roles.points.match(old.features, new.features)
        both = matches.select(matches.index_j >= 0)
        ratio, error = measured_ratio(old, new, both, place.relative, slam.intrinsics)
        if error >= RATIO_SIGMA:
            return slam
        # Two fixed keyframes fix the scale.
        slam, fixed = scale_submap(slam, ratio, numbers), slam.window.members[:2]
    motion = rigid.invert(slam.keyframes[-1].pose) @ place.pose
    prior = None if slam.window.prior is None else _moved_prior(slam.window.prior, motion)
    joined = moved_submap(slam, numbers, motion).with_window(fixed=fixed, prior=prior, solved=None)
    factor = MeasuredRelativePose(old.number, new.number, place.relative, place.information)
    began = slam.keyframes[min(numbers)].frame
    note = f"the submap that began at frame {began} is joined to the one before at frame {new.frame}"
    return joined.with_factors(factor).with_notes(note)


def scale_submap(slam: Slam, ratio: float, numbers: Collection[int]) -> Slam:
    """Return the state with all lengths of the submap of some keyframes multiplied by `ratio`.

    Without its own scale anchor (the baseline): the rest of the map fixes the scale.
    """
    own = lambda factor: all(number in numbers for number in factor.keyframes)
    factors = [scaled_factor(factor, ratio) if own(factor) else factor for factor in slam.map.factors]
    kept = tuple(factor for factor in factors if not (isinstance(factor, MeasuredBaseline) and own(factor)))
    keyframes = tuple(scaled_keyframe(k, ratio) if k.number in numbers else k for k in slam.keyframes)
    frames = tuple(scaled_record(record, ratio) if record.reference in numbers else record for record in slam.frames)
    velocity = slam.tracker.velocity
    if len(keyframes) - 1 in numbers:
        velocity = longer(velocity, ratio)
    scaled = slam.with_map(keyframes=keyframes, factors=kept).with_tracker(frames=frames, velocity=velocity)
    return scaled.with_window(prior=None, solved=None)


def moved_submap(slam: Slam, numbers: Collection[int], motion: np.ndarray) -> Slam:
    """Return the state with the submap of some keyframes moved rigidly [4, 4] to its place in another one."""
    # World -> camera poses change their world from the right.
    keyframes = tuple(
        replace(keyframe, pose=rigid.orthonormal(keyframe.pose @ motion)) if keyframe.number in numbers else keyframe
        for keyframe in slam.keyframes
    )
    return slam.with_map(keyframes=keyframes, roots=tuple(root for root in slam.map.roots if root not in numbers))


def _moved_prior(known: WindowPrior, motion: np.ndarray) -> WindowPrior:
    """Return the window's prior after a rigid motion of the world: it changes linearisation points, but no left
    tangents.
    """
    poses = rigid.to_matrix(np.asarray(known.prior.poses.wxyz_xyz, np.float64)) @ motion
    moved = eqx.tree_at(lambda p: p.poses.wxyz_xyz, known.prior, jnp.asarray(rigid.to_quaternion(poses)))
    return WindowPrior(known.keyframes, moved)


def join_at_end(slam: Slam, roles: Roles) -> Slam:
    """Join submaps of free scale to the one of most frames, the largest first, until none joins any more.

    Where lengths are metres, loops join submaps (`loops.py`).
    """
    joined = None if slam.metric else slam
    while joined is not None:
        slam = joined
        main, *others = submaps_by_size(slam) or ((),)
        trials = (_joined_by_loops(slam, main, other, roles) for other in others)
        joined = next((trial for trial in trials if trial is not None), None)
    return slam


def _joined_by_loops(slam: Slam, main: tuple[int, ...], other: tuple[int, ...], roles: Roles) -> Slam | None:
    """Move the submap `other` to its place in `main`, and return the state; None if that place is unknown."""
    found = verified_loops(slam, _look_alike(slam.keyframes, main, other), roles)
    loops = [loop for loop in found if loop.scale is not None and loop.scale.error < RATIO_SIGMA]
    best = slam
    agreeing: list[Loop] = []
    for loop in loops:
        trial = _placed_by(slam, loop, set(other))
        fits = [one for one in loops if one.agrees(trial)]
        placed = {number for one in fits for number in one.pair.key if number in other}
        if len(placed) >= MIN_AGREEING and len(fits) > len(agreeing):
            best, agreeing = trial, fits
    if not agreeing:
        return None
    motions = (loop.motion for loop in agreeing if loop.motion.first in main)
    joined = best.with_map(pairs=(*best.map.pairs, *(loop.pair for loop in agreeing))).with_factors(*motions)
    return joined.with_notes(
        f"the submap that began at frame {slam.keyframes[other[0]].frame} is joined to the rest at the end: "
        f"{len(agreeing)} pairs of keyframes agree on its place"
    )


def _look_alike(
    keyframes: tuple[Keyframe, ...], main: tuple[int, ...], other: tuple[int, ...]
) -> list[tuple[int, int]]:
    """Return pairs of keyframes of two submaps, the earlier first, that look most alike."""
    descriptors = ((keyframe.number, keyframe.global_descriptor) for keyframe in keyframes)
    known = {number: descriptor for number, descriptor in descriptors if descriptor is not None}
    ours, theirs = ([number for number in numbers if number in known] for numbers in (main, other))
    if not ours or not theirs:
        return []
    similarity = np.stack([known[number] for number in theirs]) @ np.stack([known[number] for number in ours]).T
    best = np.argsort(-similarity, axis=1, kind="stable")[:, :TRIED]
    both = ((theirs[row], ours[column]) for row in range(len(theirs)) for column in best[row])
    return sorted({(min(pair), max(pair)) for pair in both})


def _placed_by(slam: Slam, loop: Loop, other: set[int]) -> Slam:
    """Move the submap of keyframes `other` to where a loop places it, in the scale of the rest."""
    first, second = loop.pair.key
    ratio = 1.0 if loop.scale is None else loop.scale.ratio
    if first in other:
        # The loop is in the scale of its first keyframe, which changes.
        ratio = 1.0 / ratio
        motion = rigid.invert(scaled_motion(loop.motion, ratio).pose)
        number, place = first, motion @ slam.keyframes[second].pose
    else:
        number, place = second, loop.motion.pose @ slam.keyframes[first].pose
    scaled = scale_submap(slam, ratio, other)
    return moved_submap(scaled, other, rigid.invert(scaled.keyframes[number].pose) @ place).with_window(fixed=())
