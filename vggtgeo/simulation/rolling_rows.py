"""The picture that a rolling shutter would have taken, from one of a moment, its depth, and how the camera moved."""

from __future__ import annotations

from dataclasses import replace

import cv2
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import distance_transform_edt

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import lie, pinhole, rigid
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError

ROUNDS = 4
"""Until a pixel and its depth belong together: it is looked for where the one before was seen."""


def camera_velocities(times: np.ndarray, truth: Trajectory) -> np.ndarray:
    """Return motion of the camera at each time, float64 [n, 6], the tangent of world -> camera, metres and radians a
    second: that between the true poses before and after, at most three usual intervals away; zero beyond.
    """
    known = truth.timestamps
    after = np.clip(np.searchsorted(known, times, side="right"), 1, len(known) - 1)
    before = np.maximum(np.searchsorted(known, times, side="left") - 1, 0)
    poses = rigid.invert(truth.poses)
    seconds = known[after] - known[before]
    near = (seconds > 0) & (seconds <= 6 * np.median(np.diff(known)))
    return np.where(near[:, None], lie.steps(poses[before], poses[after]) / np.where(near, seconds, 1.0)[:, None], 0.0)


def rolled(frame: Frame, velocity: np.ndarray, intrinsics: tuple[float, ...], seconds: float) -> Frame:
    """Return the frame as a camera draws it that reads its rows one by one, over so many seconds, its time that of the
    middle one. velocity: of the camera, float64 [6]. Depth goes with the picture; its holes are bridged to draw that.
    """
    if frame.depth is None:
        raise InputError(f"frame {frame.index} has no depth; a rolling shutter is drawn by it: take frames with depth")
    height, width = frame.image.shape[:2]
    known = np.isfinite(frame.depth) & (frame.depth > 0)
    if not known.any():
        return frame
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    full = frame.depth[tuple(nearest)].astype(np.float32)
    moments = seconds * ((np.arange(height) + 0.5) / height - 0.5)
    # From the camera at the moment of a row to the one of the frame.
    back = np.asarray(lie.exp(jnp.asarray(-moments[:, None] * velocity)).as_matrix(), np.float64)
    rays = pinhole.grid_rays((height, width), intrinsics)

    def seen(depth: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """At the moment of the frame, what lies at these depths in the rows: its depth, and its pixels."""
        there = np.einsum("rij,rcj->rci", back[:, :3, :3], rays * depth[..., None]) + back[:, None, :3, 3]
        ahead = np.concatenate([there[..., :2], np.maximum(there[..., 2:], 1e-3)], -1)
        at = pinhole.project(ahead, intrinsics, nearest=0.0).astype(np.float32)
        return there[..., 2], (at[..., 0], at[..., 1])

    depth = full.astype(np.float64)
    for _ in range(ROUNDS):
        far, at = seen(depth)
        there = cv2.remap(full, *at, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        depth = np.maximum(depth + there - far, 0.05)
    _, at = seen(depth)
    nothing = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": float("nan")}
    measured = np.where(known, frame.depth, np.nan).astype(np.float32)
    return replace(
        frame,
        image=cv2.remap(frame.image, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        depth=cv2.remap(measured, *at, cv2.INTER_NEAREST, **nothing),
    )
