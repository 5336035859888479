"""A first pass over frames of a camera that nobody gave: what it finds of the camera, the run begins with.

While the camera is estimated beside the poses, each takes up the errors of the other, and what was matched, tracked and
closed with a wrong camera stays wrong when a better one is found at the end. On building-walk, images alone, the focal
length of the windows is 473 to 482 px; the last adjustment finds 485 (495.6 is true), and the path is off by 26.2 cm. A
run that begins with these 485 px is off by 5.4.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace

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

LEAST_KEYFRAMES = 10
"""Without depth; as many as a window has: the camera of fewer is estimated from all of them while the run goes on, too.
101 frames of icl-office, images alone, have six keyframes and hardly any parallax: 516 px (481 is true). With depth
three tell it, as many as the last adjustment needs: 52 of these frames had 480.6 px in the end, but each pose the
camera of its moment, 0.89 cm off in all; with a first pass 480.5 px and 0.08 cm."""
MOST_PASSES, SETTLED = 3, 0.03
"""Of the same frames, and how far the focal length may be from the one that they were tracked with, relative. With a
lens of k1 = -0.25, images alone: corridor-office 843 px and no lens after the first pass, 517 px and -0.20 after the
third (495.6 is true); redkitchen 526 px and -0.24 after the first (525)."""
LEAST_TRACKED = 0.5
"""Share of the frames; where fewer were tracked, the camera that they gave may be anything."""


def begin_with_found_camera(
    frames: Callable[[], Iterable[Frame]], camera: Camera, roles: Roles, settings: SlamSettings
) -> Slam | None:
    """The state before the first frame, with the camera that some frames tell; None where they do not tell it.

    Where the camera that is found is far from the one that the frames were tracked with, it is tried on them again.

    frames: gives them, from the first on, each time it is called. camera: the guess to begin with.
    """
    before = None
    for passes in range(1, MOST_PASSES + 1):
        last = deque(run_frames(frames(), camera, roles, settings, Clock(), before), maxlen=1)
        if not last or not _tells_a_camera(last[0]):
            return None
        # What comes after the first round changes no camera.
        once = replace(settings, refinement=replace(settings.refinement, global_rounds=1))
        found = finish(last[0], roles, once)
        if not _is_plausible(found, camera):
            return None
        before = begin(camera, roles)
        before = replace(
            before,
            camera=replace(
                before.camera,
                intrinsics=found.intrinsics,
                given=found.intrinsics,
                self_calibrated=True,
                lens=found.camera.lens,
            ),
            notes=(_note(found, passes, camera),),
        )
        moved = np.abs(found.intrinsics[:2] / last[0].intrinsics[:2] - 1).max()
        if moved < SETTLED and (found.camera.lens is None) == (last[0].camera.lens is None):
            break
    return before


def _tells_a_camera(slam: Slam) -> bool:
    tracked = np.mean([record.tracked for record in slam.frames])
    least = MIN_KEYFRAMES_FOR_CAMERA if slam.metric else LEAST_KEYFRAMES
    return bool(len(slam.keyframes) >= least and tracked >= LEAST_TRACKED)


def _is_plausible(found: Slam, camera: Camera) -> bool:
    fx, fy, cx, cy = map(float, found.intrinsics)
    lens = () if found.camera.lens is None else found.camera.lens.distortion
    try:
        check_plausible("the camera of a first pass", replace(camera, intrinsics=(fx, fy, cx, cy), distortion=lens))
    except InputError:
        return False
    return True


def _note(found: Slam, passes: int, camera: Camera) -> str:
    focal = " and ".join(dict.fromkeys(f"{value:.1f}" for value in found.intrinsics[:2]))
    times = "a first pass" if passes == 1 else f"{passes} first passes"
    text = (
        f"nobody gave the camera: {times} over {len(found.frames)} frames found a focal length of {focal} px "
        f"({'images' if are_square(found.intrinsics) else 'pixels that are not square, images'} of "
        f"{camera.width} x {camera.height})"
    )
    if found.camera.lens is None:
        return text
    k1, k2, *_ = found.camera.lens.distortion
    return f"{text} and a lens that distorts, k1 {k1:.3f}, k2 {k2:.3f}; the images are undistorted by that"
