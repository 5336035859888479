"""The estimate of the camera: intrinsics and their prior, the lens, the rolling shutter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry.camera import Camera

MIN_KEYFRAMES_FOR_CAMERA = 3
"""Minimum number of keyframes to estimate the intrinsics; the last adjustment needs as many."""
KNOWN_SIGMA = 1e-6
"""Standard deviation of known intrinsics, relative to the focal length: small enough that no adjustment changes them.
A wide prior lets the focal length absorb errors of the poses."""
GUESSED_FOCAL_SIGMA = 0.3
"""Standard deviation of a guessed focal length, relative to it: the guess is a field of view of 60 degrees
(`Camera.guess`), and one standard deviation spans 48 to 79."""
GUESSED_CENTRE_SIGMA = 0.02
"""Standard deviation of a guessed principal point, in image widths and heights: the published calibrations of TUM
RGB-D, EuRoC, KITTI and ICL-NUIM are 0.014 off the middle (root mean square); more, as these are few cameras."""


@dataclass(frozen=True)
class Readout:
    """The rolling shutter. seconds: readout time from the first row (column if `columns`) to the last; negative if the
    last is read first. shift: 90th percentile of the displacement of matches that it causes in this run, pixels.
    """

    seconds: float
    columns: bool
    shift: float


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """The camera: intrinsics, their prior, lens and rolling shutter.

    Fields:
        intrinsics: Current fx, fy, cx, cy, float64 [4], pixels.
        given: Mean of their prior.
        sigma: Standard deviation of their prior, pixels.
        self_calibrated: The camera was not given; `given` and `lens` come from calibration frames
            (`self_calibration.py`), or from the run that made the known map. Windows hold them, and the last adjustment
            estimates the camera again.
        given_lens: The calibration has distortion coefficients; the images were undistorted when they were read.
        lens: The distorting camera of the images as they were read, where the last adjustment found one. Pixels and
            images of all keyframes, and `intrinsics`, are then of undistorted images (`lens.py`).
        readout: Of the rolling shutter that the last adjustment found and removed from the poses
            (`rolling_shutter.py`). Pixels and images stay as they were read.

    """

    intrinsics: np.ndarray
    given: np.ndarray
    sigma: np.ndarray
    self_calibrated: bool = False
    given_lens: bool = False
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
        return cls(intrinsics, given=intrinsics, sigma=sigma, given_lens=camera.distorts)

    @property
    def calibrated(self) -> bool:
        """Whether the camera was given, not guessed. The `sigma` of a self-calibrated one may be small, too."""
        # A prior is that of a known camera or of a guess, which is a million times wider.
        return bool(not self.self_calibrated and self.sigma[0] < GUESSED_FOCAL_SIGMA / 2 * self.given[0])

    def window_sigma(self, keyframes: int) -> np.ndarray:
        """Return the prior standard deviation of the intrinsics in a window, float64 [4], pixels.

        A self-calibrated camera is fixed like a given one, and so is a guess while the map has two keyframes: two views
        do not determine a focal length.
        """
        if not self.self_calibrated and (self.calibrated or keyframes >= MIN_KEYFRAMES_FOR_CAMERA):
            return self.sigma
        return np.full(4, KNOWN_SIGMA * self.given[0])
