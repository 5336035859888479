"""The picture of a trajectory: what can be proved of it without looking."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vggtgeo as vg
from vggtgeo.figures import plots
from vggtgeo.figures.plots import BLUE, ORANGE
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError


def _walk(count: int = 40) -> Trajectory:
    """A level walk along x then z, looking ahead, the camera pitched down by 20 degrees; world y points down."""
    half = count // 2
    yaw = np.concatenate([np.full(half, np.pi / 2), np.linspace(np.pi / 2, -0.5, count - half)])
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("YX", np.column_stack([yaw, np.full(count, -0.35)])).as_matrix()
    steps = np.column_stack([np.sin(yaw), np.zeros(count), np.cos(yaw)])
    poses[:, :3, 3] = 0.2 * steps.cumsum(axis=0)
    return Trajectory(np.arange(count) / 30.0, poses)


def _turned(trajectory: Trajectory, seed: int) -> Trajectory:
    frame = np.eye(4)
    frame[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return Trajectory(trajectory.timestamps, frame @ trajectory.poses)


@pytest.mark.parametrize("seed", range(3))
def test_up_is_found_in_any_frame_although_the_camera_looks_down(seed: int) -> None:
    # Proves that the views are level whatever the world frame. Oracle: the walk is level, so it has no height.
    turned = _turned(_walk(), seed)
    view = plots.view_axes(turned)
    np.testing.assert_allclose(view @ view.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view) == pytest.approx(1.0)
    heights = turned.positions @ view[2]
    assert np.ptp(heights) < 0.02 * turned.length, f"a level walk rises by {np.ptp(heights):.3f} m"
    assert (-turned.rotations[:, :, 1] @ view[2] > 0).all(), "up is down"


def test_up_of_a_camera_that_never_turns_is_its_own() -> None:
    # Proves that up is defined where image rows all have one direction. Oracle: the camera's own up direction.
    turned = _turned(_walk().select(slice(0, 15)), 0)
    np.testing.assert_allclose(plots.view_axes(turned)[2], -turned.rotations[0, :, 1], atol=1e-12)


def _level_flight() -> Trajectory:
    """20 m along x with 1 cm of noise in height, the camera pitched down by 20 degrees and never turned; z is up."""
    poses = np.tile(np.eye(4), (100, 1, 1))
    ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    poses[:, :3, :3] = ahead @ Rotation.from_euler("x", -20, degrees=True).as_matrix()
    poses[:, 0, 3] = np.linspace(0, 20, 100)
    poses[:, 2, 3] = np.random.default_rng(0).normal(scale=0.01, size=100)
    return Trajectory(np.arange(100) / 10, poses)


@pytest.mark.parametrize("with_truth", [False, True])
def test_a_level_flight_is_drawn_level_or_the_picture_says_whose_up_it_has(with_truth: bool) -> None:
    # Proves that a camera that looks down and never turns does not make its truth climb, that both views have one
    # scale, and that without a truth, where nothing tells, the side view says so. Oracle: the flight, which is level.
    flight = _level_flight()
    figure = plots.trajectory_figure(flight, flight if with_truth else None)
    top, side = figure.axes
    figure.canvas.draw()
    scales = [axes.get_window_extent().height / np.ptp(axes.get_ylim()) for axes in (top, side)]
    assert scales[0] == pytest.approx(scales[1], rel=0.01)
    assert np.ptp(side.get_ylim()) >= 0.15 * np.ptp(side.get_xlim())
    heights = side.lines[0].get_ydata()
    if with_truth:
        assert np.ptp(heights) < 0.1, f"a level flight rises by {np.ptp(heights):.2f} m"
    assert ("up is the mean up of the images" in side.get_title(loc="left")) != with_truth
    turning = plots.trajectory_figure(_walk())
    assert turning.axes[1].get_title(loc="left") == "seen from the side"


@pytest.mark.parametrize("with_truth", [False, True])
@pytest.mark.parametrize("count", [1, 2, 40])
def test_a_picture_is_written(tmp_path: Path, count: int, with_truth: bool) -> None:
    # Proves that short and long trajectories, with and without truth, give a readable PNG with the colours of what
    # must be seen. Oracle: the decoded picture.
    walk = _walk()
    estimate = walk.select(slice(0, count))
    bent = walk.poses.copy()
    bent[:, 0, 3] += 0.2 * np.sin(walk.timestamps * 5.0)
    truth = _turned(Trajectory(walk.timestamps, bent), 0) if with_truth else None
    figure = plots.trajectory_figure(estimate, truth, estimate, title="a walk")
    figure.savefig(tmp_path / "trajectory.png", dpi=130, facecolor="white")
    image = cv2.imread(str(tmp_path / "trajectory.png"))
    assert image is not None
    assert min(image.shape[:2]) > 300
    if count == 40:
        assert _has(image, BLUE)
        assert _has(image, ORANGE) or not with_truth


def test_truth_without_common_times_is_left_out() -> None:
    # Proves that a truth that does not match costs the truth, not the picture.
    walk = _walk()
    figure = plots.trajectory_figure(walk, Trajectory(walk.timestamps + 100.0, walk.poses))
    assert "truth" not in [line.get_label() for line in figure.axes[0].lines]


def test_the_title_tells_the_error() -> None:
    # Proves that the title has the ATE of the alignment it names. Oracle: a truth moved rigidly, and one scaled.
    walk = _walk()
    for with_scale, name in ((False, "SE(3)"), (True, "Sim(3)")):
        figure = plots.trajectory_figure(walk, _turned(walk, 1), with_scale=with_scale, title="clip")
        assert figure.get_suptitle() == f"clip:  ATE 0.00 cm after {name} (40 poses)"


def _has(image: np.ndarray, colour: str) -> bool:
    wanted = [int(colour[k : k + 2], 16) for k in (5, 3, 1)]
    return bool((np.abs(image.astype(int) - wanted).max(axis=2) < 25).sum() > 100)


def test_plot_draws_by_the_kind_of_the_value() -> None:
    # Proves that one function draws a trajectory as its own figure does, and says what it can draw of what it cannot.
    # Oracle: the titles and the lines of the figure made directly.
    walk = _walk()
    drawn, direct = vg.plot(walk, walk), plots.trajectory_figure(walk, walk)
    assert isinstance(drawn, plots.NotebookFigure)
    assert drawn._repr_png_()[1:4] == b"PNG"
    for mine, other in zip(drawn.axes, direct.axes, strict=True):
        for line, same in zip(mine.lines, other.lines, strict=True):
            np.testing.assert_array_equal(line.get_xydata(), same.get_xydata())
    with pytest.raises(InputError, match=r"`value` .*Observability, .*Solution.*`list`"):
        vg.plot([1.0])
