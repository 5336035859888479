"""Recordings for the Rerun viewer: what is in them, read back, and that nobody pays who does not ask."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import sysconfig
import time
import urllib.request
import warnings
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock
from urllib.parse import unquote

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_suites
from conftest import ROOT
from recorded_run import RecordedRun, recorded_run
from typer.testing import CliRunner
from vggtgeo.solvers.levenberg_marquardt import IterationRecord

from vggtgeo.benchmark.page import write_page
from vggtgeo.benchmark.worker import recorded
from vggtgeo.cli.main import make_app
from vggtgeo.geometry import rigid
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.mapping.dense import dense_depths
from vggtgeo.results.files import write_depth, write_settings, write_trajectories
from vggtgeo.slam.state import Slam
from vggtgeo.viewing.folder import _log_depth
from vggtgeo.viewing.target import check_target, has_screen


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


def iterations_of(slam: Slam) -> IterationRecord | None:
    """A record as the solver makes it (tests/test_solve.py): the cameras go to their places along a line."""
    if slam.solved is None or slam.energies is None:
        return None
    ends = [np.asarray(state.poses.wxyz_xyz) for state in (slam.solved[0].initial, slam.solved[1])]
    rows = np.linspace(0, 1, len(slam.energies))
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
        callback.on_frame(replace(slam, iterations=iterations_of(slam)), run.frames[slam.frames[-1].frame])
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
    """Each listed entity is in the file, on the timeline it belongs to; oracle: rerun's own reader."""
    from vggtgeo.viewing.entities import ENTITIES

    found = entities_of(recording)
    assert set(ENTITIES) - set(found) == set()
    for path in ("/world/camera", "/world/trajectory", "/keyframe/image/matches", "/plots/residuals/points"):
        assert {"frame", "time"} <= found[path], path
    for path in ("/plots/solver/energy", "/plots/convergence/step", "/world/iteration", "/world/covariance"):
        assert "iteration" in found[path], path


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
    depths = dense_depths(run.slam.keyframes, run.slam.intrinsics)
    run.cloud.save_ply(tmp_path / "map.ply")
    write_depth(tmp_path, run.slam.keyframes, depths)
    result = CliRunner().invoke(make_app(), ["view", str(tmp_path), "--rerun", str(tmp_path / "out" / "v.rrd")])
    assert result.exit_code == 0, result.output
    found = entities_of(tmp_path / "out" / "v.rrd")
    assert {"/world/trajectory", "/world/map", "/keyframe/depth", "/keyframe/confidence"} <= set(found)


@pytest.mark.parametrize(
    ("name", "image", "message"),
    [
        ("first.depth.png", np.zeros((4, 4), np.uint16), "is no depth of a run: expected the number of a frame"),
        ("000001.depth.png", np.zeros((4, 4, 3), np.uint8), r"is uint8 \(4, 4, 3\); expected uint16"),
    ],
)
def test_depth_that_no_run_wrote_is_named(name: str, image: np.ndarray, message: str, tmp_path: Path) -> None:
    """Oracle: the error."""
    cv2.imwrite(str(tmp_path / name), image)
    with pytest.raises(InputError, match=message):
        _log_depth(MagicMock(), tmp_path / name)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("view", "nowhere", "--rerun", "a.rrd"), "`nowhere` is no folder"),
        (("view", ".", "--rerun", "a.rrd"), "has no `trajectory.txt`"),
        (("view", ".", "--rerun", "spawn"), "has no `trajectory.txt`"),
        (("view", ".", "--rerun", "picture.png"), "it must be `spawn`"),
        (("run", "nowhere", "--rerun", "show"), "it must be `spawn`"),
    ],
)
def test_what_is_wrong_is_said_first(
    arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wrong folder or target ends with code 2 and a line that names it, and leaves no file behind."""
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(make_app(), list(arguments))
    assert result.exit_code == 2, result.stderr
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_target_is_checked() -> None:
    """The three kinds of target pass, others are refused."""
    assert [check_target(target) for target in ("spawn", "serve", "a/b.rrd")] == ["spawn", "serve", "a/b.rrd"]
    with pytest.raises(InputError, match=r"ending with `\.rrd`"):
        check_target("a.rrd.txt")


def test_a_machine_without_a_screen_gets_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`spawn` without a display warns in one line that names the file, and the file holds what was logged; oracle:
    rerun's own reader.
    """
    import rerun as rr

    from vggtgeo.viewing.target import flush, open_target

    monkeypatch.setattr("vggtgeo.viewing.target.has_screen", lambda: False)
    path = tmp_path / "runs" / "run.rrd"
    with pytest.warns(InputWarning, match=r"there is no screen, so the recording goes to `.*run\.rrd`"):
        opened = open_target("spawn", "test", path)
    opened.stream.log("notes", rr.TextLog("here"))
    flush(opened.stream)
    opened.stream.disconnect()
    assert "/notes" in entities_of(path)


@pytest.mark.parametrize(("name", "expected"), [("DISPLAY", True), ("WAYLAND_DISPLAY", True), ("SHELL", False)])
def test_a_screen_is_known_by_the_environment(name: str, expected: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """X11 and Wayland are seen, another variable is no screen."""
    monkeypatch.setattr(sys, "platform", "linux")
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv(name, ":0")
    assert has_screen() is expected


def test_a_viewer_that_closes_at_once_gives_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a window does not open in spite of a screen, the file is written all the same."""
    from vggtgeo.viewing import target

    monkeypatch.setattr(target, "has_screen", lambda: True)
    monkeypatch.setattr(target, "_start_viewer", lambda stream: "the viewer closed at once")
    with pytest.warns(InputWarning, match="the viewer closed at once, so the recording goes to"):
        opened = target.open_target("spawn", "test", tmp_path / "run.rrd")
    opened.stream.disconnect()
    assert (tmp_path / "run.rrd").is_file()


def test_view_names_the_recording_where_there_is_no_screen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder with a recording is not recorded again: the message says what to open."""
    monkeypatch.setattr("vggtgeo.viewing.target.has_screen", lambda: False)
    (tmp_path / "run.rrd").write_bytes(b"")
    result = CliRunner().invoke(make_app(), ["view", str(tmp_path)])
    assert result.exit_code == 2
    assert "look at it with `rerun" in result.stderr


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        (None, None),
        ("serve", None),
        ("spawn", "run.rrd"),
        ("runs/x/kept.rrd", "kept.rrd"),
        ("runs/x/gone.rrd", None),
        ("killed", "view.rrd"),
    ],
)
def test_the_recording_of_an_earlier_run_is_not_shown(tmp_path: Path, target: str | None, expected: str | None) -> None:
    """Of the recordings in a folder, `view` takes the one that the folder's settings name, and none that another run
    or `view` left; without settings, as after a kill, the newest. Oracle: what was put there.
    """
    from vggtgeo.viewing.folder import recording_of

    for age, name in enumerate(("view.rrd", "run.rrd", "kept.rrd")):
        (tmp_path / name).write_bytes(b"")
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    if target != "killed":
        write_settings(tmp_path / "settings.toml", {"path": "clip.mp4", "rerun": target})
    found = recording_of(tmp_path)
    assert (found and found.name) == expected


SERVE = """
import sys, rerun as rr
from vggtgeo.viewing.target import flush, open_target
opened = open_target("serve", "test", None)
opened.stream.log("notes", rr.TextLog("served"))
flush(opened.stream)
print(opened.url, flush=True)
sys.stdin.read()
"""


def test_a_served_recording_can_be_had(tmp_path: Path) -> None:
    """The address that is printed gives Rerun's page, and the source it names gives the recording; oracle: HTTP on the
    loopback, and rerun's own program as the client.
    """
    viewer = Path(sysconfig.get_path("scripts")) / "rerun"
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", SERVE], cwd=ROOT, stdin=pipe, stdout=pipe, text=True) as server:
        try:
            assert server.stdout is not None
            url = server.stdout.readline().strip()
            assert url.startswith("http://localhost:"), url
            page, source = url.split("?url=")
            with urllib.request.urlopen(page, timeout=20) as answer:
                assert b"rerun" in answer.read().lower()
            saved = tmp_path / "got.rrd"
            command = [viewer, unquote(source), "--port", "auto", "--save", saved]
            with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as client:
                try:
                    assert arrives(saved, "/notes")
                finally:
                    client.kill()
        finally:
            server.communicate("", timeout=20)


def arrives(file: Path, entity: str, patience: float = 30.0) -> bool:
    """Whether the recording `file`, which is being written, comes to hold `entity`."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        time.sleep(0.2)
        with contextlib.suppress(OSError, ValueError, RuntimeError), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a file without its end
            if entity in entities_of(file):
                return True
    return False


def test_a_port_in_use_is_gone_round() -> None:
    """A second served run takes a free port."""
    from vggtgeo.viewing.target import _port

    with socket.socket() as taken:
        taken.bind(("", 0))
        taken.listen()
        usual = taken.getsockname()[1]
        assert _port(usual) not in (0, usual)
    assert _port(usual) == usual


def test_without_the_flag_rerun_is_not_imported(tmp_path: Path) -> None:
    """Neither the package nor a run's own code imports rerun; oracle: `sys.modules` of a new process."""
    script = "import sys, vggtgeo.cli.run_sequence, vggtgeo.report, vggtgeo.cli.view; print('rerun' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
