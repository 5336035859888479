"""The bundle-adjustment problem: a state, a graph, and a sum of terms. All shapes are static, absence is weight 0.

Sizes: `n` keyframes, `h` rows of `s` inverse depths ("slots"), `e` directed edges `(i, j)`: slots of a row of keyframe
i observed in keyframe j. Usually each keyframe has one row, so `h = n`. A keyframe that hosts far more landmarks than
others has several (`Problem.host`), which limits the padding. `q` parameters of the shared camera, or of all `g`
cameras, `k` each.
"""

from __future__ import annotations

import abc
from collections.abc import Iterator
from typing import Any, Literal, overload

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from vggtgeo.bundle.terms.landmark import DepthPrior, HostPixel, SlotTerm
from vggtgeo.bundle.terms.landmark_edge import EdgeTerm
from vggtgeo.bundle.terms.marginal import MarginalPrior
from vggtgeo.bundle.terms.node import CameraTerm, DenseTerm, IntrinsicsPrior, NodeTerm
from vggtgeo.bundle.terms.reprojection import LineTerm, PointTerm
from vggtgeo.bundle.terms.term import AbstractTerm, check_padded
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import AbstractCamera, Pinhole, SharedFocal
from vggtgeo.io.argument_checks import check_kind
from vggtgeo.io.errors import InputError

MIN_INVERSE_DEPTH, MAX_INVERSE_DEPTH = 1e-6, 1e6
"""Bounds of positive inverse depths, 1/m (1000 km, 1 micrometre). The optimum of a match at the epipole is in the
host camera, beyond all numbers."""


_ONE_OF_EACH = (PointTerm, LineTerm, DepthPrior, HostPixel, IntrinsicsPrior, MarginalPrior)
"""Kinds of terms that a problem has at most one of."""


class State(eqx.Module):
    """The unknowns of bundle adjustment: `n` poses, camera parameters, and `s` inverse depths a keyframe.

    Fields:
        poses: World -> camera of each keyframe, batch `[n]`.
        intrinsics: Parameters of the camera, `fx, fy, cx, cy` in pixels, then those of its distortion: `[k]`, or
            `[g, k]` of `g` cameras.
        inverse_depth: 1/m, along the optical axis of the host keyframe, one for each slot.
        pixel_offset: Estimated minus observed pixel of a landmark in its host, for the first `p` slots (the points);
            None: the observed pixels are exact.

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
        """Return the state after a step, in the coordinates of every Hessian and covariance of this package.

        step: six for each pose (`T` becomes `exp(xi) T`; metres, then radians), the cameras' parameters (pixels), the
        inverse depths (1/m), row by row, then the pixel offsets, if any, in the order of their array. Pure; the
        derivative at a zero step is the tangent map.
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
    """The edges of each row, in order, padded with `e`: the inverse of `index_at_host`."""
    row_of: Int[Array, " e"] | None = None
    """Row of landmarks that each edge observes, ascending; None: `source`."""

    @property
    def row(self) -> Int[Array, " e"]:
        """Row of landmarks that each edge observes."""
        return self.source if self.row_of is None else self.row_of

    @property
    def ends(self) -> tuple[Int[Array, " e"], Int[Array, " e"]]:
        """Keyframes `(i, j)` of each edge."""
        return self.source, self.target


class Terms(eqx.Module):
    """The terms of a problem, in order and by name: `terms["points"]`, `"points" in terms`, `len(terms)`.

    Iteration yields the terms in the order in which their energies are added. Of two with one name the first is found.

    Fields:
        ordered: The terms.
    """

    ordered: tuple[AbstractTerm, ...] = eqx.field(converter=tuple)

    @property
    def names(self) -> tuple[str, ...]:
        """The names in order."""
        return tuple(term.name for term in self.ordered)

    def get(self, name: str, default: AbstractTerm | None = None) -> AbstractTerm | None:
        """Return the term of a name, or the default."""
        return next((term for term in self.ordered if term.name == name), default)

    def __iter__(self) -> Iterator[AbstractTerm]:
        return iter(self.ordered)

    def __len__(self) -> int:
        return len(self.ordered)

    def __contains__(self, name: object) -> bool:
        return name in self.names

    # The package's own names, so that a type checker knows their terms.
    @overload
    def __getitem__(self, name: Literal["points"]) -> PointTerm: ...
    @overload
    def __getitem__(self, name: Literal["lines"]) -> LineTerm: ...
    @overload
    def __getitem__(self, name: Literal["depth"]) -> DepthPrior: ...
    @overload
    def __getitem__(self, name: Literal["host_pixels"]) -> HostPixel: ...
    @overload
    def __getitem__(self, name: Literal["intrinsics_prior"]) -> IntrinsicsPrior: ...
    @overload
    def __getitem__(self, name: Literal["marginal"]) -> MarginalPrior: ...
    @overload
    def __getitem__(self, name: str) -> AbstractTerm: ...
    def __getitem__(self, name: str) -> AbstractTerm:
        found = self.get(name)
        if found is None:
            raise InputError(f"`terms` has no term `{name}`; it has {', '.join(self.names) or 'no terms'}")
        return found


def _as_terms(terms: Terms | tuple[AbstractTerm, ...]) -> Terms:
    return terms if isinstance(terms, Terms) else Terms(terms)


class Problem(eqx.Module):
    """A bundle-adjustment problem, made by `vggtgeo.pack`; differentiable by every float leaf.

    Pixels, 1/m for inverse depths, poses world -> camera. An observation of weight 0 is absent, so that a kind can be
    disabled without a change of shapes.

    Fields:
        pixels: Pixel of each slot in its host keyframe: point slots first, then line samples.
        edges: The covisibility graph.
        terms: The terms, in order and by name; the sum of their energies is minimised.
        fixed_pose: Keyframes with a fixed pose (the gauge).
        fixed_intrinsics: Fixed parameters of the cameras.
        fraction: For line segments: the last `g m` slots are `g` segments of `m` samples, and the inverse depth of a
            segment is an affine function of this position along it (0 and 1 at its ends). None: each sample has its
            own inverse depth.
        camera_of: Camera of each keyframe, a row of the state's intrinsics; None: one camera for all.
        camera: Model of the cameras.
        positive_depth: Whether inverse depths are between 1e-6 and 1e6. Otherwise one may pass through infinity.
        host: Keyframe that hosts each row of landmarks, ascending; None: row i belongs to keyframe i.

    Example:
        >>> import jax.numpy as jnp, vggtgeo as vg
        >>> problem, initial, _ = vg.simulate_window(keyframes=3, points=10, lines=1).pack()
        >>> problem.terms.names
        ('points', 'lines', 'depth', 'host_pixels', 'intrinsics_prior')
        >>> problem.terms["points"].target.shape, problem.terms["lines"].weight.shape
        ((6, 10, 2), (6, 4))
        >>> without = problem.with_term(problem.terms["lines"].reweighted(jnp.zeros((6, 4))))
        >>> bool(vg.energy(without, initial) < vg.energy(problem, initial))
        True

    """

    pixels: Float[Array, "h s 2"]
    edges: Edges
    terms: Terms = eqx.field(converter=_as_terms)
    fixed_pose: Bool[Array, " n"]
    fixed_intrinsics: Bool[Array, "*g k"]
    fraction: Float[Array, "h g m"] | None = None
    camera_of: Int[Array, " n"] | None = None
    camera: type[AbstractCamera] = eqx.field(static=True, default=Pinhole)
    positive_depth: bool = eqx.field(static=True, default=True)
    host: Int[Array, " h"] | None = None

    def with_term(self, term: AbstractTerm, *, replace: bool = False) -> Problem:
        """Add a term, or replace the term of the same name.

        Points, lines, depth, the intrinsics' prior and the prior of a marginalisation replace the existing one. Any
        other term with an existing name raises an error unless `replace=True`, so that a second list of measurements
        does not silently replace the first.

        Args:
            term: in the padded shape of this problem.
            replace: whether to replace a term of the same name.

        Raises:
            InputError: `term` is not a term, its name exists, the term of that name is of another kind, or it is on
                landmarks and not in the padded shape of this problem.

        Example: two receivers, each with measurements of its own.
            >>> import jax.numpy as jnp
            >>> class PositionFix(vg.terms.PoseTerm):
            ...     position: jnp.ndarray
            ...     def residual(self, pose, camera):
            ...         return pose.inverse().translation() - self.position
            >>> class SecondFix(PositionFix):
            ...     name = "second_fix"
            >>> first, second = (kind(keyframe=[1], position=jnp.zeros((1, 3))) for kind in (PositionFix, SecondFix))
            >>> problem.with_term(first).with_term(second).terms.names[-2:]
            ('position_fix', 'second_fix')

        """
        check_kind("term", term, AbstractTerm, "a term, such as `vggtgeo.terms.PointTerm`")
        term = term.broadcast()
        if isinstance(term, EdgeTerm | SlotTerm):
            rows = self.edges.source.shape if isinstance(term, EdgeTerm) else self.pixels.shape[:-2]
            check_padded(term, rows, self.pixels.shape[-2])
        old = self.terms.get(term.name)
        if old is None:
            return self.with_terms((*self.terms, term))
        if not (isinstance(term, type(old)) or isinstance(old, type(term))):
            raise InputError(
                f"`term` must not have the name `{term.name}` of a `{type(old).__name__}` of the problem, got a "
                f"`{type(term).__name__}`: define another `name` in its class"
            )
        if not replace and not isinstance(old, _ONE_OF_EACH):
            raise InputError(
                f"`term` is a second `{term.name}`: pass `replace=True` to replace the first; to have both, join their "
                "observations in one term, or derive a class with another `name`"
            )
        return self.with_terms(tuple(term if own is old else own for own in self.terms))

    def without_term(self, name: str) -> Problem:
        """Return the problem without the term of that name; unchanged if there is none."""
        return self.with_terms(tuple(term for term in self.terms if term.name != name))

    def with_terms(self, terms: Terms | tuple[AbstractTerm, ...]) -> Problem:
        """Return the problem with other terms.

        Raises:
            InputError: `terms` is not a tuple of terms.

        """
        check_kind("terms", terms, (Terms, tuple), "a tuple of terms")
        for term in terms:
            check_kind("terms", term, AbstractTerm, "a tuple of terms, such as `vggtgeo.terms.PointTerm`")
        return eqx.tree_at(lambda problem: problem.terms, self, _as_terms(terms))

    @property
    def edge_terms(self) -> tuple[EdgeTerm, ...]:
        """Terms along edges with at least one slot."""
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
    def node_terms(self) -> tuple[NodeTerm, ...]:
        """Terms on poses and pairs of them."""
        return tuple(term for term in self.terms if isinstance(term, NodeTerm))

    @property
    def camera_terms(self) -> tuple[CameraTerm, ...]:
        """Terms on the camera."""
        return tuple(self._of_kind(CameraTerm))

    @property
    def dense_terms(self) -> tuple[DenseTerm, ...]:
        """Terms on all poses and the camera."""
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
    def shared_focal(self) -> bool:
        """Whether the cameras have one focal length, `fx = fy = f`."""
        return issubclass(self.camera, SharedFocal)

    @property
    def num_parameters(self) -> int:
        """Parameters of all cameras."""
        return self.fixed_intrinsics.size

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of the dense state: `fx`, or `fx of camera 1` for several cameras."""
        if self.camera_of is None:
            return self.camera.names
        groups = self.num_parameters // len(self.camera.names)
        return tuple(f"{name} of camera {group}" for group in range(groups) for name in self.camera.names)

    @property
    def num_camera(self) -> int:
        """Size of the dense part of the state: six for each keyframe, and the cameras' parameters."""
        return lie.TANGENT * self.num_keyframes + self.num_parameters

    @property
    def first_segment(self) -> int:
        """First slot that belongs to a line segment."""
        slots = self.pixels.shape[1]
        return slots if self.fraction is None else slots - self.fraction.shape[1] * self.fraction.shape[2]


class Readable(eqx.Module):
    """A result, a pytree whose representation is one line; inside `jit`, or for a batch, its leaves."""

    @abc.abstractmethod
    def _line(self) -> str:
        """Return the line; may raise an error of shape or type for traced values and batches."""

    def __str__(self) -> str:
        try:
            return self._line()
        except (TypeError, ValueError, IndexError):  # traced values and batches have no single number
            return eqx.Module.__repr__(self)

    __repr__ = __str__
