"""Draw any value of the library with `plot`."""

from __future__ import annotations

from functools import singledispatch
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.patches import Ellipse

from vggtgeo.bundle.analysis.covariances import Covariances
from vggtgeo.bundle.analysis.observability_report import WEAK, Observability, lost_shares
from vggtgeo.bundle.checks import check_finite
from vggtgeo.bundle.problem import State
from vggtgeo.bundle.solution import Solution
from vggtgeo.evaluation import TrajectoryReport, associate
from vggtgeo.figures.plots import (
    BLUE,
    INK,
    ORANGE,
    NotebookFigure,
    line_colour,
    style,
    trajectory_figure,
)
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.argument_checks import check_kind, check_positive, real_array
from vggtgeo.io.errors import InputError

_FACTORS = (1, 3, 10, 30, 100, 300, 1000)
"""Possible sizes of the ellipses, standard deviations."""
_MAX_SHARE = 0.2
"""Maximum half axis of an ellipse, as a share of the figure's extent."""


@singledispatch
def plot(value: Any, *args: Any, **options: Any) -> NotebookFigure:
    """Return a figure of a value; a notebook displays it, `savefig` writes it. Not for traced or batched values.

    Args:
        value: one of

            - `Trajectory`: from above and from the side. Options: `truth` (a trajectory), drawn after SE(3) alignment,
              or Sim(3) `with_scale=True`.
            - `Result`: its trajectory, and the map from inside and from above. Options: `truth`.
            - `TrajectoryReport` of `evaluate`: histograms of the errors after each alignment.
            - `Solution`: the energy by iteration.
            - `Covariances`: the camera centres from above with ellipses. Needs the `state` that they belong to.
              Options: `truth`, camera centres [n, 3] in the world; `sigmas`, by default chosen to be visible.
            - `Observability`: the eigenvalues, and the information lost without each kind of observation.
            - `BenchReport`: the error of every run, by sequence and setting.
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
        raise InputError(
            "`value` must not be a batch; plot one element: `jax.tree.map(lambda leaf: leaf[0], value)` is the first"
        )


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
def _errors(report: TrajectoryReport) -> NotebookFigure:
    """Draw histograms of the errors of the camera centres, centimetres, after SE(3) and after Sim(3) alignment."""
    figure = NotebookFigure(figsize=(6.0, 3.2), layout="constrained")
    axes = figure.subplots()
    found = (("SE(3)", report.se3, BLUE), ("Sim(3)", report.sim3, ORANGE))
    edges = np.linspace(0, 100 * max(float(error.errors.max()) for _, error, _ in found) + 1e-9, 31)
    for name, error, colour in found:
        label = f"after {name}: RMSE {100 * error.statistics.rmse:.2f} cm"
        axes.hist(100 * error.errors, edges.tolist(), histtype="stepfilled", color=colour, alpha=0.45, label=label)
    axes.set_xlabel("error of a camera centre [cm]")
    axes.set_ylabel("poses")
    axes.legend(frameon=False)
    return figure


@plot.register(Solution)
def _energy(value: Solution) -> NotebookFigure:
    """Draw the energy before the first and after each iteration, logarithmic."""
    history = np.asarray(value.history)
    check_single(history, 1)
    figure = NotebookFigure(figsize=(5.0, 3.0), layout="constrained")
    axes = figure.subplots()
    axes.semilogy(history[np.isfinite(history)], ".-", color=BLUE)
    axes.set_xlabel("iteration")
    axes.set_ylabel("energy")
    axes.set_title(value.result, loc="left", fontsize=10, color=INK)
    style(axes)
    return figure


@plot.register(Covariances)
def _covariances(
    value: Covariances, state: State, truth: Float[np.ndarray, "n 3"] | None = None, *, sigmas: float | None = None
) -> NotebookFigure:
    """Draw the camera centres in the horizontal plane of the first camera, with ellipses, and the true centres."""
    check_single(value.poses, 3)
    check_kind("state", state, State, "a `State`, for example `solution.state`")
    keyframes = len(value.poses)
    if np.shape(state.poses.wxyz_xyz) != (keyframes, 7):
        raise InputError(
            f"`state` must have {keyframes} keyframes as the covariances, got poses of shape "
            f"{np.shape(state.poses.wxyz_xyz)}: pass the state and the covariances of one solution"
        )
    check_finite(state)
    if truth is not None:
        real_array("truth", truth, (keyframes, 3))
    if sigmas is not None:
        check_positive("sigmas", sigmas, "standard deviations")
    poses = rigid.to_matrix(np.asarray(state.poses.wxyz_xyz, np.float64))
    blocks = np.asarray(value.poses, np.float64)[:, :3, :3]
    turn = poses[0, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)  # from each camera to the first
    known = np.all(np.isfinite(blocks), axis=(1, 2))
    spread = (turn @ np.where(known[:, None, None], blocks, 0.0) @ turn.transpose(0, 2, 1))[:, [0, 2]][:, :, [0, 2]]
    flat = lambda centres: (centres @ poses[0, :3, :3].T + poses[0, :3, 3])[:, [0, 2]]
    centres = flat(rigid.invert(poses)[:, :3, 3])
    values, vectors = np.linalg.eigh(spread)
    half_axes = np.sqrt(np.maximum(values, 0.0))
    extent = max(float(np.ptp(centres, axis=0).max()), 1e-6)
    seen = [factor for factor in _FACTORS if factor * half_axes.max() <= _MAX_SHARE * extent]
    factor = sigmas if sigmas is not None else (seen or _FACTORS)[-1 if seen else 0]
    figure = NotebookFigure(figsize=(6.5, 4.4), layout="constrained")
    axes = figure.subplots()
    style(axes)
    for place, sizes, directions in zip(centres, half_axes, vectors, strict=True):
        angle = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
        size = 2 * factor * sizes[::-1]
        axes.add_patch(Ellipse(place, *size, angle=angle, color=ORANGE, alpha=0.35, lw=0, zorder=1))
    axes.plot(*centres.T, "o-", color=BLUE, ms=5, lw=0.8, label="estimate", zorder=3)
    if truth is not None:
        axes.plot(*flat(np.asarray(truth)).T, "+", color="black", ms=10, label="truth", zorder=4)
    for number, place in enumerate(centres):
        axes.annotate(str(number), place, (0, -14), textcoords="offset points", ha="center", fontsize=8, color=INK)
    unknown = f"; undetermined: {', '.join(map(str, np.nonzero(~known)[0]))}" if not known.all() else ""
    axes.set_title(f"Camera centres from above, ellipses of {factor:g} sigma{unknown}", loc="left", fontsize=10)
    axes.set(xlabel="to the right of the first camera [m]", ylabel="ahead of it [m]")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.12)
    axes.legend(frameon=False, fontsize=9)
    return figure


@plot.register(Observability)
def _observability(found: Observability) -> NotebookFigure:
    """Draw the balanced eigenvalues (left) and the lost information (right), without each kind of observation.

    The information is that about each common motion and about the free intrinsics.
    """
    figure = NotebookFigure(figsize=(10.0, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[2, 3])
    shown = min(int(np.sum(found.free)), found.whole.values.shape[-1])
    floor = 0.1 * float(np.finfo(found.whole.values.dtype).eps)
    rows = [("all", found.whole.values[0], INK)]
    rows += [(f"without {kind}", found.without.values[k], line_colour(k)) for k, kind in enumerate(found.terms)]
    for name, values, colour in rows:
        line = {"lw": 2.2, "zorder": 3} if name == "all" else {"lw": 1.2}
        left.semilogy(np.maximum(np.asarray(values)[:shown], floor), ".-", ms=4, color=colour, label=name, **line)
    left.axhline(WEAK, color="#c0392b", lw=0.9, ls="--")
    left.annotate("weak below", (shown - 1, WEAK), (0, 3), textcoords="offset points", ha="right", fontsize=8)
    left.set(xlabel="direction, the weakest first", ylabel="eigenvalue, balanced")
    left.set_title("How well it is determined", loc="left", fontsize=10)
    left.legend(frameon=False, fontsize=8)
    shares = lost_shares(found)
    names = [name for name in shares if not name.startswith("keyframe")]
    for k, kind in enumerate(found.terms):
        heights = [100 * shares[name][kind] for name in names]
        right.bar(np.arange(len(names)) + 0.2 * (k - 1.5), heights, 0.2, color=line_colour(k), label=kind)
    right.set_xticks(range(len(names)), [name.replace("translation ", "") for name in names], rotation=30, ha="right")
    right.set_ylabel("information lost [%]")
    right.set_title("Without a kind of observation", loc="left", fontsize=10)
    right.legend(frameon=False, fontsize=8, ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.0))
    right.set_ylim(0, 118)
    right.set_yticks([0, 25, 50, 75, 100])
    for axes in (left, right):
        style(axes)
    return figure
