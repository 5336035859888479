"""Residuals of bundle adjustment, each written for ONE observation: no mask, no batch, no weight (the reprojection,
line and depth terms of the VGGT-Geo paper).

Notation: host camera `i` sees a point at pixel `u` with inverse depth `d`; `M = T_j T_i^-1` maps host to target camera.
The point is carried scaled by `d`: `Y = R [(u - c) / f, 1] + d t`, which stays finite for points at infinity.
"""

from __future__ import annotations

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

MIN_RELATIVE_DEPTH = 1e-2
"""Lower bound of `z_j / z_i`: a point nearer than this to the target's plane, or behind it, projects as if it lay
there, far outside the image, where a robust kernel sees it as an outlier; the projection never divides by zero."""


def project(
    relative_pose: jaxlie.SE3,
    intrinsics: Float[Array, "4"],
    pixel: Float[Array, "2"],
    inverse_depth: Float[Array, ""],
) -> Float[Array, "2"]:
    """Pixel in camera j of the point that camera i sees at `pixel` with `inverse_depth` (1/m)."""
    focal, centre = intrinsics[:2], intrinsics[2:]
    ray = jnp.concatenate([(pixel - centre) / focal, jnp.ones(1, pixel.dtype)])
    point = relative_pose.rotation().as_matrix() @ ray + inverse_depth * relative_pose.translation()
    return focal * point[:2] / jnp.maximum(point[2], MIN_RELATIVE_DEPTH) + centre


def point_residual(
    relative_pose: jaxlie.SE3,
    intrinsics: Float[Array, "4"],
    pixel: Float[Array, "2"],
    inverse_depth: Float[Array, ""],
    target: Float[Array, "2"],
) -> Float[Array, "2"]:
    """Projected point minus matched pixel `target`, in pixels."""
    return project(relative_pose, intrinsics, pixel, inverse_depth) - target


def line_residual(
    relative_pose: jaxlie.SE3,
    intrinsics: Float[Array, "4"],
    pixel: Float[Array, "2"],
    inverse_depth: Float[Array, ""],
    coefficients: Float[Array, "3"],
) -> Float[Array, ""]:
    """Signed distance in pixels of a projected line sample to the matched line `a u + b v + c = 0`, `a^2 + b^2 = 1`."""
    projected = project(relative_pose, intrinsics, pixel, inverse_depth)
    return coefficients[0] * projected[0] + coefficients[1] * projected[1] + coefficients[2]


def depth_residual(
    inverse_depth: Float[Array, ""], prior: Float[Array, ""], sigma: Float[Array, ""]
) -> Float[Array, ""]:
    """Inverse depth minus its metric prior, in standard deviations `sigma` (1/m) of that prior.

    The paper's raw difference is `sigma = 1`; `sigma = sigma_rel * prior` makes it commensurable with pixels.
    """
    return (inverse_depth - prior) / sigma
