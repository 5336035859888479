"""The estimate of the camera: intrinsics and their prior, the lens, the rolling shutter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry.camera import Camera

MIN_KEYFRAMES_FOR_CAMERA = 3
"""Keyframes that the estimate of a camera needs; as many as the last adjustment."""
KNOWN_SIGMA = 1e-6
"""Standard deviation of known intrinsics, relative to the focal length: small enough that no adjustment changes them.
A wide prior lets the focal length absorb errors of the poses."""
GUESSED_FOCAL_SIGMA = 0.3
"""Standard deviation of a guessed focal length, relative to it: the guess is a field of view of 60 degrees
(`Camera.guess`), and one standard deviation spans 48 to 79."""
GUESSED_CENTRE_SIGMA = 0.02
"""Standard deviation of a guessed principal point, in image widths and heights: the published calibrations of TUM
RGB-D, EuRoC, KITTI and ICL-NUIM are 0.014 off the middle (root mean square)."""
GUESSED = 0.1
"""A prior on the focal length that is wider than this share of it stands for a guess."""


@dataclass(frozen=True)
class Readout:
    """How long the camera reads an image out, s: from the first row to the last, or column where columns; negative: the
    last is read first. shift: by how much that moves matches in this run, pixels, exceeded by one in ten.
    """

    seconds: float
    columns: bool
    shift: float


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """What is known of the camera.

    Fields:
        intrinsics: Current fx, fy, cx, cy, float64 [4], pixels.
        given: Mean of their prior.
        sigma: Standard deviation of their prior, pixels.
        self_calibrated: The camera was not given; `given` and `lens` come from calibration frames
            (`self_calibration.py`), or from the run that made the known map. Windows hold them, and the last adjustment
            estimates the camera again.
        lens: The distorting camera of the images as they were read, where the last adjustment found one. Pixels and
            images of all keyframes, and `intrinsics`, are then of undistorted images (`lens.py`).
        readout: Of the rolling shutter that the last adjustment found and removed from the poses
            (`rolling_shutter.py`). Pixels and images stay as they were read.

    """

    intrinsics: np.ndarray
    given: np.ndarray
    sigma: np.ndarray
    self_calibrated: bool = False
    lens: Camera | None = None
    readout: Readout | None = None

    @classmethod
    def of(cls, camera: Camera) -> CameraEstimate:
        """Return the estimate before the first frame: a given camera is held, a guessed one has a wide prior."""
        intrinsics = np.array(camera.intrinsics, np.float64)
        if camera.known:
            sigma = np.full(4, KNOWN_SIGMA * intrinsics[0])
        else:
            focal = GUESSED_FOCAL_SIGMA * intrinsics[0]
            centre = GUESSED_CENTRE_SIGMA * np.array([camera.width, camera.height])
            sigma = np.array([focal, focal, *centre])
        return cls(intrinsics, given=intrinsics, sigma=sigma)

    @property
    def calibrated(self) -> bool:
        """Whether the camera was given, not guessed."""
        return was_given(self.given, self.sigma, self.self_calibrated)

    def window_sigma(self, keyframes: int) -> np.ndarray:
        """Standard deviation of the camera's prior in a window of a map of so many keyframes, float64 [4], pixels.

        A self-calibrated camera is held as a given one is, and so is a guess while there are two keyframes: two views
        do not determine a focal length.
        """
        if not self.self_calibrated and (self.calibrated or keyframes >= MIN_KEYFRAMES_FOR_CAMERA):
            return self.sigma
        return np.full(4, KNOWN_SIGMA * self.given[0])


def was_given(given: np.ndarray, sigma: np.ndarray, self_calibrated: bool) -> bool:
    """Whether a prior of the intrinsics, mean and standard deviation in pixels, is that of a camera that was given.

    self_calibrated: maybe so far from the guess that its `sigma` is a small share of `given`.
    """
    return bool(not self_calibrated and sigma[0] < GUESSED * given[0])
