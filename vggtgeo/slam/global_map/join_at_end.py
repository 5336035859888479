"""Submaps that never met while the run went on: joined when all keyframes are known, by those that look alike.

Of maps of free scale; where lengths are metres, loops join submaps (`loops.py`). Each verified pair of keyframes of two
submaps gives a similarity between them: the relative pose of its matches, and the ratio of the units of both. That one
is taken which most keyframes agree with, and at least two: one that only looks like another place agrees with no other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models.classical import can_search
from vggtgeo.slam.global_map.drift_correction import Loop
from vggtgeo.slam.global_map.join_submaps import scale_submap
from vggtgeo.slam.global_map.loops import verify
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.units import MAX_SCALE_ERROR, scaled_motion
from vggtgeo.slam.state import Slam
from vggtgeo.slam.submaps import submaps_by_size
from vggtgeo.slam.threads import map_in_threads

ALIKE = 2
"""Keyframes of the other submap that are verified for each of a submap's, those that look most like it."""
MIN_AGREEING = 2
"""Keyframes of a submap that must agree on where it is."""


def join_at_end(slam: Slam, roles: Roles) -> Slam:
    """Join submaps to the one of most frames, the largest first, until none joins any more."""
    joined = None if slam.metric else slam
    while joined is not None:
        slam, joined = joined, None
        main, *others = submaps_by_size(slam) or ((),)
        for other in others:
            joined = _joined(slam, main, other, roles)
            if joined is not None:
                break
    return slam


def _joined(slam: Slam, main: tuple[int, ...], other: tuple[int, ...], roles: Roles) -> Slam | None:
    """Move the submap `other` to its place in `main`, and return the state; None if that place is unknown."""

    def verified(pair: tuple[int, int]) -> Loop | None:
        first, second = (slam.keyframes[number] for number in pair)
        return verify(first, second, roles, slam.intrinsics)

    proposed = _look_alike(slam.keyframes, main, other)
    alone = not can_search(slam.keyframes[other[0]].features)
    found = [loop for loop in map_in_threads(verified, proposed, alone=alone) if loop is not None]
    loops = [loop for loop in found if loop.scale is not None and loop.scale.error < MAX_SCALE_ERROR]
    best: tuple[Slam, list[Loop]] | None = None
    for loop in loops:
        trial = _moved(slam, loop, set(other))
        agreeing = [one for one in loops if one.agrees(trial)]
        placed = {number for one in agreeing for number in one.pair.key if number in other}
        if len(placed) >= MIN_AGREEING and (best is None or len(agreeing) > len(best[1])):
            best = trial, agreeing
    if best is None:
        return None
    joined, agreeing = best
    note = (
        f"the submap that began at frame {slam.keyframes[other[0]].frame} is joined to the rest at the end: "
        f"{len(agreeing)} pairs of keyframes agree on its place"
    )
    motions = tuple(loop.motion for loop in agreeing if loop.motion.first in main)
    pairs = tuple(loop.pair for loop in agreeing)
    known = replace(
        joined.map,
        pairs=(*joined.map.pairs, *pairs),
        factors=(*joined.map.factors, *motions),
        roots=tuple(root for root in joined.map.roots if root not in other),
    )
    return replace(joined, map=known, notes=(*joined.notes, note))


def _look_alike(
    keyframes: tuple[Keyframe, ...], main: tuple[int, ...], other: tuple[int, ...]
) -> list[tuple[int, int]]:
    """Return pairs of keyframes of two submaps, the earlier first, that look most alike."""
    described = lambda numbers: [number for number in numbers if keyframes[number].place is not None]
    ours, theirs = described(main), described(other)
    if not ours or not theirs:
        return []
    stacked = lambda numbers: np.stack([place for number in numbers if (place := keyframes[number].place) is not None])
    similarity = stacked(theirs) @ stacked(ours).T
    best = np.argsort(-similarity, axis=1, kind="stable")[:, :ALIKE]
    pairs = {tuple(sorted((theirs[row], ours[column]))) for row in range(len(theirs)) for column in best[row]}
    return sorted((first, second) for first, second in pairs)


def _moved(slam: Slam, loop: Loop, other: set[int]) -> Slam:
    """Move the submap of keyframes `other` to where a loop places it, in the scale of the rest."""
    first, second = loop.pair.key
    ratio = 1.0 if loop.scale is None else loop.scale.ratio
    if first in other:
        # The loop is in the unit of its first keyframe, which changes.
        ratio = 1.0 / ratio
        motion = rigid.invert(scaled_motion(loop.motion, ratio).pose)
        number, place = first, motion @ slam.keyframes[second].pose
    else:
        number, place = second, loop.motion.pose @ slam.keyframes[first].pose
    scaled = scale_submap(slam, ratio, lambda own: own in other)
    carried = rigid.invert(scaled.keyframes[number].pose) @ place
    keyframes = tuple(
        replace(keyframe, pose=rigid.orthonormal(keyframe.pose @ carried)) if keyframe.number in other else keyframe
        for keyframe in scaled.keyframes
    )
    return replace(
        scaled,
        map=replace(scaled.map, keyframes=keyframes),
        window=replace(scaled.window, prior=None, solved=None, held=()),
    )
