"""`plot`: draw any value of the library."""

from __future__ import annotations

from functools import singledispatch
from typing import Any

import numpy as np
from jaxtyping import Float

from vggtgeo.bundle.analysis.covariances import Covariances
from vggtgeo.bundle.analysis.observability_report import Observability
from vggtgeo.bundle.pair_checks import check_finite
from vggtgeo.bundle.problem import State
from vggtgeo.bundle.solution import Solution
from vggtgeo.evaluation import TrajectoryReport, associate
from vggtgeo.figures.plots import NotebookFigure, energy_figure, errors_figure, trajectory_figure
from vggtgeo.figures.uncertainty import covariance_figure, observability_figure
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind, check_positive, real_array


@singledispatch
def plot(value: Any, *args: Any, **options: Any) -> NotebookFigure:
    """Return a figure of a value; a notebook displays it, `savefig` writes it. Not for traced or batched values.

    Args:
        value: one of

            - `Trajectory`: from above and from the side. Options: `truth` (a trajectory), drawn beside it after SE(3)
              alignment, or Sim(3) `with_scale=True`.
            - `Result`: the same, and the map from inside and from above. Options: `truth`.
            - `TrajectoryReport` of `evaluate`: histograms of the errors after each alignment.
            - `Solution`: the energy by iteration.
            - `Covariances`: the camera centres from above with ellipses. Takes the `state` that they belong to.
              Options: `truth`, camera centres [n, 3] in the world; `sigmas`, by default chosen to be visible.
            - `Observability`: the eigenvalues, and the information lost without each kind of observation.
            - `BenchReport`: the error of every run, by scene and variant.
        args: as above.
        options: as above.

    Raises:
        InputError: a value of another type, or an invalid option.

    Example (of `solve`'s):
        >>> vg.plot(solution).axes[0].get_ylabel()
        'energy'

    """
    known = sorted(kind.__name__ for kind in plot.registry if kind is not object)
    raise InputError(f"`value` must be one of {', '.join(known)}, got `{type(value).__name__}`")


def check_single(values: Any, axes: int) -> None:
    """Raise InputError for a batch."""
    if np.ndim(values) != axes:
        raise InputError("`value` is a batch; plot one of it: `jax.tree.map(lambda leaf: leaf[0], value)` is the first")


@plot.register(Trajectory)
def _trajectory(value: Trajectory, truth: Trajectory | None = None, *, with_scale: bool = False) -> NotebookFigure:
    check_truth(value, truth)
    return trajectory_figure(value, truth, with_scale=with_scale)


def check_truth(value: Trajectory, truth: Trajectory | None) -> None:
    """Raise InputError unless `truth` is a trajectory with matching times."""
    if truth is not None:
        check_kind("truth", truth, Trajectory, "a `vggtgeo.Trajectory`")
        associate(value, truth)


@plot.register(TrajectoryReport)
def _errors(value: TrajectoryReport) -> NotebookFigure:
    return errors_figure(value)


@plot.register(Solution)
def _energy(value: Solution) -> NotebookFigure:
    history = np.asarray(value.history)
    check_single(history, 1)
    return energy_figure(history[np.isfinite(history)], value.result)


@plot.register(Covariances)
def _covariances(
    value: Covariances, state: State, truth: Float[np.ndarray, "n 3"] | None = None, *, sigmas: float | None = None
) -> NotebookFigure:
    check_single(value.poses, 3)
    check_kind("state", state, State, "a `State`, for example `solution.state`")
    keyframes = len(value.poses)
    if np.shape(state.poses.wxyz_xyz) != (keyframes, 7):
        raise InputError(
            f"`state` has poses of shape {np.shape(state.poses.wxyz_xyz)}, expected {keyframes} keyframes as the "
            "covariances; pass the state and the covariances of one solution"
        )
    check_finite(state)
    if truth is not None:
        real_array("truth", truth, (keyframes, 3))
    if sigmas is not None:
        check_positive("sigmas", sigmas, "standard deviations")
    return covariance_figure(value, state, truth, sigmas)


@plot.register(Observability)
def _observability(value: Observability) -> NotebookFigure:
    return observability_figure(value)
