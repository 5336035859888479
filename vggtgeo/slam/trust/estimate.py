"""What is judged: the poses and the camera that a run claims, in plain arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.camera.camera_estimate import MIN_KEYFRAMES_FOR_CAMERA, Readout, was_given
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.state import Slam
from vggtgeo.slam.submaps import pieces_by_size


@dataclass(frozen=True, eq=False)
class Estimate:
    """The claim of a run.

    frames: int [n]; times: float64 [n], s; poses: float64 [n, 4, 4], world -> camera; tracked: bool [n].
    intrinsics: fx, fy, cx, cy at the end; given: before the run; sigma: of their prior, pixels. metric: lengths are
    metres. inliers: int [n], matches that agreed with the pose; is_keyframe: bool [n]. pieces: how many parts the map
    has. started: whether there ever was a map. by_surface: bool [n], frames that picture and surfaces place beyond
    doubt, without any match; None: no frame. focal_wanted: focal lengths that the last adjustment found if they are
    free, float64 [2], pixels; None where that explained nothing. readout: of the rolling shutter that was found.
    in_known_map: whether the run began in the map of an earlier one. guessed: whether nobody gave the camera, and too
    little was seen to find it. focal_without_lens: pixels, by the frames that told of a lens, before it was found;
    focal_with_lens: that of a lens that was tried and not taken. camera_found: `given` is what a first pass found.
    """

    frames: np.ndarray
    times: np.ndarray
    poses: np.ndarray
    tracked: np.ndarray
    intrinsics: np.ndarray
    given: np.ndarray
    sigma: np.ndarray
    metric: bool
    inliers: np.ndarray
    is_keyframe: np.ndarray
    pieces: int = 1
    started: bool = True
    by_surface: np.ndarray | None = None
    focal_wanted: np.ndarray | None = None
    readout: Readout | None = None
    in_known_map: bool = False
    guessed: bool = False
    focal_without_lens: float | None = None
    focal_with_lens: float | None = None
    camera_found: bool = False

    @classmethod
    def of(cls, slam: Slam) -> Self:
        """The claim of a state."""
        times, poses = frame_poses(slam)
        known = any(np.isfinite(keyframe.points.inverse_depth).any() for keyframe in slam.keyframes)
        return cls(
            np.array([record.frame for record in slam.frames], int),
            times,
            poses,
            np.array([record.tracked for record in slam.frames], bool),
            np.asarray(slam.intrinsics, np.float64),
            np.asarray(slam.camera.given, np.float64),
            np.asarray(slam.camera.sigma, np.float64),
            slam.metric,
            np.array([record.inliers for record in slam.frames], int),
            np.isin([record.frame for record in slam.frames], [keyframe.frame for keyframe in slam.keyframes]),
            max(len(pieces_by_size(slam)), 1),
            known,
            np.array([record.evidence.placed_by_surface for record in slam.frames], bool),
            slam.camera.focal_wanted,
            slam.camera.readout,
            any(keyframe.frame < 0 for keyframe in slam.keyframes),
            not (slam.camera.calibrated or slam.camera.self_calibrated)
            and len(slam.keyframes) < MIN_KEYFRAMES_FOR_CAMERA,
            slam.camera.focal_without_lens,
            slam.camera.focal_with_lens,
            slam.camera.self_calibrated,
        )

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def centres(self) -> np.ndarray:
        """Camera centres, float64 [n, 3]."""
        return rigid.invert(self.poses)[:, :3, 3]

    @property
    def calibrated(self) -> bool:
        """Whether the intrinsics were given, not guessed."""
        return was_given(self.given, self.sigma, self.camera_found)
