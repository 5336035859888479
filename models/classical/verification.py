"""Geometric verification of matches between two views, and the seeds of robust estimation.

OpenCV's samplers (USAC) have a generator that starts in the same state at every call, independent of `setRNGSeed`.
Another order of the matches gives other samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar

import cv2
import numpy as np

from vggtgeo.geometry import pinhole
from vggtgeo.io.argument_checks import check_fields

Role = TypeVar("Role")


@dataclass(frozen=True)
class SampleOrder:
    """Order of matches by a seed; 0 keeps the given order.

    Example:
        >>> from vggtgeo.models.classical import SampleOrder
        >>> SampleOrder().of(3).tolist(), SampleOrder(1).of(3).tolist()
        ([0, 1, 2], [2, 0, 1])

    """

    seed: int = 0

    def of(self, count: int) -> np.ndarray:
        """Return a permutation of `count` matches, int [count]."""
        if self.seed == 0:
            return np.arange(count)
        return np.random.default_rng(self.seed).permutation(count)

    def undone(self, values: np.ndarray) -> np.ndarray:
        """Return values [count] from this order in the given order."""
        own = np.empty_like(values)
        own[self.of(len(values))] = values
        return own

    def estimate(
        self, estimator: Callable[..., Any], pixels_i: np.ndarray, pixels_j: np.ndarray, *settings: Any
    ) -> tuple[Any, np.ndarray]:
        """Return the model of an OpenCV estimator and its inliers among the matches [m, 2] -> [m, 2], bool [m].

        None and no inliers for degenerate points (all equal, collinear).
        """
        rows = self.of(len(pixels_i))
        first, second = (np.ascontiguousarray(pixels[rows], np.float64) for pixels in (pixels_i, pixels_j))
        try:
            model, mask = estimator(first, second, *settings)
        except cv2.error:
            model = mask = None
        if mask is None or mask.size != len(first):
            return None, np.zeros(len(first), dtype=bool)
        return model, self.undone(mask.ravel().astype(bool))


def in_order(role: Role, order: SampleOrder) -> Role:
    """Return a role, with all its parts, with another order of samples."""
    if isinstance(role, SampleOrder):
        changed: Any = order
        return changed
    if not is_dataclass(role) or isinstance(role, type):
        return role
    members = {part.name: getattr(role, part.name) for part in fields(role) if part.init}
    new = {name: made for name, value in members.items() if (made := in_order(value, order)) is not value}
    return replace(role, **new) if new else role


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
        none = np.zeros(len(pixels_i), dtype=bool)
        if len(pixels_i) < self.least:
            return none
        if self.intrinsics is None:
            settings: tuple[Any, ...] = (cv2.USAC_MAGSAC, self.threshold, self.confidence, self.max_iterations)
            _, epipolar = self.order.estimate(cv2.findFundamentalMat, pixels_i, pixels_j, *settings)
        else:
            matrix = pinhole.matrix(self.intrinsics)
            settings = (matrix, cv2.USAC_MAGSAC, self.confidence, self.threshold, self.max_iterations)
            _, epipolar = self.order.estimate(cv2.findEssentialMat, pixels_i, pixels_j, *settings)
        # A well determined epipolar geometry needs no homography, which costs as much again.
        if np.count_nonzero(epipolar) >= 0.7 * len(pixels_i):
            return epipolar
        settings = (cv2.USAC_MAGSAC, self.threshold, None, self.max_iterations, self.confidence)
        _, homography = self.order.estimate(cv2.findHomography, pixels_i, pixels_j, *settings)
        best = homography if _adds_nothing(epipolar, homography) else epipolar
        return best if np.count_nonzero(best) >= self.least else none


def _adds_nothing(epipolar: np.ndarray, homography: np.ndarray) -> bool:
    """Return whether epipolar geometry explains no more than chance of the matches that the homography leaves.

    A wrong match lies within 2 px of a line across a 300 pixel image with a probability of about 3 %.
    """
    extra = np.count_nonzero(epipolar & ~homography)
    return bool(extra < 0.15 * np.count_nonzero(~homography))
