"""A first pass over frames of a camera that nobody gave: what it finds of the camera, the run begins with.

While the camera is estimated beside the poses, each takes up the errors of the other, and what was matched, tracked and
closed with a wrong camera stays wrong when a better one is found at the end. On building-walk, images alone, the focal
length of the windows is 473 to 482 px; the last adjustment finds 485 (495.6 is true), and the path is off by 26.2 cm. A
run that begins with these 485 px is off by 5.4.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.datasets.intrinsics import check_plausible
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.pipeline import begin
from vggtgeo.slam.run import finish, run_frames
from vggtgeo.slam.settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam

LEAST_KEYFRAMES = 10
"""As many as a window has: the camera of fewer is estimated from all of them while the run goes on, too. 101 frames of
icl-office, images alone, have six keyframes and hardly any parallax: 516 px (481 is true)."""
LEAST_TRACKED = 0.5
"""Share of the frames; where fewer were tracked, the camera that they gave may be anything."""


def begin_with_found_camera(
    frames: Iterable[Frame], camera: Camera, roles: Roles, settings: SlamSettings
) -> Slam | None:
    """The state before the first frame, with the camera that `frames` tell; None where they do not tell it.

    camera: the guess that the pass begins with.
    """
    last = deque(run_frames(frames, camera, roles, settings, Clock()), maxlen=1)
    if not last or len(last[0].keyframes) < LEAST_KEYFRAMES:
        return None
    if np.mean([record.tracked for record in last[0].frames]) < LEAST_TRACKED:
        return None
    # What comes after the first round changes no camera.
    once = replace(settings, refinement=replace(settings.refinement, global_rounds=1))
    found = finish(last[0], roles, once)
    lens = found.lens
    fx, fy, cx, cy = map(float, found.intrinsics)
    seen = replace(camera, intrinsics=(fx, fy, cx, cy), distortion=lens.distortion if lens else ())
    try:
        check_plausible("the camera of a first pass", seen)
    except InputError:
        return None
    intrinsics = np.array(seen.intrinsics, np.float64)
    before = begin(camera, roles, settings)
    return replace(
        before, intrinsics=intrinsics, given_intrinsics=intrinsics, camera_found=True, lens=lens, notes=(_note(found),)
    )


def _note(found: Slam) -> str:
    focal = " and ".join(dict.fromkeys(f"{value:.1f}" for value in found.intrinsics[:2]))
    text = f"nobody gave the camera: a first pass over {len(found.frames)} frames found a focal length of {focal} px"
    if found.lens is None:
        return text
    k1, k2, *_ = found.lens.distortion
    return f"{text} and a lens that distorts, k1 {k1:.3f}, k2 {k2:.3f}; the images are undistorted by that"
