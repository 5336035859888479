"""Terms on a landmark observed along an edge, which produce the arrow's cross terms.

Local coordinates of one edge `(i, j)`: the left tangent `eta` of the relative pose (6), the parameters of its cameras
(`c`), and the inverse depth of each landmark. With one camera for all keyframes, `c = k`, its parameters. With several,
`c = 2 k`, those of the target's camera and those of the host's,

    r(eta, p_j, p_i, d) = f_{p_j}(exp(eta) M (ray_{p_i}(pixel), d)),

independent of the number of other cameras; if both ends have the same camera, the derivative is the sum of both. Slots
come last in every array, so that each quantity is contiguous: columns are `[6 + c + 2, m p]`, in the order eta,
cameras, residual, inverse depth, for `m` consecutive residual rows. If the pixels of the slots in their host are also
unknowns (`terms/host_pixel.py`), two rows follow: by `u`, by `v`.
"""

from __future__ import annotations

import abc
from typing import NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int

from vggtgeo.bundle.fast import any_camera, pinhole
from vggtgeo.bundle.fast.pinhole import Projection
from vggtgeo.bundle.terms.term import (
    AbstractTerm,
    check_residual,
    reweighted_rows,
    reweighting,
    robust_energy,
    squared_norm,
)
from vggtgeo.bundle.terms.view import View
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import Cameras, Pinhole, with_shared_focal

Rows = tuple[Float[Array, " p"], ...]
"""Entries of a residual, one array each: XLA does not vectorise the loop around a stacked array."""


class EdgeView(eqx.Module):
    """All slots of one edge's host, seen along the edge."""

    relative: jaxlie.SE3
    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]
    cameras: Cameras
    ends: tuple[Int[Array, ""], Int[Array, ""]]
    """Keyframes `(i, j)`."""
    pixels: Float[Array, "2 p"]
    inverse_depth: Float[Array, " p"]
    projection: tuple[pinhole.OneEdge, Projection] | any_camera.Seen
    """Of one pinhole for all keyframes, or of other cameras."""
    free_pixels: int = eqx.field(static=True, default=0)
    """Number of first slots whose pixel is an unknown."""

    @property
    def size(self) -> int:
        """Number of coordinates shared by all slots of the edge: relative pose and parameters of its cameras."""
        return lie.TANGENT + self.cameras.seen

    def parts(self, shared: Float[Array, " d"]) -> list[Array]:
        """Split the shared coordinates: relative pose, then the parameters of each camera of the edge."""
        size = self.cameras.size
        return [shared[: lie.TANGENT], *(shared[at : at + size] for at in range(lie.TANGENT, self.size, size))]

    @property
    def projected(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Pixels of the slots in the target."""
        if isinstance(self.projection, any_camera.Seen):
            return self.projection.u, self.projection.v
        edge, at = self.projection
        fx, fy, cx, cy = edge.intrinsics
        return fx * at.x + cx, fy * at.y + cy

    def row(self, a: Float[Array, " p"], b: Float[Array, " p"]) -> tuple[list[Array], Array, list[Array]]:
        """Return the derivatives of a row of residuals with image gradient `(a, b)`: by the shared coordinates, by
        inverse depth, and by the pixel in the host, if it is an unknown.
        """
        if isinstance(self.projection, any_camera.Seen):
            found = any_camera.row(self.rotation, self.translation, self.projection, a, b)
            both = zip(found.target, found.host, strict=True)
            one_camera = self.cameras.group is None
            by_cameras = [j + i for j, i in both] if one_camera else [*found.target, *found.host]
            return [*found.motion, *by_cameras], found.depth, found.pixel if self.free_pixels else []
        *shared, depth = pinhole.row(*self.projection, a, b)
        # The centre moves the pixel in the target and, the other way, the ray in the host.
        pixel = [a - shared[_CENTRE], b - shared[_CENTRE + 1]] if self.free_pixels else []
        return self.tied(shared), depth, pixel

    def tied(self, rows: list[Array]) -> list[Array]:
        """Convert derivatives by the pinhole's four parameters to the camera's: for one focal length, add both."""
        if self.cameras.kind is Pinhole:
            return rows
        focal = lie.TANGENT
        return [*rows[:focal], rows[focal] + rows[focal + 1], *rows[focal + 2 :]]

    def slots(self, first: int, count: int) -> EdgeView:
        """Return the view of some of the slots."""
        part = lambda leaf: leaf[..., first : first + count]
        of_slots: tuple[pinhole.OneEdge, Projection] | any_camera.Seen
        if isinstance(self.projection, any_camera.Seen):
            of_slots = jax.tree.map(part, self.projection)
        else:
            of_slots = self.projection[0], jax.tree.map(part, self.projection[1])
        own = part(self.pixels), part(self.inverse_depth)
        free = min(max(self.free_pixels - first, 0), count)
        motion = self.relative, self.rotation, self.translation
        return EdgeView(*motion, self.cameras, self.ends, *own, of_slots, free)


class Gradient(NamedTuple):
    """Gradient of one edge's energy."""

    shared: Float[Array, " d"]
    """By relative pose and camera."""
    depth: Float[Array, " p"]
    """By each inverse depth."""
    pixel: Float[Array, "2 p"] | None
    """By each pixel in the host, if those are unknowns."""


class LocalModel(NamedTuple):
    """Second-order model of one edge's energy; `d = 6 + c`."""

    gram: Float[Array, "d+1 d+1"]
    """Hessian by the shared coordinates, with the gradient as last row and column (the corner is unused)."""
    coupled: Float[Array, "d+2 p"]
    """Mixed derivatives with each inverse depth, then its gradient and its curvature."""
    pixels: PixelModel | None = None
    """The same for the pixels of the slots, if those are unknowns."""


class PixelModel(NamedTuple):
    """Second-order model of one edge's energy by the pixels of `p` slots in their host."""

    coupled: Float[Array, "d+2 2 p"]
    """Mixed derivatives by `u` and `v` with the shared coordinates, their gradient, and those with inverse depth."""
    blocks: Float[Array, "3 p"]
    """Second derivatives `uu, vv, uv`."""


class EdgeTerm(AbstractTerm):
    """Observations of landmarks along edges: `weight` and data have the axes `[e, p]`, edge and slot of its row.

    Fields:
        first_slot: Slot of the host that the first column observes.
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.

    Example: a landmark lies on a plane that is known in the target camera.
        >>> class PointToPlane(vg.terms.EdgeTerm):
        ...     normal: jax.Array
        ...     distance: jax.Array
        ...     def residual(self, view):
        ...         return self.normal @ view.point - self.distance
        >>> PointToPlane.name
        'point_to_plane'

    """

    first_slot: int = eqx.field(static=True, kw_only=True, default=0)

    structure = frozenset({"weight", "kernel", "first_slot"})

    @abc.abstractmethod
    def residual(self, view: View) -> Float[Array, "*m"]:
        """Return the residual of one landmark observed along one edge."""

    def restricted(self, of_edge: Float[Array, " e"] | Array) -> Self:
        """Return the term without the observations of edges where `of_edge` is False."""
        return self.reweighted(jnp.where(of_edge[:, None], self.weight, 0.0))

    def prepared(self) -> Self:
        safe = super().prepared()
        return safe.holding(jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, -1), safe.data()))

    def residuals(self, view: EdgeView) -> Float[Array, "m p"]:
        """Return the residuals of all slots of one edge; `self` has the prepared data of that edge."""
        return self._after(view, view.parts(jnp.zeros(view.size, view.inverse_depth.dtype)), view.inverse_depth)

    def along_all(self, view: EdgeView) -> tuple[Float[Array, "m p"], Float[Array, "m p"]]:
        """Return residuals of one edge, and the sum of their derivatives, which is not finite if one is not."""
        at = jnp.zeros(view.size, view.inverse_depth.dtype), view.inverse_depth
        return jax.jvp(lambda x, d: self._after(view, view.parts(x), d), at, jax.tree.map(jnp.ones_like, at))

    def energy(self, view: EdgeView) -> Float[Array, ""]:
        """Return the energy of one edge."""
        return robust_energy(self.kernel, self.weights, self.residuals(view))

    def columns(self, view: EdgeView, correction: Float[Array, ""] | None) -> Float[Array, "c mp"]:
        """Return weighted derivatives and residual of one edge: their products are its normal equations."""
        zeros = view.parts(jnp.zeros(view.size, view.inverse_depth.dtype))

        def by_part(at: int) -> Array:
            moved = lambda x: self._after(view, [*zeros[:at], x, *zeros[at + 1 :]], view.inverse_depth)
            along = lambda tangent: jax.jvp(moved, (zeros[at],), (tangent,))[1]
            return jax.vmap(along)(jnp.eye(len(zeros[at]), dtype=zeros[at].dtype))

        # Part by part, so that quantities independent of a part, such as the host's viewing rays, are not
        # differentiated.
        shared = [by_part(at) for at in range(len(zeros))]
        ones = jnp.ones_like(view.inverse_depth)
        residual, depth = jax.jvp(lambda d: self._after(view, zeros, d), (view.inverse_depth,), (ones,))
        jacobian = jnp.concatenate([*shared, depth[None], *self._by_pixel(view, zeros)])
        rows, pull = reweighted_rows(self.kernel, self.weights, residual, jacobian, correction)
        return jnp.concatenate([rows[: view.size], pull[None], rows[view.size :]]).reshape(len(rows) + 1, -1)

    def gradient(self, view: EdgeView) -> Gradient:
        """Return the gradient of one edge's energy by relative pose and cameras, inverse depths, and pixels."""
        zero = jnp.zeros(view.size, view.inverse_depth.dtype)
        by_shared, by_depth, by_pixel = jax.grad(self._energy_at, (1, 2, 3))(
            view, zero, view.inverse_depth, view.pixels
        )
        return Gradient(by_shared, by_depth, by_pixel if view.free_pixels else None)

    def model(self, view: EdgeView) -> LocalModel:
        """Return the exact Hessian and gradient of one edge."""
        size, depth, pixels = view.size, view.inverse_depth, view.pixels
        gradient = lambda x, d, u: jax.grad(self._energy_at, (1, 2, 3))(view, x, d, u)
        at = jnp.zeros(size, depth.dtype), depth, pixels
        force, own, pull = gradient(*at)
        # A residual depends on the unknowns of one slot, so one product with ones has the columns of all slots. All
        # products are in one `vmap`, so that the gradient is traced and compiled once.
        columns = 1 + 2 * bool(view.free_pixels)
        by_depth = jnp.zeros((size + columns, *depth.shape), depth.dtype).at[size].set(1.0)
        by_pixel = jnp.zeros((size + columns, *pixels.shape), depth.dtype)
        for axis in range(columns - 1):
            by_pixel = by_pixel.at[size + 1 + axis, axis].set(1.0)
        along = lambda *tangents: jax.jvp(gradient, at, tangents)[1]
        hessian, mixed, bend = jax.vmap(along)(jnp.eye(size + columns, size, dtype=depth.dtype), by_depth, by_pixel)
        gram = jnp.pad(hessian[:size], (0, 1)).at[-1, :-1].set(force).at[:-1, -1].set(force)
        coupled = jnp.concatenate([mixed[:size], own[None], mixed[size : size + 1]])
        if not view.free_pixels:
            return LocalModel(gram, coupled)
        by_pixels = jnp.concatenate([bend[:size], pull[None], bend[size : size + 1]])
        blocks = jnp.stack([bend[size + 1, 0], bend[size + 2, 1], bend[size + 1, 1]])
        return LocalModel(gram, coupled, PixelModel(by_pixels, blocks))

    def _by_pixel(self, view: EdgeView, parts: list[Array]) -> list[Float[Array, "2 m p"]]:
        """Return derivatives of the residuals by `u` and `v` in the host, if those are unknowns."""
        if not view.free_pixels:
            return []
        residuals = lambda pixels: self._after(view, parts, view.inverse_depth, pixels)
        axes = [jnp.zeros_like(view.pixels).at[axis].set(1.0) for axis in range(2)]
        return [jnp.stack([jax.jvp(residuals, (view.pixels,), (axis,))[1] for axis in axes])]

    def _energy_at(self, view: EdgeView, shared: Array, depth: Array, pixels: Array) -> Float[Array, ""]:
        return robust_energy(self.kernel, self.weights, self._after(view, view.parts(shared), depth, pixels))

    def _after(
        self,
        view: EdgeView,
        parts: list[Array],
        depth: Float[Array, " p"],
        pixels: Float[Array, "2 p"] | None = None,
    ) -> Float[Array, "m p"]:
        """Return residuals after a (zero) step of each part, at the given depths and optional pixels in the host."""
        # At zero in value: only the derivatives of the step matter, and this form compiles faster.
        relative = lie.move_at_zero(view.relative, parts[0])
        host, camera = view.cameras.along(view.ends, parts[1:])

        def one(data: dict, pixel: Array, inverse_depth: Array) -> Array:
            return check_residual(self, self.holding(data).residual(View(relative, camera, pixel, inverse_depth, host)))

        pixels = view.pixels if pixels is None else pixels
        return jax.vmap(one, in_axes=-1, out_axes=-1)(self.data(), pixels, depth)


_CENTRE = lie.TANGENT + 2
"""Index of the derivative by the principal point in a row."""
_WITH_ENTRIES = 3
"""Number of axes of prepared data with entries besides edge and slot."""


class ImageTerm(EdgeTerm):
    """A residual that is an affine function of the landmark's pixel in the target: a match, a line.

    With one pinhole for all keyframes, all derivatives are those of `fast/pinhole.py`, written by hand. With other
    cameras, first derivatives are those of `fast/any_camera.py`, and exact second ones are automatic. The tests check
    that all are equal to automatic ones.

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
        parts = []
        for i, r in enumerate(residual):
            a, b = (scale.root * (of[i] - pulled * r) for of, pulled in zip(normal, along, strict=True))
            shared, depth, pixel = view.row(a, b)
            parts.append(jnp.stack([*shared, scale.root * r / scale.soft, depth, *pixel]))
        return jnp.concatenate(parts, 1)

    def gradient(self, view: EdgeView) -> Gradient:
        if isinstance(view.projection, any_camera.Seen):
            return super().gradient(view)
        found = pinhole.energy_gradient(*view.projection, *self._force(view))
        return Gradient(
            jnp.stack(view.tied(list(found.shared))), found.depth, found.pixel if view.free_pixels else None
        )

    def model(self, view: EdgeView) -> LocalModel:
        if isinstance(view.projection, any_camera.Seen):
            return super().model(view)
        edge, at = view.projection
        entries, normals = self._image(view)
        squared = self.weights * squared_norm(entries)
        pull = self.weights * self.kernel.weight(squared)
        bend = 2 * self.weights**2 * self.kernel.curvature(squared)
        # Stacked arrays, not entries as in `columns`: a hundred separate sums take seconds to compile.
        residual = jnp.stack(entries)
        normal = jnp.stack([jnp.stack(of) for of in normals])
        rows = jnp.stack(pinhole.row(edge, at, *normal), 1)
        third = jnp.stack(pinhole.row_of_third(edge, at))
        along = jnp.sum(residual[:, None] * rows, 0)  # the residual times its derivative: `D / (w rho')`
        force = pull * jnp.sum(normal * residual, 1)
        added, mixed = pinhole.second_order(edge, at, (force[0], force[1]), list(third))
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
        """Return exact second derivatives by the pixels in the host, see `fast/pinhole.py`.

        derivatives: residuals, their derivatives by the projected pixel, and by shared coordinates and inverse depth.
        weights: `w rho'` and `2 w^2 rho''`. third: `P`.
        """
        assert not isinstance(view.projection, any_camera.Seen)
        edge, at = view.projection
        (residual, normal, rows), (pull, bend) = derivatives, weights
        centre = slice(_CENTRE, _CENTRE + 2)
        # The centre moves the pixel in the target and, the other way, the ray in the host.
        pixel, third_of = normal - jnp.swapaxes(rows[:, centre], 0, 1), -third[centre]
        along, of_pixel = jnp.sum(residual[:, None] * rows, 0), jnp.sum(pixel * residual, 1)
        force, gradient = pull * jnp.sum(normal * residual, 1), pull * of_pixel
        drawn = (pull * along).at[centre].add(-force)
        extra = [
            pinhole.second_order_of_pixel(edge, at, (force[0], force[1]), gradient[axis], axis) for axis in range(2)
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


def _tied_model(view: EdgeView, model: LocalModel) -> LocalModel:
    """Convert a model by the pinhole's four parameters to one by the camera's."""
    if view.cameras.kind is Pinhole:
        return model
    once = jnp.stack(view.tied(list(model.gram)))
    coupled = jnp.stack(view.tied(list(model.coupled)))
    return LocalModel(jnp.stack(view.tied(list(once.T))), coupled, model.pixels)


def products(left: Float[Array, "... mp"], right: Float[Array, "... mp"], slots: int) -> Float[Array, "... p"]:
    """Return products of columns (such as each with that by inverse depth), summed over the rows of an observation."""
    parts = [
        left[..., start : start + slots] * right[..., start : start + slots]
        for start in range(0, left.shape[-1], slots)
    ]
    return sum(parts[1:], parts[0])


def pinhole_parameters(cameras: Cameras) -> Float[Array, "4"] | None:
    """Return `fx, fy, cx, cy` if the hand-written derivatives apply: one pinhole camera for all keyframes."""
    if cameras.group is not None or cameras.kind not in (Pinhole, with_shared_focal(Pinhole)):
        return None
    own = cameras.parameters
    return own if cameras.kind is Pinhole else jnp.concatenate([own[:1], own])
