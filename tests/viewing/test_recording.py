"""Recordings for the Rerun viewer: what is in them, read back."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import tiny_suites
from conftest import ROOT
from recorded_run import RecordedRun
from rrd_files import components_of, entities_of
from typer.testing import CliRunner
from vggtgeo.solvers.levenberg_marquardt import IterationRecord

from vggtgeo.benchmark.report import write_page
from vggtgeo.benchmark.worker import recording as recorded
from vggtgeo.cli.main import make_app
from vggtgeo.geometry import rigid
from vggtgeo.mapping.dense import dense_depths
from vggtgeo.results.files import write_depth, write_trajectories
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.state import Slam


def iterations_of(slam: Slam) -> IterationRecord | None:
    """A record as the solver makes it (tests/bundle/test_solve.py): the cameras go to their places along a line."""
    if slam.window.solved is None or slam.window.energies is None:
        return None
    ends = [np.asarray(state.poses.wxyz_xyz) for state in (slam.window.solved[0].initial, slam.window.solved[1])]
    rows = np.linspace(0, 1, len(slam.window.energies))
    moved = np.stack([(1 - share) * ends[0] + share * ends[1] for share in rows])
    return IterationRecord(*(jnp.asarray(column) for column in (1e-3 * rows, rows, 1 + rows, moved)))


@pytest.fixture(scope="module")
def recording(run: RecordedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recorded run, logged frame by frame as the program does it."""
    from vggtgeo.viewing.callback import RerunCallback
    from vggtgeo.viewing.target import open_target

    path = tmp_path_factory.mktemp("recording") / "deep" / "run.rrd"
    stream = open_target(str(path), "test", path).stream
    callback = RerunCallback(stream)
    for slam in run.states:
        callback.on_frame(
            replace(slam, window=replace(slam.window, iterations=iterations_of(slam))),
            run.frames[slam.frames[-1].frame],
        )
    callback.on_finish(run.slam, run.cloud)
    stream.disconnect()
    return path


def test_a_run_of_a_batch_leaves_its_recording_where_one_is_asked_for(run: RecordedRun, tmp_path: Path) -> None:
    """Beside what the result writes, which takes older recordings away, and only where asked for; the page of the
    batch links to it. Oracle: rerun's own reader.
    """
    place = tmp_path / "runs/walk.full.0"
    place.mkdir(parents=True)
    with recorded(place, False) as callbacks:
        assert callbacks == ()
    text = tiny_suites.TEXT.replace("seeds = 3", "recordings = true")
    assert [job.spec["recordings"] for job in (tiny_suites.jobs(text)[0], tiny_suites.jobs()[0])] == [True, False]
    with recorded(place, True) as callbacks:
        for slam in run.states:
            callbacks[0].on_frame(slam, run.frames[slam.frames[-1].frame])
        callbacks[0].on_finish(run.slam, run.cloud)
        assert not list(place.iterdir())
    assert "/world/trajectory" in entities_of(place / "run.rrd")
    row = {"suite": "tiny", "sequence": "walk", "setting": "full", "seed": 0, "status": "ok", "protocol": "every-frame"}
    write_page(tmp_path / "report.html", tiny_suites.suite(text), [row], tmp_path)
    assert '<a href="runs/walk.full.0/run.rrd">recording</a>' in (tmp_path / "report.html").read_text()


def test_the_recording_holds_every_entity(recording: Path) -> None:
    """Each entity of the page on views is in the file, on its timeline; oracle: the page, rerun's own reader."""
    found = entities_of(recording)
    rows = [line for line in (ROOT / "docs/guides/views.md").read_text().splitlines() if line.startswith("| `")]
    listed = re.findall(r"`((?:world|window|keyframe|plots)/\w+|notes)`", "\n".join(rows))
    assert len(listed) > 15
    assert [path for path in listed if not any(entity.startswith(f"/{path}") for entity in found)] == []
    for path in ("/world/camera", "/world/trajectory", "/keyframe/image/matches", "/plots/residuals/points"):
        assert {"frame", "time"} <= found[path], path
    for path in ("/plots/solver/energy", "/plots/convergence/step", "/world/iteration", "/world/covariance"):
        assert "iteration" in found[path], path


def logged(states: Sequence[Slam], path: Path) -> Path:
    """A recording of what `RerunCallback` shows of the map in these states, state n at frame n."""
    from vggtgeo.viewing.callback import LiveMap
    from vggtgeo.viewing.entities import Entities
    from vggtgeo.viewing.target import open_target

    stream = open_target(str(path), "test", path).stream
    entities = Entities(stream)
    live = LiveMap(entities)
    for number, slam in enumerate(states):
        stream.set_time("frame", sequence=number)
        live.update(slam)
        entities.loops(slam, apart=2)
        entities.lost(slam)
    stream.disconnect()
    return path


def moved(slam: Slam, number: int, along: tuple[float, float, float]) -> Slam:
    """The state with one keyframe's camera moved `along` in the world, metres."""
    keyframe = slam.keyframes[number]
    to_world = rigid.invert(keyframe.pose)
    to_world[:3, 3] += along
    changed = replace(keyframe, pose=rigid.invert(to_world))
    return replace(
        slam, map=replace(slam.map, keyframes=(*slam.keyframes[:number], changed, *slam.keyframes[number + 1 :]))
    )


def test_a_keyframe_that_moves_takes_its_cloud_along(run: RecordedRun, tmp_path: Path) -> None:
    """Points are logged once, as the final map has them; a keyframe that is half a metre wrong and then put right has
    its transform logged again, and no other keyframe has. Oracle: the poses, and the true depth's bounds.
    """
    from vggtgeo.viewing.callback import MAX_CLOUDS, MAX_POINTS

    slam = run.slam
    assert 3 <= len(slam.keyframes) <= MAX_CLOUDS
    path = logged([moved(slam, 1, (0.5, 0, 0)), moved(slam, 1, (0.5, 0, 0)), slam], tmp_path / "live.rrd")
    found = [components_of(path, f"/world/live/{k}", "Transform3D:translation") for k in range(3)]
    assert [sorted(one) for one in found] == [[0], [0, 1, 2], [0]]
    wrong, right = (np.array(found[1][frame]).reshape(3) for frame in (0, 2))
    np.testing.assert_allclose(wrong - right, [0.5, 0, 0], atol=1e-6)
    np.testing.assert_allclose(right, rigid.centre(slam.keyframes[1].pose), atol=1e-6)
    clouds = components_of(path, "/world/live/1", "Points3D:positions")
    assert sorted(clouds) == [0]
    points = np.array(clouds[0])
    assert 0.5 * MAX_POINTS < len(points) <= MAX_POINTS
    depth = slam.keyframes[1].depth
    assert np.nanmin(depth) <= points[:, 2].min() <= points[:, 2].max() <= np.nanmax(depth)


def test_the_map_grows_while_the_run_goes_on_and_is_replaced_at_its_end(recording: Path, run: RecordedRun) -> None:
    """Keyframes' clouds come at different frames, and the final map, which a static one would show from the first frame
    on, comes at the last, where they are cleared; oracle: rerun's own reader.
    """
    last = run.slam.frames[-1].frame
    begun = [components_of(recording, f"/world/live/{k.number}", "Points3D:positions") for k in run.slam.keyframes]
    assert len({min(frames) for frames in begun if frames}) > 1
    assert sorted(components_of(recording, "/world/map", "Points3D:positions")) == [last]
    assert sorted(components_of(recording, "/world/live", "Clear:is_recursive")) == [last]


def test_points_without_depth_are_logged_again_when_they_left_the_window(run: RecordedRun, tmp_path: Path) -> None:
    """Of a map of free scale the points are shown; those of a keyframe that were twice as far as they are now are
    logged again once it has left the window, and not before. Oracle: the inverse depths.
    """
    right = replace(run.slam, map=replace(run.slam.map, metric=False), window=replace(run.slam.window, members=(0, 1)))
    points = right.keyframes[0].points
    far = replace(right.keyframes[0], points=replace(points, inverse_depth=points.inverse_depth / 2))
    states = [
        replace(right, map=replace(right.map, keyframes=(far, *right.keyframes[1:]))),
        right,
        replace(right, window=replace(right.window, members=(1,))),
    ]
    found = components_of(logged(states, tmp_path / "free.rrd"), "/world/live/0", "Points3D:positions")
    assert sorted(found) == [0, 2]
    np.testing.assert_allclose(np.array(found[0]), 2 * np.array(found[2]), rtol=1e-5)


def test_loops_and_lost_frames_are_shown(run: RecordedRun, tmp_path: Path) -> None:
    """A map without a loop gets one, and frames that had a pose lose it: each is drawn from then on, between the places
    by hand; a submap that nothing joins has a path of its own and no line to it. Oracle: the poses.
    """
    slam = replace(run.slam, map=replace(run.slam.map, factors=(), pairs=()))
    first, second = slam.keyframes[0], slam.keyframes[2]
    loop = replace(
        slam,
        map=replace(slam.map, factors=(MeasuredRelativePose(0, 2, second.pose @ rigid.invert(first.pose), np.eye(6)),)),
    )
    lost = [replace(record, tracked=record.frame not in (3, 4)) for record in run.slam.frames]
    states = [
        slam,
        loop,
        replace(run.slam, tracker=replace(run.slam.tracker, frames=tuple(lost))),
        replace(slam, tracker=replace(slam.tracker, frames=tuple(lost))),
    ]
    path = logged(states, tmp_path / "lost.rrd")
    ends = [rigid.centre(keyframe.pose) for keyframe in (first, second)]
    strips = components_of(path, "/world/loops", "LineStrips3D:strips")
    assert strips[0] == []
    np.testing.assert_allclose(np.array(strips[1]), [ends], atol=1e-6)
    gaps = components_of(path, "/world/lost", "LineStrips3D:strips")
    assert gaps[0] == gaps[3] == []
    around = [rigid.centre(slam.pose(slam.frames[row])) for row in (2, 5)]
    np.testing.assert_allclose(np.array(gaps[2]), [around], atol=1e-6)
    begun = components_of(path, "/world/lost/begun", "Points3D:positions")
    np.testing.assert_allclose(np.array(begun[3]), around[:1], atol=1e-6)
    unjoined = components_of(path, "/world/unjoined", "LineStrips3D:strips")
    assert unjoined[2] == []
    assert len(unjoined[3]) == len(slam.keyframes) - 1


def test_the_blueprint_shows_what_is_logged(recording: Path) -> None:
    """Every view's origin holds something, and the file carries the arrangement; oracle: rerun's own reader."""
    import rerun as rr
    import rerun.blueprint as rrb

    from vggtgeo.viewing.target import blueprint

    containers, views = [blueprint().root_container], []
    while containers:
        for part in containers.pop().contents:
            (containers if isinstance(part, rrb.Container) else views).append(part)
    assert len(views) > 8
    found = entities_of(recording)
    assert [view.origin for view in views if not any(path.startswith(view.origin) for path in found)] == []
    assert len(rr.chunk.RrdReader(recording).blueprints()) >= 1


def test_ellipsoids_have_the_axes_of_the_covariance() -> None:
    """A camera that is unsure along its own optical axis, turned, has an ellipsoid along that axis in the world, as
    long as said; oracle: the axis by hand.
    """
    import rerun as rr

    from vggtgeo.viewing.entities import SIGMAS, ellipsoid

    turn = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # the camera looks along the world's x
    pose = rigid.invert(np.block([[turn.T, np.array([[3.0], [0], [0]])], [np.zeros((1, 3)), np.ones((1, 1))]]))
    covariance = np.diag([1e-6, 1e-6, 1e-4, 0, 0, 0])
    centre, half_sizes, quaternion = ellipsoid(pose, covariance)
    rotation = rigid.to_matrix(np.concatenate([np.roll(quaternion, 1), np.zeros(3)])[None])[0, :3, :3]
    longest = rotation[:, np.argmax(half_sizes)]
    np.testing.assert_allclose(np.abs(longest), [1, 0, 0], atol=1e-9)
    assert max(half_sizes) == pytest.approx(SIGMAS * 1e-2)
    np.testing.assert_allclose(centre, [3, 0, 0], atol=1e-12)
    assert rr.Ellipsoids3D(centers=[centre], half_sizes=[half_sizes], quaternions=[quaternion]) is not None


def test_a_run_folder_becomes_a_recording(run: RecordedRun, tmp_path: Path) -> None:
    """`vggtgeo view` writes a file with path, map, depth and confidence; oracle: rerun's own reader."""
    write_trajectories(tmp_path, run.slam)
    depths = dense_depths(run.slam.keyframes, run.slam.intrinsics)
    run.cloud.save_ply(tmp_path / "map.ply")
    write_depth(tmp_path, zip([keyframe.frame for keyframe in run.slam.keyframes], depths, strict=True))
    result = CliRunner().invoke(make_app(), ["view", str(tmp_path), "--rerun", str(tmp_path / "out" / "v.rrd")])
    assert result.exit_code == 0, result.output
    found = entities_of(tmp_path / "out" / "v.rrd")
    assert {"/world/trajectory", "/world/map", "/keyframe/depth", "/keyframe/confidence"} <= set(found)
