"""Terms whose residual is an affine function of the landmark's pixel in the target: matches of points and lines."""

from __future__ import annotations

import abc
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vggtgeo.bundle import camera_derivatives, pinhole_derivatives
from vggtgeo.bundle.pinhole_derivatives import Gradient
from vggtgeo.bundle.terms.landmark_edge import CENTRE, EdgeTerm, EdgeView, LocalModel, PixelModel, View
from vggtgeo.bundle.terms.term import reweighting, robust_energy, squared_norm
from vggtgeo.geometry.camera_models import Pinhole

Rows = tuple[Float[Array, " p"], ...]
"""Entries of a residual, one array each: XLA does not vectorise the loop around a stacked array."""


_WITH_ENTRIES = 3
"""Number of axes of prepared data with entries besides edge and slot."""


class ImageTerm(EdgeTerm):
    """A residual that is an affine function of the landmark's pixel in the target: a match, a line.

    With one pinhole for all keyframes, all derivatives are those of `pinhole_derivatives.py`, written by hand. With
    other cameras, first derivatives are those of `camera_derivatives.py`, and exact second ones are automatic. The
    tests check that all are equal to automatic ones.

    Fields:
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.
        first_slot: slot of the host that the first column observes; set by `pack`.

    Example: only the column of a match is known.
        >>> class Column(vg.terms.ImageTerm):
        ...     column: jax.Array
        ...     def image_residual(self, u, v):
        ...         return (u - self.column,)
        >>> Column(column=jax.numpy.asarray(100.0)).image_residual(103.0, 7.0)[0].item()
        3.0

    """

    @abc.abstractmethod
    def image_residual(self, u: Float[Array, ""], v: Float[Array, ""]) -> tuple[Float[Array, ""], ...]:
        """Return the entries of the residual of one observation, given the projected pixel `(u, v)`.

        Data of an observation are read entry by entry (`self.target[0]`): in the loops each entry is a separate array,
        which XLA vectorises; with a small inner axis it does not (1.9 times slower).
        """

    def prepared(self) -> Self:
        safe = super().prepared()
        split = lambda leaf: tuple(jnp.unstack(leaf, axis=1)) if leaf.ndim == _WITH_ENTRIES else leaf
        return safe.holding(jax.tree.map(split, safe.data()))

    def residual(self, view: View) -> Float[Array, " m"]:
        return jnp.stack(self.image_residual(*view.projected))

    def energy(self, view: EdgeView) -> Float[Array, ""]:
        return robust_energy(self.kernel, self.weights, self._image(view)[0])

    def columns(self, view: EdgeView, correction: Float[Array, ""] | None) -> Float[Array, "c mp"]:
        residual, normal = self._image(view)
        scale = reweighting(self.kernel, self.weights, squared_norm(residual), correction)
        along = [scale.share * sum(n * r for n, r in zip(of, residual, strict=True)) for of in normal]
        a, b = (
            jnp.stack([scale.root * (n - pulled * r) for n, r in zip(of, residual, strict=True)])
            for of, pulled in zip(normal, along, strict=True)
        )
        shared, depth, pixel = view.row(a, b)
        pull = jnp.stack([scale.root * r / scale.soft for r in residual])
        return jnp.stack([*shared, pull, depth, *pixel]).reshape(len(shared) + 2 + len(pixel), -1)

    def gradient(self, view: EdgeView) -> Gradient:
        if isinstance(view.projection, camera_derivatives.Seen):
            return super().gradient(view)
        found = pinhole_derivatives.energy_gradient(*view.projection, *self._force(view))
        pixel = found.pixel if view.free_pixels else None
        return found._replace(shared=jnp.stack(view.tied(list(found.shared))), pixel=pixel)

    def model(self, view: EdgeView) -> LocalModel:
        if isinstance(view.projection, camera_derivatives.Seen):
            return super().model(view)
        edge, at = view.projection
        entries, normals = self._image(view)
        squared = self.weights * squared_norm(entries)
        pull = self.weights * self.kernel.weight(squared)
        bend = 2 * self.weights**2 * self.kernel.curvature(squared)
        # Stacked arrays, not entries as in `columns`: a hundred separate sums take seconds to compile.
        residual = jnp.stack(entries)
        normal = jnp.stack([jnp.stack(of) for of in normals])
        rows = jnp.stack(pinhole_derivatives.row(edge, at, *normal), 1)
        third = jnp.stack(pinhole_derivatives.row_of_third(edge, at))
        along = jnp.sum(residual[:, None] * rows, 0)  # the residual times its derivative: `D / (w rho')`
        force = pull * jnp.sum(normal * residual, 1)
        added, mixed = pinhole_derivatives.second_order(edge, at, (force[0], force[1]), list(third))
        # Half of the products of these rows with the plain ones is `sum w rho' J'J + 2 w^2 rho'' (J'r)(J'r)' - P D'`.
        bent = bend * along[:-1] - 2 * pull * third[:-1]
        left = jnp.concatenate([pull * rows[:, :-1] + residual[:, None] * bent, (pull * residual)[:, None]], 1)
        products = jnp.einsum("map,mbp->ab", left, rows[:, :-1])
        half, gradient = products[:-1] / 2, products[-1]
        gram = jnp.pad(half + half.T + added, (0, 1)).at[-1, :-1].set(gradient).at[:-1, -1].set(gradient)
        pulled, inverse = bend * along[-1] - pull * third[-1], -pull * along[-1]
        coupled = jnp.sum(pull * rows[:, -1:] * rows, 0) + pulled * along + inverse * third + jnp.stack(mixed)
        own = (pull * along[-1])[None]
        model = LocalModel(gram, jnp.concatenate([coupled[:-1], own, coupled[-1:]]))
        if view.free_pixels:
            pixels = self._pixel_model(view, (residual, normal, rows), (pull, bend), third)
            model = model._replace(pixels=pixels)
        return _tied_model(view, model)

    def _pixel_model(
        self,
        view: EdgeView,
        derivatives: tuple[Float[Array, "m p"], Float[Array, "2 m p"], Float[Array, "m 11 p"]],
        weights: tuple[Float[Array, " p"], Float[Array, " p"]],
        third: Float[Array, "11 p"],
    ) -> PixelModel:
        """Return exact second derivatives by the pixels in the host, see `pinhole_derivatives.py`.

        derivatives: residuals, their derivatives by the projected pixel, and by shared coordinates and inverse depth.
        weights: `w rho'` and `2 w^2 rho''`. third: `P`.
        """
        assert not isinstance(view.projection, camera_derivatives.Seen)
        edge, at = view.projection
        (residual, normal, rows), (pull, bend) = derivatives, weights
        centre = slice(CENTRE, CENTRE + 2)
        # By the pixel in the host: by the pixel in the target, minus by the principal point.
        pixel, third_of = normal - jnp.swapaxes(rows[:, centre], 0, 1), -third[centre]
        along, of_pixel = jnp.sum(residual[:, None] * rows, 0), jnp.sum(pixel * residual, 1)
        force, gradient = pull * jnp.sum(normal * residual, 1), pull * of_pixel
        drawn = (pull * along).at[centre].add(-force)
        extra = [
            pinhole_derivatives.second_order_of_pixel(edge, at, (force[0], force[1]), gradient[axis], axis)
            for axis in range(2)
        ]
        mixed = (
            pull * jnp.einsum("amp,mkp->kap", pixel, rows)
            + bend * along[:, None] * of_pixel
            - drawn[:, None] * third_of
            - third[:, None] * gradient
            + jnp.stack([jnp.stack(of) for of in extra], 1)
        )
        coupled = jnp.stack([*view.tied(list(mixed[:-1])), gradient, mixed[-1]])
        first, second = np.array([0, 1, 0]), np.array([0, 1, 1])
        blocks = (
            pull * jnp.sum(pixel[first] * pixel[second], 1)
            + bend * of_pixel[first] * of_pixel[second]
            - (third_of[first] * gradient[second] + gradient[first] * third_of[second])
        )
        return PixelModel(coupled, blocks)

    def _image(self, view: EdgeView) -> tuple[Rows, tuple[Rows, Rows]]:
        """Return residuals and their derivatives by the projected pixel's coordinates, row by row."""
        pixel = view.projected

        def each(u: Array, v: Array) -> Rows:
            return jax.vmap(lambda data, u, v: tuple(self.holding(data).image_residual(u, v)), in_axes=-1)(
                self.data(), u, v
            )

        one, zero = jnp.ones_like(pixel[0]), jnp.zeros_like(pixel[0])
        residual, right = jax.jvp(each, pixel, (one, zero))
        return residual, (right, jax.jvp(each, pixel, (zero, one))[1])

    def _force(self, view: EdgeView) -> tuple[Array, Array]:
        """Return `w rho' r` on the projected pixel; zero for absent observations."""
        residual, normal = self._image(view)
        pull = self.weights * self.kernel.weight(self.weights * squared_norm(residual))
        along = [sum(n * r for n, r in zip(of, residual, strict=True)) for of in normal]
        return pull * along[0], pull * along[1]


class PointTerm(ImageTerm):
    """`r = pi(T_j T_i^-1 pi^-1(u_i, d_i)) - u_j`, pixels (equation 5 of the paper).

    Fields:
        target: Matched pixel in keyframe j.
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.
        first_slot: slot of the host that the first column observes; set by `pack`.

    Example:
        >>> problem.terms["points"].target.shape  # edges, slots, (u, v)
        (12, 20, 2)

    """

    target: Float[Array, "e p 2"]

    name = "points"
    unit = "px"

    def image_residual(self, u: Float[Array, ""], v: Float[Array, ""]) -> tuple[Float[Array, ""], ...]:
        return u - self.target[0], v - self.target[1]


class LineTerm(ImageTerm):
    """`r = a u' + b v' + c`, pixels, of the sample's projection (equation 6 of the paper).

    Fields:
        coefficients: `(a, b, c)` with `a^2 + b^2 = 1`, of the line in keyframe j.
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.
        first_slot: slot of the host that the first column observes; set by `pack`.

    Example:
        >>> problem.terms["lines"].coefficients.shape  # edges, samples, (a, b, c)
        (12, 12, 3)

    """

    coefficients: Float[Array, "e l 3"]

    name = "lines"
    unit = "px"

    def image_residual(self, u: Float[Array, ""], v: Float[Array, ""]) -> tuple[Float[Array, ""], ...]:
        a, b, c = self.coefficients
        return (a * u + b * v + c,)


def _tied_model(view: EdgeView, model: LocalModel) -> LocalModel:
    """Convert a model by the pinhole's four parameters to one by the camera's."""
    if view.cameras.kind is Pinhole:
        return model
    once = jnp.stack(view.tied(list(model.gram)))
    coupled = jnp.stack(view.tied(list(model.coupled)))
    return LocalModel(jnp.stack(view.tied(list(once.T))), coupled, model.pixels)
