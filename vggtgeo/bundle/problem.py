"""The bundle-adjustment problem: a state, a graph, and a sum of terms. All shapes are static, absence is weight 0.

Sizes: `n` keyframes, `h` rows of `s` inverse depths ("slots"), `e` directed edges `(i, j)`: slots of a row of keyframe
i observed in keyframe j. A keyframe has one row, so `h = n`; one that hosts far more landmarks than others has several
(`Problem.host`), so that arrays are not padded to the richest. `q` parameters of the camera that all keyframes share,
or of all `g` cameras, `k` each.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from vggtgeo.bundle.terms.depth import DepthPrior
from vggtgeo.bundle.terms.edge import EdgeTerm
from vggtgeo.bundle.terms.host_pixel import HostPixel
from vggtgeo.bundle.terms.intrinsics import IntrinsicsPrior
from vggtgeo.bundle.terms.line import LineTerm
from vggtgeo.bundle.terms.marginal import MarginalPrior
from vggtgeo.bundle.terms.node import CameraTerm, DenseTerm, PairTerm, PoseTerm
from vggtgeo.bundle.terms.point import PointTerm
from vggtgeo.bundle.terms.slot import SlotTerm
from vggtgeo.bundle.terms.term import AbstractTerm, check_padded
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import AbstractCamera, Pinhole
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind

MIN_INVERSE_DEPTH = 1e-6
"""1/m: the bound of positive inverse depths (1000 km)."""


_ONE_OF_EACH = (PointTerm, LineTerm, DepthPrior, HostPixel, IntrinsicsPrior, MarginalPrior)
"""Kinds of terms that a problem has one of."""


class State(eqx.Module):
    """What bundle adjustment estimates: `n` poses, the camera they share, `s` inverse depths a keyframe.

    Fields:
        poses: World -> camera of each keyframe, batch `[n]`.
        intrinsics: Parameters of the camera, `fx, fy, cx, cy` in pixels, then those of its distortion: `[k]`, or
            `[g, k]` of `g` cameras.
        inverse_depth: 1/m, along the optical axis of the host keyframe, one a slot.
        pixel_offset: Pixels from where a landmark was observed in its host to where it is, of the first `p` slots (the
            points); None: the observed pixels are exact.

    Example:
        >>> import jax.numpy as jnp, vggtgeo as vg
        >>> _, initial, _ = vg.simulate_window(keyframes=3, points=10, lines=1).pack()
        >>> initial.inverse_depth.shape
        (3, 14)
        >>> step = jnp.zeros(initial.num_unknowns).at[18].set(2.0)  # the first of the intrinsics
        >>> float(initial.moved(step).intrinsics[0] - initial.intrinsics[0])
        2.0

    """

    poses: jaxlie.SE3
    intrinsics: Float[Array, "*g k"]
    inverse_depth: Float[Array, "h s"]
    pixel_offset: Float[Array, "h p 2"] | None = None

    @property
    def parameters(self) -> Float[Array, " q"]:
        """The intrinsics of all cameras, one camera after the other."""
        return self.intrinsics.reshape(-1)

    def moved(self, step: Float[Array, " t"]) -> State:
        """The state that a step leads to, in the coordinates of every Hessian and covariance of this package.

        step: six a pose (`T` becomes `exp(xi) T`; metres, then radians), the cameras' parameters (pixels), the inverse
        depths (1/m), row by row, then the pixel offsets, if there are any, in the order of their array. Pure;
        the derivative at a zero step is the tangent map.
        """
        poses = lie.TANGENT * len(self.poses.wxyz_xyz)
        dense = poses + self.intrinsics.size
        landmarks = dense + self.inverse_depth.size
        offset = self.pixel_offset
        return State(
            lie.move(self.poses, step[:poses].reshape(-1, lie.TANGENT)),
            self.intrinsics + step[poses:dense].reshape(self.intrinsics.shape),
            self.inverse_depth + step[dense:landmarks].reshape(self.inverse_depth.shape),
            None if offset is None else offset + step[landmarks:].reshape(offset.shape),
        )

    @property
    def num_unknowns(self) -> int:
        """Length of a step of `moved`."""
        offsets = 0 if self.pixel_offset is None else self.pixel_offset.size
        return lie.TANGENT * len(self.poses.wxyz_xyz) + self.intrinsics.size + self.inverse_depth.size + offsets


class Edges(eqx.Module):
    """The covisibility graph: directed edges sorted by host keyframe, and by the row of its landmarks."""

    source: Int[Array, " e"]
    """Host keyframe i, ascending."""
    target: Int[Array, " e"]
    """Keyframe j in which the slots of i are observed."""
    index_at_host: Int[Array, " e"]
    """Position of the edge among the edges of its row, from 0."""
    of_host: Int[Array, "h k"]
    """The edges of each row, in their order, and `e` where it has fewer than `k`: the inverse of `index_at_host`."""
    row_of: Int[Array, " e"] | None = None
    """Row of landmarks that each edge observes, ascending; None: that of its host's number."""

    @property
    def row(self) -> Int[Array, " e"]:
        """Row of landmarks that each edge observes."""
        return self.source if self.row_of is None else self.row_of

    @property
    def ends(self) -> tuple[Int[Array, " e"], Int[Array, " e"]]:
        """Keyframes `(i, j)` of each edge."""
        return self.source, self.target


class Problem(eqx.Module):
    """A bundle-adjustment problem; every float leaf may be differentiated. `vggtgeo.pack` makes one.

    Pixels, 1/m for inverse depths, poses world -> camera. Weight 0 means that an observation is not there, so that a
    kind can be left out without another shape. A term is also an attribute by its name: `problem.points`.

    Fields:
        pixels: Where each slot looks in its host keyframe: point slots first, then line samples.
        edges: The covisibility graph.
        terms: What is minimised: the sum of their energies.
        fixed_pose: Keyframes whose pose is held (the gauge).
        fixed_intrinsics: Parameters of the cameras that are held.
        fraction: Two-ends lines: the last `g m` slots are `g` segments of `m` samples, and the inverse depth of a
            segment is an affine function of this position along it (0 and 1 at its ends). None: each sample has its
            own inverse depth.
        camera_of: Which camera took each keyframe, a row of the state's intrinsics; None: one took all.
        camera: Model of the cameras whose parameters the state holds.
        positive_depth: Whether inverse depths stay positive. If not, one may pass through infinity, as in a solver
            without bounds.
        host: Keyframe that hosts each row of landmarks, ascending; None: row i is that of keyframe i.

    Example:
        >>> import jax.numpy as jnp, vggtgeo as vg
        >>> problem, initial, _ = vg.simulate_window(keyframes=3, points=10, lines=1).pack()
        >>> [term.name for term in problem.terms]
        ['points', 'lines', 'depth', 'host_pixels', 'intrinsics_prior']
        >>> problem.points.target.shape, problem.lines.weight.shape
        ((6, 10, 2), (6, 4))
        >>> without = problem.with_term(problem.lines.reweighted(jnp.zeros((6, 4))))
        >>> bool(vg.energy(without, initial) < vg.energy(problem, initial))
        True

    """

    pixels: Float[Array, "h s 2"]
    edges: Edges
    terms: tuple[AbstractTerm, ...]
    fixed_pose: Bool[Array, " n"]
    fixed_intrinsics: Bool[Array, "*g k"]
    fraction: Float[Array, "h g m"] | None = None
    camera_of: Int[Array, " n"] | None = None
    camera: type[AbstractCamera] = eqx.field(static=True, default=Pinhole)
    positive_depth: bool = eqx.field(static=True, default=True)
    host: Int[Array, " h"] | None = None

    def __getattr__(self, name: str) -> Any:
        for term in vars(self).get("terms", ()):
            if getattr(term, "name", None) == name:
                return term
        raise AttributeError(f"`Problem` has no attribute and no term `{name}`")

    def with_term(self, term: AbstractTerm, *, replace: bool = False) -> Problem:
        """Add a term as the last, or put it in place of the one of its name.

        What a problem has one of is replaced: points, lines, depth, the intrinsics' prior and the prior of a
        marginalisation. Any other term of a name that is taken is refused, so that a second list of
        measurements does not take the place of the first; `replace=True` says that it is to.

        Args:
            term: in the padded shape of this problem.
            replace: put it in place of the term of its name, if there is one.

        Raises:
            InputError: it is no term, its name is taken, the term of its name is of another kind, or it is on
                landmarks and not in the shape of this problem.

        Example: two receivers, each with measurements of its own.
            >>> import jax.numpy as jnp
            >>> class PositionFix(vg.terms.PoseTerm):
            ...     position: jnp.ndarray
            ...     def residual(self, pose, camera):
            ...         return pose.inverse().translation() - self.position
            >>> class SecondFix(PositionFix):
            ...     name = "second_fix"
            >>> first, second = (kind(keyframe=[1], position=jnp.zeros((1, 3))) for kind in (PositionFix, SecondFix))
            >>> [term.name for term in problem.with_term(first).with_term(second).terms[-2:]]
            ['position_fix', 'second_fix']

        """
        check_kind("term", term, AbstractTerm, "a term, such as `vggtgeo.terms.PointTerm`")
        term = term.broadcast()
        if isinstance(term, EdgeTerm | SlotTerm):
            rows = self.edges.source.shape if isinstance(term, EdgeTerm) else self.pixels.shape[:-2]
            check_padded(term, rows, self.pixels.shape[-2])
        old = next((old for old in self.terms if old.name == term.name), None)
        if old is None:
            return self.with_terms((*self.terms, term))
        if not (isinstance(term, type(old)) or isinstance(old, type(term))):
            raise InputError(
                f"`{term.name}` is the name of a `{type(old).__name__}` of the problem, which a "
                f"`{type(term).__name__}` would replace; give its class another `name`"
            )
        if not replace and not isinstance(old, _ONE_OF_EACH):
            raise InputError(
                f"`term` is a second `{term.name}`; the problem has one of that name. Give `replace=True` to put it in "
                "its place; for both, join their observations in one term, or derive a class with a `name` of its own"
            )
        return self.with_terms(tuple(term if own is old else own for own in self.terms))

    def without_term(self, name: str) -> Problem:
        """The problem without the term of that name, if it has one."""
        return self.with_terms(tuple(term for term in self.terms if term.name != name))

    def with_terms(self, terms: tuple[AbstractTerm, ...]) -> Problem:
        """The problem with other terms.

        Raises:
            InputError: they are no tuple of terms.

        """
        check_kind("terms", terms, tuple, "a tuple of terms")
        for term in terms:
            check_kind("terms", term, AbstractTerm, "terms in it, such as `vggtgeo.terms.PointTerm`")
        return eqx.tree_at(lambda problem: problem.terms, self, terms)

    @property
    def edge_terms(self) -> tuple[EdgeTerm, ...]:
        """Terms along edges that have room for an observation."""
        return tuple(term for term in self._of_kind(EdgeTerm) if term.weight.shape[-1])

    @property
    def slot_terms(self) -> tuple[SlotTerm, ...]:
        """Terms on landmarks."""
        return tuple(self._of_kind(SlotTerm))

    @property
    def pixel_terms(self) -> tuple[HostPixel, ...]:
        """Terms on the pixels of landmarks in their host."""
        return tuple(self._of_kind(HostPixel))

    @property
    def node_terms(self) -> tuple[PoseTerm | PairTerm, ...]:
        """Terms on poses and pairs of them."""
        return tuple(term for term in self.terms if isinstance(term, PoseTerm | PairTerm))

    @property
    def camera_terms(self) -> tuple[CameraTerm, ...]:
        """Terms on the camera."""
        return tuple(self._of_kind(CameraTerm))

    @property
    def dense_terms(self) -> tuple[DenseTerm, ...]:
        """Terms on everything dense."""
        return tuple(self._of_kind(DenseTerm))

    def _of_kind(self, kind: type) -> Iterator[Any]:
        return (term for term in self.terms if isinstance(term, kind))

    @property
    def num_keyframes(self) -> int:
        return len(self.fixed_pose)

    @property
    def host_of_row(self) -> Int[Array, " h"]:
        """Keyframe that hosts each row of landmarks."""
        return jnp.arange(self.num_keyframes) if self.host is None else self.host

    @property
    def num_parameters(self) -> int:
        """Parameters of all cameras."""
        return self.fixed_intrinsics.size

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Of the parameters, in the order of the dense state: `fx`, or `fx of camera 1` of several."""
        if self.camera_of is None:
            return self.camera.names
        groups = self.num_parameters // len(self.camera.names)
        return tuple(f"{name} of camera {group}" for group in range(groups) for name in self.camera.names)

    @property
    def num_camera(self) -> int:
        """Size of the dense part of the state: six a keyframe, and the cameras' parameters."""
        return lie.TANGENT * self.num_keyframes + self.num_parameters

    @property
    def first_segment(self) -> int:
        """First slot that belongs to a two-ends line."""
        slots = self.pixels.shape[1]
        return slots if self.fraction is None else slots - self.fraction.shape[1] * self.fraction.shape[2]
