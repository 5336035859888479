"""The bundle-adjustment problem as arrays: state, observations, priors. All shapes are static, absence is weight 0.

Sizes: `n` keyframes, `p` point slots and `l` line slots a keyframe (`s = p + l` inverse depths: points first), `e`
directed edges `(i, j)`: slots of keyframe i observed in keyframe j.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from vggtgeo.geometry import lie
from vggtgeo.solvers.kernels import AbstractKernel, Cauchy


class State(eqx.Module):
    """What bundle adjustment estimates: `n` poses, the intrinsics they share, `s` inverse depths a keyframe.

    Example:
        >>> import jax.numpy as jnp, vggtgeo as vg
        >>> _, initial, _ = vg.simulate_window(keyframes=3, points=10, lines=1).pack()
        >>> initial.inverse_depth.shape
        (3, 14)
        >>> step = jnp.zeros(6 * 3 + 4 + 3 * 14).at[18].set(2.0)  # the first of the intrinsics
        >>> float(initial.moved(step).intrinsics[0] - initial.intrinsics[0])
        2.0

    """

    poses: jaxlie.SE3
    """World -> camera of each keyframe, batch `[n]`."""
    intrinsics: Float[Array, "4"]
    """`fx, fy, cx, cy` in pixels, shared by all keyframes."""
    inverse_depth: Float[Array, "n s"]
    """1/m, along the optical axis of the host keyframe, one a slot."""

    def moved(self, step: Float[Array, " t"]) -> State:
        """The state that a step leads to, in the coordinates of every Hessian and covariance of this package.

        step: six a pose (`T` becomes `exp(xi) T`; metres, then radians), four of the intrinsics (pixels), then the
        inverse depths (1/m), keyframe by keyframe. Pure; the derivative at a zero step is the tangent map.
        """
        poses = 6 * len(self.inverse_depth)
        return State(
            lie.move(self.poses, step[:poses].reshape(-1, 6)),
            self.intrinsics + step[poses : poses + 4],
            self.inverse_depth + step[poses + 4 :].reshape(self.inverse_depth.shape),
        )


class Edges(eqx.Module):
    """The covisibility graph: directed edges sorted by host keyframe."""

    source: Int[Array, " e"]
    """Host keyframe i, ascending."""
    target: Int[Array, " e"]
    """Keyframe j in which the slots of i are observed."""
    rank: Int[Array, " e"]
    """Position of the edge among the edges of its host, from 0."""
    of_host: Int[Array, "n k"]
    """Index of the edge of each rank of each host, or `e` where a host has fewer than `k`: the inverse of `rank`."""


class PointObservations(eqx.Module):
    """Matches of point slots along edges."""

    target: Float[Array, "e p 2"]
    """Matched pixel in keyframe j."""
    weight: Float[Array, "e p"]
    """Confidence weight, >= 0; 0 means no match."""


class LineObservations(eqx.Module):
    """Lines matched to line samples along edges."""

    coefficients: Float[Array, "e l 3"]
    """`(a, b, c)` with `a^2 + b^2 = 1`, of the line in keyframe j."""
    weight: Float[Array, "e l"]
    """Confidence weight, >= 0; 0 means no match."""


class DepthPrior(eqx.Module):
    """A metric inverse depth for each slot: residual `(d - mean) / sigma`, weight `alpha * weight`."""

    mean: Float[Array, "n s"]
    """1/m; any finite number where `weight` is 0."""
    sigma: Float[Array, "n s"]
    """Standard deviation, 1/m, > 0 (1 where `weight` is 0)."""
    weight: Float[Array, "n s"]
    """Confidence, >= 0; 0 means no prior."""
    alpha: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=2.0)
    """Weight of all depth terms against the pixels' (the paper's alpha)."""


class IntrinsicsPrior(eqx.Module):
    """Gaussian prior on the shared intrinsics, without a robust kernel."""

    mean: Float[Array, "4"]
    information: Float[Array, "4"]
    """`1 / sigma^2`, pixels^-2; 0 = no prior."""


class MarginalPrior(eqx.Module):
    """What marginalisation left behind: `r = root (x boxminus linearisation) + offset` over poses and intrinsics.

    Coordinates: six a keyframe (left tangent `log(T T_lin^-1)`, translation first), then the four intrinsics.
    """

    root: Float[Array, "c c"]
    offset: Float[Array, " c"]
    poses: jaxlie.SE3
    """Linearisation points, batch `[n]`; kept as long as the prior lives (first estimates)."""
    intrinsics: Float[Array, "4"]


class Problem(eqx.Module):
    """A bundle-adjustment problem; every float leaf may be differentiated. `vggtgeo.pack` makes one.

    Pixels, 1/m for inverse depths, poses world -> camera. Weight 0 means that an observation is not there, so that a
    kind can be left out without another shape.

    Example:
        >>> import jax.numpy as jnp, vggtgeo as vg
        >>> from dataclasses import replace
        >>> problem, initial, _ = vg.simulate_window(keyframes=3, points=10, lines=1).pack()
        >>> problem.points.target.shape, problem.lines.weight.shape
        ((6, 10, 2), (6, 4))
        >>> without = replace(problem, lines=replace(problem.lines, weight=jnp.zeros((6, 4))))
        >>> bool(vg.energy(without, initial) < vg.energy(problem, initial))
        True

    """

    pixels: Float[Array, "n s 2"]
    """Where slot s of keyframe i looks: point slots first, then line samples."""
    edges: Edges
    points: PointObservations
    lines: LineObservations
    depth: DepthPrior
    intrinsics_prior: IntrinsicsPrior
    fixed_pose: Bool[Array, " n"]
    """Keyframes whose pose is held (the gauge)."""
    fixed_intrinsics: Bool[Array, "4"]
    """Intrinsics that are held."""
    kernel: AbstractKernel = Cauchy()
    marginal: MarginalPrior | None = None
    fraction: Float[Array, "n g q"] | None = None
    """Two-ends lines: the `l = g q` line slots are `g` segments of `q` samples, and the inverse depth of a segment is
    an affine function of this position along it (0 and 1 at its ends). It is a constant to derivatives. None: each
    sample has its own inverse depth."""
    positive_depth: bool = eqx.field(static=True, default=True)
    """Whether inverse depths stay positive. If not, one may pass through infinity, as in a solver without bounds."""

    @property
    def num_keyframes(self) -> int:
        return self.pixels.shape[0]

    @property
    def num_points(self) -> int:
        """Point slots a keyframe."""
        return self.points.weight.shape[1]

    @property
    def num_camera(self) -> int:
        """Size of the dense part of the state: six a keyframe and four intrinsics."""
        return 6 * self.num_keyframes + 4
