"""The window's insertion and adjustment as steps of the whole state."""

from __future__ import annotations

from dataclasses import replace

from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.window import sliding_window
from vggtgeo.slam.window.adjustment import CameraPrior


def insert_keyframe(
    slam: Slam,
    keyframe: Keyframe,
    roles: Roles,
    settings: SlamSettings,
    tied_to: int | None = None,
    *,
    length_known: bool = True,
) -> Slam:
    """Insert a keyframe, which was tracked against `tied_to`, into the window and match it to the others.

    length_known: whether the distance to `tied_to` is measured.
    """
    given = slam.map, slam.window, keyframe, slam.intrinsics, roles, settings, tied_to
    known, window = sliding_window.enter(*given, length_known=length_known)
    return replace(slam, map=known, window=window)


def adjust_window(slam: Slam, settings: SlamSettings) -> Slam:
    """Adjust the window of the state."""
    found = sliding_window.adjust(slam.map, slam.window, slam.intrinsics, camera_prior(slam), settings)
    return replace(
        slam,
        map=found.map,
        window=found.window,
        camera=replace(slam.camera, intrinsics=found.intrinsics),
        notes=(*slam.notes, *(note for note in found.notes if note not in slam.notes)),
    )


def camera_prior(slam: Slam) -> CameraPrior:
    """Return the prior of the intrinsics in the window."""
    sigma = slam.camera.window_sigma(len(slam.keyframes))
    return CameraPrior(slam.camera.given, sigma)
