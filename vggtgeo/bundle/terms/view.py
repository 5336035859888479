"""Argument of a residual along an edge: one landmark of keyframe i, seen from keyframe j."""

from __future__ import annotations

import equinox as eqx
import jaxlie
from jaxtyping import Array, Float

from vggtgeo.geometry.camera_models import AbstractCamera


class View(eqx.Module):
    """A landmark of host camera i in target camera j.

    The landmark is scaled by its inverse depth, `R ray + d t`, which stays finite for points at infinity.

    Example: a landmark seen by two cameras at the same pose.
        >>> import jax.numpy as jnp, jaxlie
        >>> camera = vg.cameras.Pinhole(jnp.array([500.0, 500.0, 320.0, 240.0]))
        >>> vg.terms.View(jaxlie.SE3.identity(), camera, jnp.array([100.0, 50.0]), jnp.asarray(0.5)).projected.tolist()
        [100.0, 50.0]

    """

    relative: jaxlie.SE3
    """`M = T_j T_i^-1`: host to target camera."""
    camera: AbstractCamera
    """Camera of keyframe j."""
    pixel: Float[Array, "2"]
    """Pixel in the host."""
    inverse_depth: Float[Array, ""]
    """1/m, in the host."""
    host: AbstractCamera | None = None
    """Camera of keyframe i if it differs from that of keyframe j."""

    @property
    def ray(self) -> Float[Array, "3"]:
        """Viewing ray in the host, `z = 1`."""
        return (self.camera if self.host is None else self.host).unproject(self.pixel)

    @property
    def scaled_point(self) -> Float[Array, "3"]:
        """The landmark in target coordinates times its inverse depth."""
        return self.relative.rotation().as_matrix() @ self.ray + self.inverse_depth * self.relative.translation()

    @property
    def point(self) -> Float[Array, "3"]:
        """The landmark in target coordinates, metres."""
        return self.scaled_point / self.inverse_depth

    @property
    def projected(self) -> Float[Array, "2"]:
        """Pixel of the landmark in the target (equation 5 of the paper)."""
        return self.camera.project(self.scaled_point)
