"""Factors on keyframe poses besides matches: keyed by keyframe number, packed as terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import jax
import numpy as np
from jaxtyping import Array
from scipy.spatial.transform import Rotation

from vggtgeo.bundle.terms.measured_pose import BaselinePrior, RelativePose, RotationPrior, SurfaceAlignment, quadratic
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.compilation.program_cache import to_device
from vggtgeo.geometry import rigid
from vggtgeo.solvers.kernels import Cauchy


@dataclass(frozen=True, eq=False)
class MeasuredRotation:
    """A keyframe's rotation, world -> camera float64 [3, 3], and its information float64 [3, 3], 1/rad^2."""

    keyframe: int
    rotation: np.ndarray
    information: np.ndarray

    @property
    def keyframes(self) -> tuple[int, ...]:
        return (self.keyframe,)


@dataclass(frozen=True, eq=False)
class MeasuredBaseline:
    """The distance between the centres of two keyframes, and its relative standard deviation."""

    first: int
    second: int
    length: float
    sigma: float

    @property
    def keyframes(self) -> tuple[int, int]:
        return self.first, self.second


@dataclass(frozen=True, eq=False)
class MeasuredRelativePose:
    """Camera `first` -> camera `second`, float64 [4, 4], and its information float64 [6, 6], translation first.

    by_two_view: whether no known depth was used, so that the length, and the scale after it, is weakly constrained, see
    `tracking/two_view_motion.py`. recorded: whether no image was used: a motion from recorded poses
    (`slam/pose_prior_check.py`).
    """

    first: int
    second: int
    pose: np.ndarray
    information: np.ndarray
    by_two_view: bool = False
    recorded: bool = False

    @property
    def keyframes(self) -> tuple[int, int]:
        return self.first, self.second

    def of_free_length(self) -> Self:
        """Return the factor for a map without measured depth.

        Its length is known in the local scale of the map only, which is itself an estimate. The length of a recorded
        motion is known.
        """
        if self.recorded:
            return self
        length = np.append(FREE_LENGTH * self.pose[:3, 3], np.zeros(3))
        # A rank-one addition along the translation: its length becomes uncertain, its direction and the rotation stay
        # known.
        noise = np.linalg.inv(self.information) + np.outer(length, length)
        return replace(self, information=np.linalg.inv(noise))


FREE_LENGTH = 0.1
"""Relative standard deviation of the length of a tracked motion without measured depth: that of the scale drift from
one keyframe to the next, 0.01 to 0.09 on real clips. A smaller one would count the current scale as measured repeatedly
and preserve its drift; a much larger one leaves the scale unconstrained in pure rotation."""
FACTOR_WIDTH = 12.6**0.5
"""Mahalanobis distance at which a relative-pose factor has half its weight, so that a false loop is rejected: one true
factor in twenty is farther off (chi-square, 6 degrees of freedom)."""

_quadratic_jit = jax.jit(quadratic)
"""Compiled as one function: its operations one by one take four times as long to compile."""

Factor = MeasuredRotation | MeasuredBaseline | MeasuredRelativePose


def factor_terms(
    factors: Sequence[Factor], places: Mapping[int, int], capacity: Mapping[type, int], *, metric: bool
) -> tuple[AbstractTerm, ...]:
    """Return one term for each kind in `capacity`, padded to that many observations.

    places: row of each keyframe in the problem, by its number; factors of other keyframes are left out. If there are
    more factors than room, the last are kept. metric: whether depth was measured; see
    `MeasuredRelativePose.of_free_length`.
    """
    makers: dict[type, Callable[..., AbstractTerm]] = {
        MeasuredRotation: _rotations,
        MeasuredBaseline: _baselines,
        MeasuredRelativePose: _relative_poses,
    }
    # A factor with one end outside would need a pose that the problem does not have.
    inside = [factor for factor in factors if all(number in places for number in factor.keyframes)]
    if not metric:
        inside = [f.of_free_length() if isinstance(f, MeasuredRelativePose) else f for f in inside]
    terms = []
    for kind, room in capacity.items():
        own = [factor for factor in inside if isinstance(factor, kind)]
        # The newest factors are those between the newest keyframes, which need them most.
        terms.append(makers[kind](own[max(len(own) - room, 0) :], places, room))
    return tuple(terms)


def surface_term(
    pairs: Sequence[tuple[int, int]], relative: np.ndarray, hessians: np.ndarray, gradients: np.ndarray
) -> SurfaceAlignment:
    """Return alignments of surfaces as a term.

    Their normal equations `[m, 6, 6]`, `[m, 6]` are over the left tangent of the relative poses `[m, 4, 4]`, for pairs
    of rows of the problem. A zero Hessian is a pair that was not aligned.
    """
    at = to_device(rigid.to_quaternion(relative))
    measured, root = _quadratic_jit(at, to_device(hessians), to_device(gradients))
    first, second = np.asarray(pairs, int).reshape(-1, 2).T
    # A zero Hessian has no minimum: its `measured` pose is a placeholder.
    aligned = np.any(hessians != 0, (1, 2)).astype(np.float64)
    return SurfaceAlignment(
        first=to_device(first, np.int32),
        second=to_device(second, np.int32),
        measured=measured,
        root=root,
        weight=to_device(aligned),
    )


def _rotations(own: Sequence[MeasuredRotation], places: Mapping[int, int], room: int) -> RotationPrior:
    measured = np.tile([1.0, 0, 0, 0], (room, 1))
    for row, factor in enumerate(own):
        measured[row] = Rotation.from_matrix(factor.rotation).as_quat(scalar_first=True)
    return RotationPrior(
        keyframe=_padded([places[factor.keyframe] for factor in own], room),
        measured=to_device(measured),
        root=_roots([factor.information for factor in own], 3, room),
        weight=_present(own, room),
    )


def _baselines(own: Sequence[MeasuredBaseline], places: Mapping[int, int], room: int) -> BaselinePrior:
    read = lambda name: to_device([*(getattr(factor, name) for factor in own), *[1.0] * (room - len(own))])
    return BaselinePrior(
        first=_padded([places[factor.first] for factor in own], room),
        second=_padded([places[factor.second] for factor in own], room),
        length=read("length"),
        sigma=read("sigma"),
        weight=_present(own, room),
    )


def _relative_poses(own: Sequence[MeasuredRelativePose], places: Mapping[int, int], room: int) -> RelativePose:
    placed = [replace(factor, first=places[factor.first], second=places[factor.second]) for factor in own]
    return RelativePose(**relative_pose_rows(placed, room), kernel=Cauchy(to_device(FACTOR_WIDTH)))


def relative_pose_rows(own: Sequence[MeasuredRelativePose], room: int | None = None) -> dict[str, Any]:
    """Return the fields of a `RelativePose` term, padded to `room` observations; keyframes are rows of the problem."""
    room = len(own) if room is None else room
    poses = np.tile(np.eye(4), (room, 1, 1))
    for row, factor in enumerate(own):
        poses[row] = factor.pose
    return {
        "first": _padded([factor.first for factor in own], room),
        "second": _padded([factor.second for factor in own], room),
        "measured": to_device(rigid.to_quaternion(poses)),
        "root": _roots([factor.information for factor in own], 6, room),
        "weight": _present(own, room),
    }


def _padded(rows: list[int], room: int) -> Array:
    return to_device([*rows, *[0] * (room - len(rows))], np.int32)


def _present(own: Sequence[Factor], room: int) -> Array:
    return to_device((np.arange(room) < len(own)).astype(np.float64))


def _roots(information: Sequence[np.ndarray], size: int, room: int) -> Array:
    """Return square roots `R' R` of information matrices, which may be singular."""
    whole = np.zeros((room, size, size))
    if len(information):
        # Not Cholesky: the information of a motion may be singular.
        values, vectors = np.linalg.eigh(np.asarray(information))
        whole[: len(information)] = np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.transpose(0, 2, 1)
    return to_device(whole)
