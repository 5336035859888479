"""Metric depth from a sensor, and its absence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from vggtgeo.models.roles import DepthEstimate

from vggtgeo.io.argument_checks import check_array, check_fields


@dataclass(frozen=True)
class SensorDepth:
    """A depth camera's own depth, with the noise of a Kinect.

    sigma_z = axial + quadratic (z - noise_offset)^2 metres: Nguyen, Izadi, Lovell, "Modeling Kinect sensor noise for
    improved 3D reconstruction and tracking", 3DIMPVT 2012; its growth with z^2 is that of triangulation from disparity
    (Khoshelham and Oude Elberink, "Accuracy and resolution of Kinect depth data", Sensors 2012). `floor` adds, in
    quadrature and relative to z, what calibration leaves behind between views; what it leaves in all of them alike is
    no noise. With 0.3 %, surfaces of pairs of frames differ by 0.2 to 0.4 of the stated sigma on two HoloLens clips, a
    Kinect's and a simulated one (cells of 16 pixels, median); with 1 %, by 0.1, and motions between neighbouring frames
    are a third less accurate (6.1 instead of 4.5 mm, 6.9 instead of 5.2). Near a jump of depth the pixel may belong to
    either side, so confidence falls there and sigma_rel grows with the jump.

    min_depth, max_depth: depths outside are dropped, metres. edge: relative jump between neighbours at which confidence
    has fallen to one half. reach: how far from a jump it is felt, pixels.
    """

    axial: float = 0.0012
    quadratic: float = 0.0019
    noise_offset: float = 0.4
    floor: float = 0.003
    min_depth: float = 0.2
    max_depth: float = 8.0
    edge: float = 0.05
    reach: int = 2

    def __post_init__(self) -> None:
        check_fields(self, min_depth="[0, inf)", max_depth=f"({self.min_depth}, inf)")
        check_fields(self, floor="[0, inf)", edge="(0, inf)", reach="[0, inf)")

    def estimate(
        self,
        image: np.ndarray,
        sensor_depth: np.ndarray | None = None,
        intrinsics: Sequence[float] | None = None,
    ) -> DepthEstimate:
        """Return the sensor's depth with its noise; nothing anywhere when `sensor_depth` is None."""
        if sensor_depth is None:
            return no_depth(image.shape[:2])
        check_array("sensor_depth", sensor_depth, image.shape[:2], finite=False)
        depth = sensor_depth.astype(np.float32)
        valid = (depth >= self.min_depth) & (depth <= self.max_depth)
        jump = _relative_jump(np.where(valid, depth, np.nan), self.reach)
        confidence = np.where(valid, 1.0 / (1.0 + (jump / self.edge) ** 2), 0.0)
        sigma = np.where(valid, np.hypot(self.noise(np.where(valid, depth, np.float32(1.0))), 0.5 * jump), np.nan)
        return DepthEstimate(
            np.where(valid, depth, np.float32(np.nan)),
            confidence.astype(np.float32),
            sigma.astype(np.float32),
        )

    def noise(self, depth: np.ndarray) -> np.ndarray:
        """Return relative standard deviation of a depth (metres, any shape) away from jumps."""
        # In place, and not by np.hypot: a third of the time, and nothing here is near the ends of the numbers.
        away = depth - self.noise_offset
        away *= away
        away *= self.quadratic
        away += self.axial
        away /= depth
        away *= away
        away += self.floor**2
        return np.asarray(np.sqrt(away))


@dataclass(frozen=True)
class NoDepth:
    """No metric depth at all: the scale of the world stays free."""

    def estimate(
        self,
        image: np.ndarray,
        sensor_depth: np.ndarray | None = None,
        intrinsics: Sequence[float] | None = None,
    ) -> DepthEstimate:
        """Return NaN everywhere, whatever the sensor says."""
        return no_depth(image.shape[:2])


def no_depth(shape: tuple[int, int]) -> DepthEstimate:
    """Return an estimate of `shape` (H, W) that knows nothing."""
    nothing = np.full(shape, np.nan, dtype=np.float32)
    return DepthEstimate(nothing, np.zeros(shape, dtype=np.float32), nothing.copy())


def _relative_jump(depth: np.ndarray, reach: int) -> np.ndarray:
    """Return float [H, W]: how far depth departs from a plane within `reach` pixels, relative to depth; 0 if NaN.

    The second difference of inverse depth vanishes on every plane, however slanted, so that only edges count.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = np.nan_to_num(1.0 / depth, nan=0.0, posinf=0.0)
    known = inverse > 0
    step = max(reach, 1)
    bend = np.zeros_like(inverse)
    for value, valid, largest in ((inverse, known, bend), (inverse.T, known.T, bend.T)):
        before, here, after = slice(None, -2 * step), slice(step, -step), slice(2 * step, None)
        second = np.abs(value[before] - 2.0 * value[here] + value[after])
        np.maximum(largest[here], second, out=largest[here], where=valid[before] & valid[here] & valid[after])
    spread = cv2.dilate(bend.astype(np.float32), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    return np.where(known, spread / np.maximum(inverse, 1e-9), 0.0)
