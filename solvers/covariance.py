"""Covariance of the unknowns of an arrow system: the required blocks of the inverse of its matrix.

With `S = H - W V^-1 W'` and residuals of unit variance, the inverse of the whole matrix has the blocks

    dense       S^-1                                    around each host: `LocalInverse`
    landmarks   V^-1 + V^-1 W' S^-1 W V^-1              the diagonal only: [n, s]

and the second needs, per host, the covariance of its relative coordinates `(eta of each edge, shared)`, which is
`J S^-1 J'` with small `J`, and one product of that with the host's cross terms: `r^2 s` operations a
host, as `dense_schur_complement`.

The linear solver computes the blocks of `S^-1`: by eigenvectors of the dense matrix, by a selected inverse of the band,
or column by column. A coordinate with a component along an undetermined direction, and a landmark coupled to one, have
infinite variance.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int
from vggtgeo.solvers.arrow import ArrowSystem, inverse_landmark_hessian, moving_landmarks, restricted
from vggtgeo.solvers.reduced_solvers import AbstractReducedSolver, DenseCholesky
from vggtgeo.solvers.schur_complement import LocalInverse, relative_covariance, visible


class ArrowCovariance(eqx.Module):
    """Marginal covariances around `h` rows of landmarks; never NaN.

    Fixed coordinates have zero, undetermined ones infinite variance and zero covariance.
    """

    nodes: Float[Array, "h b b"]
    """Of the node that hosts each row."""
    neighbours: Float[Array, "h k b b"]
    """Cross covariance of that node with the target of each edge of the row; zero for a missing edge."""
    shared: Float[Array, "q q"]
    landmarks: Float[Array, "h s"]
    """Variances."""
    rank: Int[Array, ""]
    """Number of determined unknowns, including all landmarks, without flat gauge directions."""


def covariance(
    system: ArrowSystem, solver: AbstractReducedSolver | None = None, rows: Int[Array, " h"] | None = None
) -> ArrowCovariance:
    """Compute the inverse of the system's matrix over the free coordinates; it must be positive semidefinite.

    solver: linear solver that inverts; None = dense. rows: rows of landmarks; None = all.
    """
    rows = jnp.arange(len(system.graph.of_host)) if rows is None else rows
    found = (DenseCholesky() if solver is None else solver).inverse(system, rows)
    degree, block = system.graph.of_host.shape[1], system.block
    local = _marked(found.covariance, found.undetermined)
    own, end = slice(degree * block, (degree + 1) * block), (degree + 1) * block
    beside = local[:, own, : degree * block].reshape(len(rows), block, degree, block).transpose(0, 2, 1, 3)
    present = system.graph.of_host[rows] < len(system.graph.source)
    return ArrowCovariance(
        nodes=local[:, own, own],
        neighbours=jnp.where(present[:, :, None, None] & jnp.isfinite(beside), beside, 0.0),
        # The shared coordinates are local to every row, so any row has their block.
        shared=local[0, end:, end:],
        landmarks=_landmarks(system, found, rows),
        rank=found.rank + jnp.sum(moving_landmarks(system)),
    )


def _landmarks(system: ArrowSystem, found: LocalInverse, rows: Int[Array, " h"]) -> Float[Array, "h s"]:
    """Return the diagonal of `V^-1 + V^-1 W' S^-1 W V^-1`."""
    hessian_inverse, basis = inverse_landmark_hessian(system)[rows], jax.tree.map(lambda leaf: leaf[rows], system.basis)
    cross = restricted(basis.triples, system.cross[rows, :-2])
    # In this order, since the square of a large inverse may overflow, but its product with the coupling does not.
    pulled = basis.expand(hessian_inverse[:, None] * cross)
    spread = lambda local, side: jnp.einsum("nrs,nrt,nts->ns", side, relative_covariance(system, rows, local), side)
    variance = basis.expand_variance(hessian_inverse) + spread(found.covariance, pulled)
    lost = hessian_inverse * spread(found.null, cross) > visible(cross.dtype)
    unknown = (system.landmark_hessian[rows] == 0) | lost
    known = (basis.expand_variance(unknown.astype(cross.dtype)) == 0) & jnp.isfinite(variance)
    return jnp.where(known, variance, jnp.inf)


def _marked(local: Float[Array, "h l l"], undetermined: Bool[Array, "h l"]) -> Float[Array, "h l l"]:
    """Set infinite variance and zero covariance for undetermined coordinates."""
    either = undetermined[:, :, None] | undetermined[:, None, :]
    added = jnp.where(undetermined, jnp.inf, 0.0).astype(local.dtype)
    return jnp.where(either, 0.0, local) + jax.vmap(jnp.diag)(added)
