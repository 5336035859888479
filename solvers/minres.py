"""Minimum residuals for symmetric systems, definite or not, with a definite preconditioner.

Lanczos vectors make the matrix tridiagonal, Givens rotations solve the remaining least-squares problem (Paige and
Saunders 1975). In the norm of the preconditioner the residual never increases, even for an indefinite matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Apply = Callable[[Float[Array, " c"]], Float[Array, " c"]]
Solved = tuple[Float[Array, " c"], Bool[Array, ""]]


class _Loop(NamedTuple):
    solution: Array
    older: Array
    newer: Array
    preconditioned: Array
    old_beta: Array
    beta: Array
    search: Array
    last_search: Array
    rotation: tuple[Array, Array]
    diagonal: Array
    beyond: Array
    left: Array
    """Norm of the residual."""
    iterations: Array


def minres(apply: Apply, inverse: Apply, rhs: Float[Array, " c"], rtol: float, max_iterations: int) -> Solved:
    """Solve `A x = rhs` from zero until the residual, in the preconditioner's norm, has decreased by `rtol`.

    Returns the solution, and whether the iteration has converged.
    """
    zero, one = jnp.zeros((), rhs.dtype), jnp.ones((), rhs.dtype)
    first = inverse(rhs)
    start = jnp.sqrt(jnp.maximum(rhs @ first, 0.0))

    def go_on(loop: _Loop) -> Bool[Array, ""]:
        return (loop.left > rtol * start) & (loop.beta > 0) & (loop.iterations < max_iterations)

    nothing = jnp.zeros_like(rhs)
    begin = _Loop(
        *(nothing, nothing, rhs, first, zero, start, nothing, nothing),
        *((-one, zero), zero, zero, start, jnp.asarray(0)),
    )
    last = jax.lax.while_loop(go_on, lambda loop: _advanced(loop, apply, inverse), begin)
    return last.solution, last.left <= rtol * start


def _advanced(loop: _Loop, apply: Apply, inverse: Apply) -> _Loop:
    vector = loop.preconditioned / loop.beta
    before = jnp.where(loop.old_beta > 0, loop.old_beta, 1.0)  # zero in the first iteration
    image = apply(vector) - jnp.where(loop.old_beta > 0, loop.beta / before, 0.0) * loop.older
    alpha = vector @ image
    image = image - alpha / loop.beta * loop.newer
    preconditioned = inverse(image)
    # Rounding may make the squared norm negative near convergence.
    beta = jnp.sqrt(jnp.maximum(image @ preconditioned, 0.0))
    cosine, sine = loop.rotation
    delta = cosine * loop.diagonal + sine * alpha
    rotated = sine * loop.diagonal - cosine * alpha
    size = jnp.sqrt(rotated**2 + beta**2)
    # An exact solution leaves a zero rotation, which must not make the update NaN.
    size = jnp.where(size > 0, size, jnp.finfo(size.dtype).tiny)
    new_cosine, new_sine = rotated / size, beta / size
    search = (vector - loop.beyond * loop.last_search - delta * loop.search) / size
    return _Loop(
        solution=loop.solution + new_cosine * loop.left * search,
        older=loop.newer,
        newer=image,
        preconditioned=preconditioned,
        old_beta=loop.beta,
        beta=beta,
        search=search,
        last_search=loop.search,
        rotation=(new_cosine, new_sine),
        diagonal=-cosine * beta,
        beyond=sine * beta,
        left=jnp.abs(new_sine * loop.left),
        iterations=loop.iterations + 1,
    )
