"""Known maps: saved as a file, and loaded by another run, which relocalises in the map and extends it.

A map is a state without tracked frames: keyframes with their measurements, matches, factors, and the camera. Its
keyframes belong to no frame of the run that uses it, so their frame numbers and times (s) count up to -1, before the
first frame of any run, in their order. Clocks of two runs may show the same time (a video starts at 0), so the time at
which a keyframe was recorded is stored separately.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from vggtgeo.compilation.process_settings import in_double_precision
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.robust import FEW
from vggtgeo.io.argument_checks import path_of
from vggtgeo.io.errors import InputError
from vggtgeo.io.persistence import Format, by_name
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors
from vggtgeo.models.roles import PointMatcher
from vggtgeo.slam.camera.given_camera import FOCAL_SIGMA
from vggtgeo.slam.local_mapping import merge_pending_window
from vggtgeo.slam.state import Slam
from vggtgeo.slam.state_file import STATE_CLASSES, VERSION, checked_state

MAP = Format("map", VERSION, by_name(STATE_CLASSES))
MIN_REDESCRIBED = 0.2
"""Minimum share of a keyframe's key points matched by a new description of its stored image. The same descriptors give
0.7 or more, others nearly none."""
SAME_CAMERA = 2 * FOCAL_SIGMA
"""Largest relative difference of focal lengths and principal point between calibrations of one camera."""


def as_map(slam: Slam) -> Slam:
    """Return the map of a run's state."""
    slam = merge_pending_window(slam)
    count = len(slam.keyframes)
    keyframes = tuple(
        replace(
            keyframe.compressed(),
            frame=keyframe.number - count,
            timestamp=float(keyframe.number - count),
            recorded=keyframe.timestamp if keyframe.recorded is None else keyframe.recorded,
        )
        for keyframe in slam.keyframes
    )
    camera = replace(slam.camera, self_calibrated=False, readout=None)
    return Slam(replace(slam.map, keyframes=keyframes, axes=()), camera)


def save_map(path: str | os.PathLike[str], slam: Slam) -> None:
    """Write the map of a state (the last of a run, best after `vggtgeo.finish`), atomically; no pickles.

    Raises:
        InputError: the state has no keyframe.
        TypeError: a matcher's descriptors are of a class that files do not support.

    """
    if not slam.keyframes:
        raise InputError(f"there is no keyframe to save as a map in `{path}`; track at least one frame")
    MAP.write(path_of("path", path), as_map(slam))


@in_double_precision
def load_map(path: str | os.PathLike[str]) -> Slam:
    """Load the map that `vggtgeo run --save-map` or `Result.save_map` wrote.

    Pass it as `known_map` to `vggtgeo.run` or `vggtgeo.reconstruct`.

    Raises:
        InputError: the file is missing, damaged, of a version that is not known, or no map.

    Example:
        >>> import vggtgeo as vg
        >>> vg.load_map("office.map")
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `office.map` does not exist or is not a file; give the file of a map

    """
    found, _ = MAP.read(path_of("path", path))
    known = checked_state(Path(path), found)
    if not known.keyframes or known.frames or known.window.members or any(one.frame >= 0 for one in known.keyframes):
        raise InputError(f"`{path}` holds no map; expected keyframes alone: save one with `vggtgeo run --save-map`")
    return known


def entered(known: Slam, camera: Camera, points: PointMatcher) -> Slam:
    """Return the state before the first frame of a run with this camera and matcher in a known map.

    known: a map, or the state of a run in memory, with frames and times of that run.

    Raises:
        InputError: there is no keyframe, the map is of another camera, or its key points are of another matcher.

    """
    if not known.keyframes:
        raise InputError("`known_map` has no keyframe; give a map, or the state of a run that has tracked some frames")
    known = as_map(known)
    own = known.camera.given if known.camera.calibrated else known.intrinsics
    given = np.array(camera.intrinsics, np.float64)
    differs = camera.known and np.abs(given - own).max() > SAME_CAMERA * own[0]
    height, width = known.keyframes[0].size
    if differs or (width, height) != (camera.width, camera.height):
        before, now = (", ".join(f"{value:.1f}" for value in values) for values in (own, given))
        raise InputError(
            f"`known_map` is of images of {width} x {height} pixels with fx, fy, cx, cy = {before} px; those of this "
            f"run are {camera.width} x {camera.height} with {now} px: use a map with the camera that it was made with"
        )
    _check_matcher(known, points)
    known = known.with_tracker(lost=1)
    if known.camera.calibrated:
        return known
    # Its own run found it, and its keyframes stand as that camera sees them.
    return known.with_camera(given=known.intrinsics, self_calibrated=True)


def _check_matcher(known: Slam, points: PointMatcher) -> None:
    """Raise InputError if a run's matcher does not recognise an image of the map by its stored key points."""
    keyframe = max(known.keyframes, key=lambda keyframe: len(keyframe.features))
    if len(keyframe.features) < FEW or getattr(points, "simulated", False):
        return  # a simulated matcher knows the frames of its own sequence alone, to the bit
    before, again = keyframe.features, points.describe(keyframe.image)
    ours, theirs = again.descriptors, before.descriptors
    alike = type(ours) is type(theirs)
    if isinstance(ours, PixelDescriptors) and isinstance(theirs, PixelDescriptors):
        alike = ours.vectors.shape[1] == theirs.vectors.shape[1]
    if not alike or len(points.match(before, again)) < MIN_REDESCRIBED * min(len(before), len(again)):
        raise InputError(
            "`known_map` has key points of another matcher than this run's, which does not find a picture of the map "
            "in the map: use it with the points (`--points`, `--preset`) that it was made with, or begin a new map"
        )
