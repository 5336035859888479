"""Sub-pixel refinement of match targets by photometric alignment of affine patches."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class PatchAlignment:
    """Moves each target until the patch around it looks like the reference patch.

    Lucas and Kanade (1981) in its inverse compositional form (Baker and Matthews 2004): the patch of view i is the
    template, an affine warp A x + u of it is sought in view j, and gain and offset of the brightness are removed by
    normalising both patches. Each step solves the 6 x 6 normal equations of the template's steepest-descent images,
    which are computed once. Cost: `steps` bilinear samplings of n (2 `radius` + 1)^2 pixels, 6 ms for 500 targets.

    Measured on two indoor clips, near and far pairs: the median epipolar error falls by a quarter to a third for SIFT
    (0.20 to 0.13 px at best) and by 40 to 60 % for ORB; a patch that may only shift makes far pairs worse.

    radius: half side of the patch, pixels. farthest: a target that would move farther than this stays, pixels.
    similarity: least normalised cross-correlation of an accepted alignment.
    """

    radius: int = 7
    steps: int = 4
    farthest: float = 2.0
    similarity: float = 0.7

    def __post_init__(self) -> None:
        if self.radius < 2 or self.steps < 1:
            raise ValueError(f"`radius` is {self.radius} and `steps` {self.steps}, expected at least 2 and at least 1")
        if not self.farthest > 0 or not -1 <= self.similarity < 1:
            raise ValueError(
                f"`farthest` is {self.farthest} and `similarity` {self.similarity}, "
                "expected a positive number of pixels and a correlation in [-1, 1)"
            )

    def refine(
        self, gray_i: np.ndarray, gray_j: np.ndarray, pixels_i: np.ndarray, pixels_j: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Refined targets float64 [n, 2], and whether each was accepted, bool [n]; the others are as they came.

        gray_i, gray_j: uint8 [H, W]. pixels_i, pixels_j: float [n, 2].
        """
        if not len(pixels_i):
            return pixels_j, np.zeros(0, dtype=bool)
        grid = _grid(self.radius)
        template, descent = _template(gray_i, pixels_i, grid)
        normal = descent @ descent.transpose(0, 2, 1)
        normal += 1e-3 * np.eye(6) * np.trace(normal, axis1=1, axis2=2)[:, None, None] / 6 + 1e-9 * np.eye(6)
        inverse = np.linalg.inv(normal)
        warp = np.tile(np.eye(2), (len(pixels_i), 1, 1))
        target = pixels_j.astype(np.float64)
        for _ in range(self.steps):
            patch = _normalised(_sample(gray_j, target, warp, grid))
            step = (inverse @ (descent @ (patch - template)[..., None]))[..., 0]
            warp, target = _compose(warp, target, step, self.radius)
        patch = _normalised(_sample(gray_j, target, warp, grid))
        correlation = (patch * template).sum(axis=1)
        moved = np.linalg.norm(target - pixels_j, axis=1)
        accepted = (moved < self.farthest) & (correlation > self.similarity)
        return np.where(accepted[:, None], target, pixels_j), accepted


def patch_correlation(
    gray_i: np.ndarray, gray_j: np.ndarray, pixels_i: np.ndarray, pixels_j: np.ndarray, radius: int = 7
) -> np.ndarray:
    """Normalised cross-correlation of the patches around `pixels_i` and `pixels_j`, float [n, 2] each; float32 [n]."""
    grid, still = _grid(radius), np.broadcast_to(np.eye(2), (len(pixels_i), 2, 2))
    first, second = (
        _normalised(_sample(gray, at, still, grid)) for gray, at in ((gray_i, pixels_i), (gray_j, pixels_j))
    )
    return np.asarray((first * second).sum(axis=1))


def _grid(radius: int) -> np.ndarray:
    """Offsets of a patch's pixels, float64 [P, 2]."""
    side = np.arange(-radius, radius + 1, dtype=np.float64)
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


def _sample(gray: np.ndarray, centre: np.ndarray, warp: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """float32 [n, P]: `gray` at centre + warp @ offset."""
    turn, middle, (x, y) = warp.astype(np.float32), centre.astype(np.float32), grid.T.astype(np.float32)
    # Written out: numpy multiplies stacks of 2 x 2 matrices one by one.
    column, row = (turn[:, i, :1] * x + turn[:, i, 1:] * y + middle[:, i, None] for i in (0, 1))
    values = cv2.remap(gray, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.astype(np.float32)


def _normalised(patch: np.ndarray) -> np.ndarray:
    centred = patch - patch.mean(axis=1, keepdims=True)
    return centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-3)


def _template(gray: np.ndarray, pixels: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The normalised patch [n, P] and its derivatives [n, 6, P] by shift and by the four entries of the warp."""
    still = np.broadcast_to(np.eye(2), (len(pixels), 2, 2))
    raw = _sample(gray, pixels, still, grid)
    template = _normalised(raw)
    size = np.maximum(np.linalg.norm(raw - raw.mean(axis=1, keepdims=True), axis=1, keepdims=True), 1e-3)
    ahead = [_sample(gray, pixels + shift, still, grid) for shift in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))]
    dx, dy = (ahead[0] - ahead[1]) / size, (ahead[2] - ahead[3]) / size
    x, y = (grid / np.abs(grid).max()).astype(np.float32).T
    columns = np.stack([dx, dy, dx * x, dx * y, dy * x, dy * y], axis=1)
    # Normalising the patch removes its mean and its length: so must its derivative.
    columns -= columns.mean(axis=2, keepdims=True)
    columns -= (columns @ template[..., None]) * template[:, None]
    return template, columns


def _compose(warp: np.ndarray, target: np.ndarray, step: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """The warp after the inverse of the template's increment: W <- W o dW^-1."""
    change = np.tile(np.eye(2), (len(step), 1, 1))
    change += step[:, 2:].reshape(-1, 2, 2) / radius
    bad = np.abs(np.linalg.det(change)) < 0.1
    change[bad] = np.eye(2)
    warp = warp @ np.linalg.inv(change)
    return warp, target - np.einsum("nab,nb->na", warp, np.where(bad[:, None], 0, step[:, :2]))
