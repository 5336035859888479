"""Terms on a landmark observed along an edge, which produce the arrow's cross terms.

Local coordinates of one edge `(i, j)`: the left tangent `eta` of the relative pose (6), the parameters of its cameras
(`c`), and the inverse depth of each landmark. With one camera for all keyframes, `c = k`, its parameters. With several,
`c = 2 k`, those of the target's camera and those of the host's,

    r(eta, p_j, p_i, d) = f_{p_j}(exp(eta) M (ray_{p_i}(pixel), d)),

independent of the number of other cameras; if both ends have the same camera, the derivative is the sum of both. Slots
come last in every array, so that each quantity is contiguous: columns are `[6 + c + 2, m p]`, in the order eta,
cameras, residual, inverse depth, for `m` consecutive residual rows. If the pixels of the slots in their host are also
unknowns (`HostPixel`), two rows follow: by `u`, by `v`.
"""

from __future__ import annotations

import abc
from typing import NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from vggtgeo.bundle import camera_derivatives, pinhole_derivatives
from vggtgeo.bundle.pinhole_derivatives import Gradient, OneEdge, Projection
from vggtgeo.bundle.terms.term import AbstractTerm, check_residual, reweighted_rows, robust_energy
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import AbstractCamera, Cameras, Pinhole, with_shared_focal

CENTRE = lie.TANGENT + 2
"""Index of the derivative by the principal point in a row."""


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
        return lie.rotation_matrix(self.relative) @ self.ray + self.inverse_depth * self.relative.translation()

    @property
    def point(self) -> Float[Array, "3"]:
        """The landmark in target coordinates, metres."""
        return self.scaled_point / self.inverse_depth

    @property
    def projected(self) -> Float[Array, "2"]:
        """Pixel of the landmark in the target (equation 5 of the paper)."""
        return self.camera.project(self.scaled_point)


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
    projection: tuple[OneEdge, Projection] | camera_derivatives.Seen
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
        if isinstance(self.projection, camera_derivatives.Seen):
            return self.projection.u, self.projection.v
        edge, at = self.projection
        fx, fy, cx, cy = edge.intrinsics
        return fx * at.x + cx, fy * at.y + cy

    def row(self, a: Float[Array, "*m p"], b: Float[Array, "*m p"]) -> tuple[list[Array], Array, list[Array]]:
        """Return the derivatives of a row of residuals with image gradient `(a, b)`: by the shared coordinates, by
        inverse depth, and by the pixel in the host, if it is an unknown.
        """
        if isinstance(self.projection, camera_derivatives.Seen):
            found = camera_derivatives.row(self.rotation, self.translation, self.projection, a, b)
            both = zip(found.target, found.host, strict=True)
            one_camera = self.cameras.group is None
            by_cameras = [j + i for j, i in both] if one_camera else [*found.target, *found.host]
            return [*found.motion, *by_cameras], found.depth, found.pixel if self.free_pixels else []
        *shared, depth = pinhole_derivatives.row(*self.projection, a, b)
        # By the pixel in the host: by the pixel in the target, minus by the principal point.
        pixel = [a - shared[CENTRE], b - shared[CENTRE + 1]] if self.free_pixels else []
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
        of_slots: tuple[OneEdge, Projection] | camera_derivatives.Seen
        if isinstance(self.projection, camera_derivatives.Seen):
            of_slots = jax.tree.map(part, self.projection)
        else:
            of_slots = self.projection[0], jax.tree.map(part, self.projection[1])
        own = part(self.pixels), part(self.inverse_depth)
        free = min(max(self.free_pixels - first, 0), count)
        motion = self.relative, self.rotation, self.translation
        return EdgeView(*motion, self.cameras, self.ends, *own, of_slots, free)


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

    def restricted(self, of_edge: Bool[Array, " e"]) -> Self:
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
