"""Recordings for the Rerun viewer: what is in them, read back, and that nobody pays who does not ask."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from recorded_run import RecordedRun, recorded_run
from typer.testing import CliRunner

from vggtgeo.cli.main import make_app
from vggtgeo.errors import InputError
from vggtgeo.slam import rigid
from vggtgeo.slam.outputs import write_depth, write_map, write_trajectories
from vggtgeo.viewing.target import check_target


@pytest.fixture(scope="module")
def run() -> RecordedRun:
    return recorded_run()


def entities_of(path: Path) -> dict[str, set[str]]:
    """Paths in the recording `path`, each with the timelines it is logged on; read by rerun itself."""
    import rerun as rr

    found: dict[str, set[str]] = {}
    for chunk in rr.chunk.RrdReader(path).stream():
        found.setdefault(str(chunk.entity_path), set()).update(chunk.timeline_names)
    return found


@pytest.fixture(scope="module")
def recording(run: RecordedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recorded run, logged frame by frame as the program does it."""
    from vggtgeo.viewing.target import open_target
    from vggtgeo.viewing.watcher import RerunWatcher

    path = tmp_path_factory.mktemp("recording") / "deep" / "run.rrd"
    stream = open_target(str(path), "test")
    watcher = RerunWatcher(stream)
    for slam in run.states:
        watcher.see(slam, run.frames[slam.frames[-1].frame])
    watcher.finish(run.slam, run.cloud)
    stream.disconnect()
    return path


def test_the_recording_holds_every_entity(recording: Path) -> None:
    """Each listed entity is in the file, on the timeline it belongs to; oracle: rerun's own reader."""
    from vggtgeo.viewing.entities import ENTITIES

    found = entities_of(recording)
    assert set(ENTITIES) - set(found) == set()
    for path in ("/world/camera", "/world/trajectory", "/keyframe/image/matches", "/plots/residuals/points"):
        assert {"frame", "time"} <= found[path], path
    assert "iteration" in found["/plots/solver/energy"]


def test_the_blueprint_shows_what_is_logged(recording: Path) -> None:
    """Every view's origin holds something, and the file carries the arrangement; oracle: the entities, the reader."""
    import rerun as rr

    from vggtgeo.viewing.blueprint import ORIGINS, blueprint
    from vggtgeo.viewing.entities import ENTITIES

    assert [origin for origin in ORIGINS if not any(path.startswith(origin) for path in ENTITIES)] == []
    assert blueprint().root_container is not None
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
    write_map(tmp_path, run.slam)
    write_depth(tmp_path, run.slam)
    result = CliRunner().invoke(make_app(), ["view", str(tmp_path), "--rerun", str(tmp_path / "out" / "v.rrd")])
    assert result.exit_code == 0, result.output
    found = entities_of(tmp_path / "out" / "v.rrd")
    assert {"/world/trajectory", "/world/map", "/keyframe/depth", "/keyframe/confidence"} <= set(found)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("view", "nowhere", "--rerun", "a.rrd"), "`nowhere` is no folder"),
        (("view", ".", "--rerun", "a.rrd"), "has no `trajectory.txt`"),
        (("view", ".", "--rerun", "picture.png"), "it must be `spawn`"),
        (("run", "nowhere", "--rerun", "show"), "it must be `spawn`"),
    ],
)
def test_what_is_wrong_is_said_first(
    arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wrong folder or target ends with code 2 and a line that names it."""
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(make_app(), list(arguments))
    assert result.exit_code == 2, result.stderr
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_a_target_is_checked() -> None:
    """The three kinds of target pass, others are refused."""
    assert [check_target(target) for target in ("spawn", "serve", "a/b.rrd")] == ["spawn", "serve", "a/b.rrd"]
    with pytest.raises(InputError, match=r"ending with `\.rrd`"):
        check_target("a.rrd.txt")


def test_without_the_flag_rerun_is_not_imported(tmp_path: Path) -> None:
    """Neither the package nor a run's own code imports rerun; oracle: `sys.modules` of a new process."""
    script = "import sys, vggtgeo.cli.run_sequence, vggtgeo.report, vggtgeo.cli.view; print('rerun' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
