"""The prior of a marginalisation: a Gaussian on all poses and the camera."""

from __future__ import annotations

import dataclasses
from typing import Self

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int

from vggtgeo.bundle.terms.node import DenseTerm
from vggtgeo.bundle.terms.term import local_model
from vggtgeo.geometry import lie
from vggtgeo.io.errors import InputError


class MarginalPrior(DenseTerm):
    """`r = root (x boxminus linearisation) + offset` over poses and camera parameters.

    Coordinates: six for each keyframe (left tangent `log(T T_lin^-1)`, translation first), then the camera's.

    Fields:
        root: [c, c], square root of the information; zero rows have no information.
        offset: [c], the residual at the linearisation point.
        poses: Linearisation points, batch `[n]`; constant during the life of the prior (first estimates).
        intrinsics: [q], linearisation point of the cameras' parameters.
        weight: a scalar, factor on the information of the whole residual; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.

    Example:
        >>> vg.empty_prior(3).root.shape
        (22, 22)

    """

    root: Float[Array, "c c"]
    offset: Float[Array, " c"]
    poses: jaxlie.SE3
    intrinsics: Float[Array, " q"]

    name = "marginal"
    unit = "sigma"

    def residual(self, poses: jaxlie.SE3, parameters: Float[Array, " q"]) -> Float[Array, " c"]:
        difference = lie.boxminus(poses, self.poses).reshape(-1)
        return self.root @ jnp.concatenate([difference, parameters - self.intrinsics]) + self.offset

    def rows(self) -> Int[Array, ""]:
        return jnp.sum(jnp.any(self.root != 0, 1))

    def padded(self, keyframes: int) -> Self:
        known = len(self.poses.wxyz_xyz)
        more = keyframes - known
        if more < 0:
            raise InputError(f"`{self.name}` must have at most {keyframes} keyframes, as the problem, got {known}")
        if more == 0:
            return self
        new, split = lie.TANGENT * more, lie.TANGENT * known
        root = jnp.insert(self.root, jnp.full(new, split), 0.0, axis=1)
        # Any pose will do, as the new columns of the root are zero.
        nothing = jaxlie.SE3.identity((more,)).wxyz_xyz.astype(root.dtype)
        poses = jaxlie.SE3(jnp.concatenate([self.poses.wxyz_xyz, nothing]))
        return dataclasses.replace(
            self, root=jnp.pad(root, ((0, new), (0, 0))), offset=jnp.pad(self.offset, (0, new)), poses=poses
        )

    def model(
        self, poses: jaxlie.SE3, parameters: Float[Array, " q"], correction: Float[Array, ""] | None, exact: bool
    ) -> tuple[Float[Array, "c c"], Float[Array, " c"]]:
        """Return Hessian and gradient by the chain rule, pose by pose: cheaper than differentiating all poses."""
        if exact:
            return super().model(poses, parameters, correction, exact)
        size = len(parameters)
        blocks = lie.log_derivative(lie.boxminus(poses, self.poses))
        by_pose = self.root[:, :-size].reshape(len(self.root), -1, lie.TANGENT)
        by_pose = jnp.einsum("cnb,nbd->cnd", by_pose, blocks).reshape(len(self.root), -1)
        jacobian = jnp.concatenate([by_pose, self.root[:, -size:]], 1)
        residual = self.residual(poses, parameters)
        # The reweighted model has first derivatives only, so a linear residual gives it exactly.
        linear = lambda step: residual + jacobian @ step
        return local_model(self, self.weights, linear, len(self.offset), correction, exact)
