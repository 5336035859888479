"""Self-calibration: estimate an unknown camera on calibration frames; the run then begins with it.

If camera and poses are estimated together while tracking, each absorbs errors of the other. Matches, tracks and loop
closures made with a wrong camera stay wrong when the last adjustment finds a better one. So the calibration frames are
tracked and adjusted first, and the run begins with the camera that was found (`benchmarks/no_calibration.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.datasets.intrinsics import check_plausible
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError
from vggtgeo.slam.camera.camera_estimate import MIN_KEYFRAMES_FOR_CAMERA
from vggtgeo.slam.camera.pixel_aspect import are_square
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.pipeline import begin
from vggtgeo.slam.run import finish, run_frames
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam

CALIBRATION_FRAMES = 150
"""Frames that a run calibrates an unknown camera on: five seconds of a video. Where frames cannot be read twice (a live
camera, a stream), it is estimated while tracking."""
FRAMES_PER_PASS = CALIBRATION_FRAMES // 3
"""Every third of these frames: enough to link the keyframes, which are what determines the camera. If tracking is lost
between them, all are tracked."""
MIN_KEYFRAMES = 10
"""Keyframes that self-calibration without depth needs; as many as a window has: a smaller map is adjusted as a whole
while tracking, and its few keyframes have little parallax. With depth, as many as the last adjustment needs."""
MAX_PASSES, CONVERGED = 3, 0.03
"""Passes over the calibration frames, and the relative change of the focal length that ends them. A lens with strong
distortion needs more than one pass: the first finds a focal length without the lens. The run's last adjustment corrects
what is left."""
MIN_TRACKED = 0.5
"""Share of the calibration frames that must be tracked; otherwise their camera estimate is not used."""


def self_calibrate(
    frames: Callable[[int], Iterable[Frame]],
    count: int,
    camera: Camera,
    roles: Roles,
    settings: SlamSettings,
    progress: Callable[[int, int | None], None] = lambda passes, frame: None,
) -> Slam | None:
    """Return the state before the first frame with a self-calibrated camera; None if the frames do not determine it.

    While the camera changes much from one pass to the next, the frames that became keyframes are tracked again.

    frames: returns every n-th of the calibration frames, each time it is called with n. count: of these frames.
    camera: the initial guess. progress: called with the number of the pass, and the index of its newest frame; None:
    its map is adjusted now.
    """
    for stride in sorted({max(count // FRAMES_PER_PASS, 1), 1}, reverse=True):
        found = _calibrated_by(partial(frames, stride), camera, roles, settings, progress)
        if found is not None:
            return found
    return None


def _calibrated_by(
    frames: Callable[[], Iterable[Frame]],
    camera: Camera,
    roles: Roles,
    settings: SlamSettings,
    progress: Callable[[int, int | None], None],
) -> Slam | None:
    before, keyframes = None, frozenset[int]()
    for passes in range(1, MAX_PASSES + 1):
        chosen = (frame for frame in frames() if passes == 1 or frame.index in keyframes)
        last = None
        for slam in run_frames(chosen, camera, roles, settings, Clock(), before):
            progress(passes, slam.frames[-1].frame)
            last = slam
        if last is None or not _determines_camera(last):
            return None
        progress(passes, None)
        # Later rounds do not change the camera.
        found = finish(last, roles, settings, rounds=1, uncertainty=False)
        if not _is_plausible(found, camera):
            return None
        before, own, lens = begin(camera, roles), found.intrinsics, found.camera.lens
        before = before.with_camera(intrinsics=own, given=own, self_calibrated=True, lens=lens)
        before = before.with_notes(_note(found, passes, camera))
        moved = np.abs(own[:2] / last.intrinsics[:2] - 1).max()
        if moved < CONVERGED and (lens is None) == (last.camera.lens is None):
            break
        keyframes = frozenset(keyframe.frame for keyframe in last.keyframes)
    return before


def _determines_camera(slam: Slam) -> bool:
    tracked = np.mean([record.tracked for record in slam.frames])
    least = MIN_KEYFRAMES_FOR_CAMERA if slam.metric else MIN_KEYFRAMES
    return bool(len(slam.keyframes) >= least and tracked >= MIN_TRACKED)


def _is_plausible(found: Slam, camera: Camera) -> bool:
    fx, fy, cx, cy = map(float, found.intrinsics)
    lens = () if found.camera.lens is None else found.camera.lens.distortion
    try:
        check_plausible("the self-calibrated camera", replace(camera, intrinsics=(fx, fy, cx, cy), distortion=lens))
    except InputError:
        return False
    return True


def _note(found: Slam, passes: int, camera: Camera) -> str:
    focal = " and ".join(dict.fromkeys(f"{value:.1f}" for value in found.intrinsics[:2]))
    times = "" if passes == 1 else f" in {passes} passes"
    pixels = "" if are_square(found.intrinsics) else ", pixels are not square"
    text = (
        f"self-calibration on {len(found.frames)} frames{times}: focal length {focal} px "
        f"(images of {camera.width} x {camera.height}{pixels})"
    )
    if found.camera.lens is None:
        return text
    k1, k2, *_ = found.camera.lens.distortion
    return f"{text}, lens distortion k1 {k1:.3f}, k2 {k2:.3f}; the images are undistorted by it"
