"""A measured rotation of a keyframe, from a Manhattan world, or gravity and a compass."""

from __future__ import annotations

import jaxlie
from jaxtyping import Array, Float

from vggtgeo.bundle.terms.node import PoseTerm
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import AbstractCamera


class RotationPrior(PoseTerm):
    """`r = root Log(R M^T)` with `root^T root` the information of the measured rotation `M`.

    Fields:
        measured: `M`: world -> camera, unit quaternion `(w, x, y, z)`.
        root: Square root of the information, 1/rad.
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.
        keyframe: int [m], keyframe of each observation.

    Example: the first camera is upright, with a standard deviation of one degree.
        >>> import jax.numpy as jnp
        >>> upright, root = jnp.array([[1.0, 0, 0, 0]]), 57.3 * jnp.eye(3)[None]
        >>> vg.terms.RotationPrior(keyframe=[0], measured=upright, root=root, weight=jnp.ones(1)).name
        'rotations'

    """

    measured: Float[Array, "m 4"]
    root: Float[Array, "m 3 3"]

    name = "rotations"
    unit = "sigma"

    def residual(self, pose: jaxlie.SE3, camera: AbstractCamera) -> Float[Array, "3"]:
        # As rigid motions without translation, since `lie.boxminus` has finite second derivatives at zero.
        measured = jaxlie.SE3.from_rotation(jaxlie.SO3(self.measured))
        rotation = jaxlie.SE3.from_rotation(pose.rotation())
        return self.root @ lie.boxminus(rotation, measured)[3:]
