"""`plot`: one function that draws any value of the library."""

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
    """A figure of a value, which a notebook shows as it is; `savefig` writes it. Outside `jit`, for one problem.

    Args:
        value: one of

            - `Trajectory`: from above and from the side. Options: `truth` (a trajectory), drawn beside it after SE(3)
              alignment, or Sim(3) `with_scale=True`.
            - `Result` of a run: the same, and the map from inside and from above. Options: `truth`.
            - what `evaluate` returns: a histogram of the errors after either alignment.
            - `Solution`: the energy by iteration.
            - `Covariances`: the camera centres from above with an ellipse each. Takes the `state` that they belong to.
              Options: `truth`, camera centres [n, 3] in the world; `sigmas`, by default as many as can be seen well.
            - `Observability`: the eigenvalues, and what would be lost without each kind of observation.
            - `BenchReport`: the error of every run, by scene and variant.
        args: of the value's kind.
        options: of the value's kind.

    Raises:
        InputError: there is no picture of such a value.

    Example (of `solve`'s):
        >>> vg.plot(solution).axes[0].get_ylabel()
        'energy'

    """
    known = sorted(kind.__name__ for kind in plot.registry if kind is not object)
    raise InputError(f"`plot` has no picture of a `{type(value).__name__}`; it draws {', '.join(known)}")


def check_single(values: Any, axes: int) -> None:
    """InputError for a batch, which has no one picture."""
    if np.ndim(values) != axes:
        raise InputError("`value` is a batch; give one of it: `jax.tree.map(lambda leaf: leaf[0], value)` is the first")


@plot.register(Trajectory)
def _trajectory(value: Trajectory, truth: Trajectory | None = None, *, with_scale: bool = False) -> NotebookFigure:
    check_truth(value, truth)
    return trajectory_figure(value, truth, with_scale=with_scale)


def check_truth(value: Trajectory, truth: Trajectory | None) -> None:
    """InputError unless it is a trajectory of the same times: another one could not be drawn beside `value`."""
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
    check_kind("state", state, State, "a `State`, such as `solution.state`")
    keyframes = len(value.poses)
    if np.shape(state.poses.wxyz_xyz) != (keyframes, 7):
        raise InputError(
            f"`state` has poses of the shape {np.shape(state.poses.wxyz_xyz)}, the covariances {keyframes} keyframes; "
            "give the state that they are of, and covariances of all its keyframes"
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
