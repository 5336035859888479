"""What a run claims and the verdict tests: poses and camera, in plain arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.camera.camera_estimate import MIN_KEYFRAMES_FOR_CAMERA, Readout
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.state import Slam
from vggtgeo.slam.submaps import submaps_by_size
from vggtgeo.slam.verdict.thresholds import MAX_PLACE_ERROR, MAX_PLACE_ERROR_SHARE


@dataclass(frozen=True, eq=False)
class Claim:
    """The claim of a run. frames: int [n]. times: float64 [n], s. poses: float64 [n, 4, 4], world -> camera. tracked:
    bool [n]. intrinsics: fx, fy, cx, cy, pixels. metric: lengths are metres. submaps: their number. started: there was
    a map. began_in_known_map: the run began in the map of an earlier one. guessed: the camera is unknown, and too
    little was seen to estimate it. readout: of the rolling shutter that the last adjustment found.
    """

    frames: np.ndarray
    times: np.ndarray
    poses: np.ndarray
    tracked: np.ndarray
    intrinsics: np.ndarray
    metric: bool
    submaps: int = 1
    started: bool = True
    began_in_known_map: bool = False
    guessed: bool = False
    readout: Readout | None = None

    @classmethod
    def of(cls, slam: Slam) -> Self:
        """Return the claim of a state."""
        times, poses = frame_poses(slam)
        known = slam.camera.calibrated or slam.camera.self_calibrated
        return cls(
            frames=np.array([record.frame for record in slam.frames], int),
            times=times,
            poses=poses,
            tracked=np.array([record.tracked for record in slam.frames], bool),
            intrinsics=np.asarray(slam.intrinsics, np.float64),
            metric=slam.metric,
            submaps=max(len(submaps_by_size(slam)), 1),
            started=any(np.isfinite(keyframe.points.inverse_depth).any() for keyframe in slam.keyframes),
            began_in_known_map=any(keyframe.frame < 0 for keyframe in slam.keyframes),
            guessed=not known and len(slam.keyframes) < MIN_KEYFRAMES_FOR_CAMERA,
            readout=slam.camera.readout,
        )

    def __len__(self) -> int:
        return len(self.frames)

    def span(self, first: int, last: int) -> tuple[int, int, str]:
        """Return the numbers of the frames in two rows, and a text with them and their times."""
        start, end = int(self.frames[first]), int(self.frames[last])
        return start, end, f"frames {start} to {end} ({self.times[first]:.1f} to {self.times[last]:.1f} s)"


def extent(poses: np.ndarray) -> float:
    """Return the RMS distance of the places from their mean, of poses world -> camera [n, 4, 4], above zero."""
    return max(float(np.sqrt(np.sum(rigid.centres(poses).var(0)))), 1e-12)


def max_place_error(metric: bool, poses: np.ndarray) -> float:
    """Return the largest RMS error of these places that does not matter, in the unit of the map."""
    return MAX_PLACE_ERROR if metric else MAX_PLACE_ERROR_SHARE * extent(poses)
