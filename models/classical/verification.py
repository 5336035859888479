"""Geometric verification of matches between two views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from vggtgeo.models.checks import check_fields
from vggtgeo.models.classical.sample_order import SampleOrder

from vggtgeo.geometry import pinhole


@dataclass(frozen=True)
class EpipolarVerifier:
    """Keep the matches of one epipolar geometry, estimated by MAGSAC++ (Barath et al. 2020).

    The model is the essential matrix if `intrinsics` are given, else the fundamental matrix. For a single plane, or a
    camera that only rotates, it is undetermined: it accepts the inliers of a homography, and wrong matches near its
    epipolar lines. So if it explains no more of the outliers of a homography than chance, the homography decides.

    threshold: maximum epipolar (or transfer) error of an inlier, pixels. least: minimum number of matches.
    """

    threshold: float = 2.0
    intrinsics: Sequence[float] | None = None
    confidence: float = 0.999
    max_iterations: int = 2000
    least: int = 12
    order: SampleOrder = field(default_factory=SampleOrder)

    def __post_init__(self) -> None:
        check_fields(self, threshold="(0, inf)", least="[8, inf)")

    def inliers(self, pixels_i: np.ndarray, pixels_j: np.ndarray) -> np.ndarray:
        """Return which of the matches [m, 2] -> [m, 2] agree, bool [m]; all False if there are too few."""
        if len(pixels_i) < self.least:
            return np.zeros(len(pixels_i), dtype=bool)
        order = self.order.of(len(pixels_i))
        first, second = (np.ascontiguousarray(pixels[order], np.float64) for pixels in (pixels_i, pixels_j))
        return self.order.undone(self._inliers(first, second))

    def _inliers(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        epipolar = self._epipolar(first, second)
        # A well determined epipolar geometry needs no homography, which costs as much again.
        if np.count_nonzero(epipolar) >= 0.7 * len(first):
            return epipolar
        homography = self._homography(first, second)
        best = homography if _adds_nothing(epipolar, homography) else epipolar
        return best if np.count_nonzero(best) >= self.least else np.zeros(len(first), dtype=bool)

    def _epipolar(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        settings = (cv2.USAC_MAGSAC, self.confidence, self.threshold, self.max_iterations)
        if self.intrinsics is not None:
            mask = _quietly(cv2.findEssentialMat, first, second, pinhole.matrix(self.intrinsics), *settings)
        else:
            method, confidence, threshold, iterations = settings
            mask = _quietly(cv2.findFundamentalMat, first, second, method, threshold, confidence, iterations)
        return _as_bool(mask, len(first))

    def _homography(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        mask = _quietly(
            cv2.findHomography,
            first,
            second,
            cv2.USAC_MAGSAC,
            self.threshold,
            None,
            self.max_iterations,
            self.confidence,
        )
        return _as_bool(mask, len(first))


def _adds_nothing(epipolar: np.ndarray, homography: np.ndarray) -> bool:
    """Return whether epipolar geometry explains no more than chance of the matches that the homography leaves.

    A wrong match lies within 2 px of a line across a 300 pixel image with a probability of about 3 %.
    """
    extra = np.count_nonzero(epipolar & ~homography)
    return bool(extra < 0.15 * np.count_nonzero(~homography))


def _quietly(estimate: Callable[..., tuple[Any, np.ndarray | None]], *arguments: Any) -> np.ndarray | None:
    """Return the inlier mask of an OpenCV estimator; None for degenerate points (all equal, collinear)."""
    try:
        return estimate(*arguments)[1]
    except cv2.error:
        return None


def _as_bool(mask: np.ndarray | None, count: int) -> np.ndarray:
    if mask is None or mask.size != count:
        return np.zeros(count, dtype=bool)
    return mask.ravel().astype(bool)
