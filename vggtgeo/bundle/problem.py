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

from vggtgeo.bundle.terms.edge import EdgeTerm
from vggtgeo.bundle.terms.node import CameraTerm, DenseTerm, PairTerm, PoseTerm
from vggtgeo.bundle.terms.slot import SlotTerm
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry import lie
from vggtgeo.geometry.cameras import AbstractCamera, Pinhole
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind

MIN_INVERSE_DEPTH = 1e-6
"""1/m: the bound of positive inverse depths (1000 km)."""


class State(eqx.Module):
    """What bundle adjustment estimates: `n` poses, the camera they share, `s` inverse depths a keyframe.

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
    intrinsics: Float[Array, "*g k"]
    """Parameters of the camera, `fx, fy, cx, cy` in pixels, then those of its distortion: `[k]`, or `[g, k]` of `g`
    cameras."""
    inverse_depth: Float[Array, "h s"]
    """1/m, along the optical axis of the host keyframe, one a slot."""

    @property
    def parameters(self) -> Float[Array, " q"]:
        """The intrinsics of all cameras, one camera after the other."""
        return self.intrinsics.reshape(-1)

    def moved(self, step: Float[Array, " t"]) -> State:
        """The state that a step leads to, in the coordinates of every Hessian and covariance of this package.

        step: six a pose (`T` becomes `exp(xi) T`; metres, then radians), the cameras' parameters (pixels), then the
        inverse depths (1/m), row by row. Pure; the derivative at a zero step is the tangent map.
        """
        poses = lie.TANGENT * len(self.poses.wxyz_xyz)
        dense = poses + self.intrinsics.size
        return State(
            lie.move(self.poses, step[:poses].reshape(-1, lie.TANGENT)),
            self.intrinsics + step[poses:dense].reshape(self.intrinsics.shape),
            self.inverse_depth + step[dense:].reshape(self.inverse_depth.shape),
        )


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

    Example:
        >>> import jax.numpy as jnp, vggtgeo as vg
        >>> problem, initial, _ = vg.simulate_window(keyframes=3, points=10, lines=1).pack()
        >>> [term.name for term in problem.terms]
        ['points', 'lines', 'depth', 'intrinsics_prior']
        >>> problem.points.target.shape, problem.lines.weight.shape
        ((6, 10, 2), (6, 4))
        >>> without = problem.with_term(problem.lines.reweighted(jnp.zeros((6, 4))))
        >>> bool(vg.energy(without, initial) < vg.energy(problem, initial))
        True

    """

    pixels: Float[Array, "h s 2"]
    """Where each slot looks in its host keyframe: point slots first, then line samples."""
    edges: Edges
    terms: tuple[AbstractTerm, ...]
    """What is minimised: the sum of their energies."""
    fixed_pose: Bool[Array, " n"]
    """Keyframes whose pose is held (the gauge)."""
    fixed_intrinsics: Bool[Array, "*g k"]
    """Parameters of the cameras that are held."""
    fraction: Float[Array, "h g m"] | None = None
    """Two-ends lines: the last `g m` slots are `g` segments of `m` samples, and the inverse depth of a segment is an
    affine function of this position along it (0 and 1 at its ends). None: each sample has its own inverse depth."""
    camera_of: Int[Array, " n"] | None = None
    """Which camera took each keyframe, a row of the state's intrinsics; None: one took all."""
    camera: type[AbstractCamera] = eqx.field(static=True, default=Pinhole)
    """Model of the cameras whose parameters the state holds."""
    positive_depth: bool = eqx.field(static=True, default=True)
    """Whether inverse depths stay positive. If not, one may pass through infinity, as in a solver without bounds."""
    host: Int[Array, " h"] | None = None
    """Keyframe that hosts each row of landmarks, ascending; None: row i is that of keyframe i."""

    def __getattr__(self, name: str) -> Any:
        for term in vars(self).get("terms", ()):
            if getattr(term, "name", None) == name:
                return term
        raise AttributeError(f"`Problem` has no attribute and no term `{name}`")

    def with_term(self, term: AbstractTerm) -> Problem:
        """The problem with `term` in place of the one of the same name, or added as the last.

        Raises:
            InputError: it is no term, or of another kind than the one of its name.

        """
        check_kind("term", term, AbstractTerm, "a term, such as `vggtgeo.PointTerm`")
        names = [old.name for old in self.terms]
        for old in self.terms:
            if old.name == term.name and not (isinstance(term, type(old)) or isinstance(old, type(term))):
                raise InputError(
                    f"`{term.name}` is the name of a `{type(old).__name__}` of the problem, which a "
                    f"`{type(term).__name__}` would replace; give its class another `name`"
                )
        terms = tuple(term if old.name == term.name else old for old in self.terms)
        return self.with_terms(terms if term.name in names else (*terms, term))

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
            check_kind("terms", term, AbstractTerm, "terms in it, such as `vggtgeo.PointTerm`")
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
