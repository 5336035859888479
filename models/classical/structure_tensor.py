"""Dense confidence from the structure tensor: how well gradients localise a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.io.argument_checks import check_fields


@dataclass(frozen=True)
class StructureTensor:
    """Omega = s / (s + tau), with s the smoothed gradient energy that localises a pixel.

    The structure tensor A = G * (grad I grad I^T) (Foerstner and Guelch 1987) has eigenvalues l1 >= l2; l2 measures how
    well both coordinates are determined (corners), l1 one (edges). s = l2 + `edges` l1, so that a pixel on a straight
    edge keeps part of its confidence for the line residual. tau = `noise`^2: grey levels a pixel of gradient at which
    the confidence is one half.

    sigma: standard deviation of the Gaussian window G, pixels.
    """

    sigma: float = 2.0
    noise: float = 6.0
    edges: float = 0.1

    def __post_init__(self) -> None:
        check_fields(self, sigma="(0, inf)", noise="(0, inf)", edges="[0, inf)")

    def confidence(self, image: np.ndarray) -> np.ndarray:
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        # Scharr's 3 x 3 derivative sums to 32 for a ramp of one grey level a pixel.
        dx = cv2.Scharr(gray, cv2.CV_32F, 1, 0, scale=1 / 32)
        dy = cv2.Scharr(gray, cv2.CV_32F, 0, 1, scale=1 / 32)
        xx, yy, xy = (cv2.GaussianBlur(product, (0, 0), self.sigma) for product in (dx * dx, dy * dy, dx * dy))
        half_trace = 0.5 * (xx + yy)
        radius = np.sqrt((0.5 * (xx - yy)) ** 2 + xy * xy)
        strength = np.maximum(half_trace - radius, 0.0) + self.edges * (half_trace + radius)
        return strength / (strength + np.float32(self.noise**2))
