"""`vg.reconstruct`: one call for a whole run, the same that the command line makes."""

from __future__ import annotations

import json
import shutil
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from recorded_run import SETTINGS
from reported import raises, warns
from typer.testing import CliRunner

import vggtgeo as vg
from vggtgeo.cli.main import make_app
from vggtgeo.io.errors import LeftOutWarning
from vggtgeo.results.output_checks import EXPORTS
from vggtgeo.results.source import Source, open_source, with_pose_prior
from vggtgeo.simulation.sequence import write_tum_folder
from vggtgeo.slam.settings.table import changed

pytestmark = pytest.mark.usefixtures("uncompiled")
FRAMES = 5
TABLES = changed(SETTINGS)
DATA = ("keyframes.txt", "map.ply", "trajectory.txt")


class _Log(vg.Callback):
    """The names of the hooks, in the order of their calls; Ctrl-C is pressed at the call `stop_at`."""

    def __init__(self, stop_at: str = "") -> None:
        self.calls: list[str] = []
        self._stop_at = stop_at

    def _note(self, call: str) -> None:
        self.calls.append(call)
        if call == self._stop_at:
            raise KeyboardInterrupt

    def on_begin(self, name: str, total: int | None) -> None:
        self._note(f"begin {name} {total}")

    def on_frame(self, slam: object, frame: vg.data.Frame) -> None:
        self._note(f"frame {frame.index}")

    def on_adjust(self, slam: object) -> None:
        self._note("adjust")

    def on_message(self, message: str) -> None:
        self._note(message)

    def on_finish(self, slam: object, cloud: object) -> None:
        self._note("finish")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated TUM folder."""
    place = tmp_path_factory.mktemp("data") / "room"
    for _ in write_tum_folder(vg.simulate("room", FRAMES, 0, (160, 120), rate=10.0), place):
        pass
    return place


@pytest.mark.long
def test_the_notebook_and_the_command_line_write_the_same_folder(folder: Path, tmp_path: Path) -> None:
    """The same names, the same bytes of the data files, the same summary but for times and flags; oracle: the folder of
    `vggtgeo run` on the same frames with the same settings.
    """
    program, notebook = tmp_path / "program", tmp_path / "notebook"
    assignments = [
        f"--set={group}.{name}={json.dumps(value)}"
        for group, values in TABLES.items()
        for name, value in values.items()
    ]
    arguments = ["run", str(folder), "-o", str(program), "--save-depth", "--quiet", *assignments]
    done = CliRunner().invoke(make_app(), arguments)
    assert done.exit_code == 0, done.output
    result = vg.reconstruct(folder, settings=SETTINGS)
    assert len(result.keyframes) > 1
    result.save(notebook, depth=True)
    names = [sorted(str(file.relative_to(place)) for file in place.rglob("*")) for place in (program, notebook)]
    assert names[0] == names[1]
    assert {"report.html", "settings.toml", "summary.json", "trajectory.png", *DATA} < set(names[0])
    for name in (*DATA, *(name for name in names[0] if name.endswith(".png") and name.startswith("depth/"))):
        assert (program / name).read_bytes() == (notebook / name).read_bytes(), name
    for place in (program, notebook):
        written = tomllib.loads((place / "settings.toml").read_text())
        assert {group: written[group] for group in TABLES} == TABLES
    first, second = (json.loads((place / "summary.json").read_text()) for place in (program, notebook))
    assert first.keys() == second.keys()
    assert first["frames_per_second_whole_run"] < first["frames_per_second"]
    for changing in (
        "settings",
        "seconds_by_stage",
        "frames_per_second",
        "frames_per_second_whole_run",
        "peak_memory_gb",
    ):
        del first[changing], second[changing]
    assert first == second
    again, exported = tmp_path / "again", tmp_path / "again" / EXPORTS / "mine.txt"
    shutil.copytree(program, again)
    exported.parent.mkdir()
    exported.write_text("kept")
    done = CliRunner().invoke(
        make_app(), ["run", "--settings", str(program / "settings.toml"), "-o", str(again), "--no-quiet"]
    )
    assert done.exit_code == 0, done.output
    assert done.stdout.strip().splitlines()[-1].startswith(f"verdict: {result.verdict.level}")
    # An earlier result is replaced, exports of it stay, and both are said.
    assert exported.read_text() == "kept"
    assert all(f"`{place}`" in done.stdout for place in (again, exported.parent))
    assert (again / "trajectory.txt").read_bytes() == (program / "trajectory.txt").read_bytes()
    written = [tomllib.loads((place / "settings.toml").read_text()) for place in (program, again)]
    assert written[1] == {**written[0], "output": str(again), "quiet": False}


@pytest.mark.long
def test_a_saved_result_is_read_again(folder: Path, tmp_path: Path) -> None:
    """Load and save bring back poses, map, verdict and summary; oracle: the result in memory, and what it wrote."""
    result = vg.reconstruct(folder, options=vg.RunOptions(end=2))
    summary = result.save(tmp_path / "one")
    assert summary["seconds_by_stage"]["all"] > result.summary["seconds_by_stage"]["all"]
    assert {**summary, "seconds_by_stage": {}} == {
        **result.summary,
        "seconds_by_stage": {},
        "frames_per_second_whole_run": summary["frames_per_second_whole_run"],
    }
    again = vg.read(tmp_path / "one")
    assert isinstance(again, vg.Result)
    assert again.record is None
    np.testing.assert_allclose(again.trajectory.poses, result.trajectory.poses, atol=1e-8)
    assert again.summary == json.loads(json.dumps(summary))
    assert again.verdict == result.verdict
    again.save(tmp_path / "two")
    assert (tmp_path / "two/map.ply").read_bytes() == (tmp_path / "one/map.ply").read_bytes()
    assert vg.read(tmp_path / "two").summary == again.summary
    assert not (tmp_path / "two/report.html").exists()
    with raises("`depth`"):
        again.save(tmp_path / "two", depth=True)


def test_frames_are_tracked_while_windows_compile() -> None:
    # Proves that the first frame does not wait for `on_warm_up`, whose error still ends the run.
    seen = Event()

    class Compiles(vg.Callback):
        def on_warm_up(self) -> None:  # type: ignore[override]
            raise RuntimeError("compiled too late" if seen.wait(30.0) else "compiled before the first frame")

        def on_frame(self, slam: object, frame: vg.data.Frame) -> None:
            seen.set()

    with pytest.raises(RuntimeError, match="too late"):
        vg.reconstruct(vg.simulate("room", 2, size=(160, 120)), settings=SETTINGS, callbacks=[Compiles()])


def test_any_iterable_of_frames_will_do() -> None:
    """A list of (image, depth) with its camera gives the poses of the sequence; oracle: the run over the sequence."""
    sequence = vg.simulate("room", 3, 0, (160, 120))
    pairs = [(frame.image, frame.depth) for frame in sequence.frames()]
    log = _Log()
    found = vg.reconstruct(
        iter(pairs), settings=SETTINGS, camera=sequence.camera, callbacks=[log], options=vg.RunOptions(title="a list")
    )
    expected = vg.reconstruct(sequence, settings=SETTINGS)
    np.testing.assert_array_equal(found.trajectory.poses, expected.trajectory.poses)
    assert log.calls == ["begin frames None", "frame 0", "frame 1", "frame 2", "adjust", "finish"]
    assert found.record.title == "a list"
    assert found.record.truth is None
    assert expected.record.truth is not None
    with raises("`frames`"):
        vg.reconstruct([])


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("start", {"start": -1}),
        ("end", {"start": 3, "end": 3}),
        ("stride", {"stride": 0}),
        ("seed", {"seed": -1}),
        ("dense", {"dense": "stereo"}),
        ("facts", {"facts": {"error": np.nan}}),
        ("warned", {"warned": "one text"}),
    ],
)
def test_invalid_options_are_refused_when_they_are_made(name: str, given: dict[str, object]) -> None:
    """Each invalid option is an `InputError` that names it, before a frame is read; oracle: the name."""
    with raises(f"`{name}`"):
        vg.RunOptions(**given)


def test_a_clock_that_stands_costs_the_frame_and_not_the_run() -> None:
    """Of frames of one time the first is used and the others are counted; the trajectory, which has a pose for a time,
    is there at the end, and the verdict knows what was left out. Oracle: the run over the other frames.
    """
    sequence = vg.simulate("room", 4, 0, (160, 120))
    given = list(sequence.frames())
    stuck = [*given[:2], replace(given[2], timestamp=given[1].timestamp), given[3]]
    with warns("`room-00002`", warning=LeftOutWarning):
        found = vg.reconstruct(stuck, camera=sequence.camera, settings=SETTINGS)
    expected = vg.reconstruct([*given[:2], given[3]], camera=sequence.camera, settings=SETTINGS)
    np.testing.assert_array_equal(found.trajectory.timestamps, expected.trajectory.timestamps)
    np.testing.assert_array_equal(found.trajectory.poses, expected.trajectory.poses)
    assert any("1 of 4 frames" in reason for reason in map(str, found.verdict.reasons)), found.verdict.reasons


@pytest.mark.parametrize("stop_at", ["frame 1", "finish of the map"])
def test_the_stop_button_keeps_what_there_is(monkeypatch: pytest.MonkeyPatch, stop_at: str) -> None:
    """Ctrl-C at a frame ends the run with the frames so far, Ctrl-C in the last adjustment with all of them, and both
    say so; oracle: a count, and the whole run.
    """

    def stopped(*_: object) -> Iterator[object]:
        raise KeyboardInterrupt

    if stop_at.startswith("finish"):
        monkeypatch.setattr("vggtgeo.results.reconstruction.finish", stopped)
    log = _Log(stop_at)
    result = vg.reconstruct(vg.simulate("room", 4, 0, (160, 120)), settings=SETTINGS, callbacks=[log])
    assert result.summary["interrupted"] is True
    assert result.summary["frames"] == len(result.trajectory) == (2 if stop_at == "frame 1" else 4)
    assert any(call.startswith("interrupted: keeping") for call in log.calls)
    assert log.calls[-1] == "finish"


@pytest.fixture(scope="module")
def source() -> Source:
    return open_source(vg.simulate("room", 3, size=(160, 120)), None, SETTINGS)


def test_recorded_poses_are_prior_or_truth(source: Source, tmp_path: Path) -> None:
    """Those that the reader knows become the prior, and the run has no truth; without a prior they stay the truth, and
    beside a file of poses, which is read as a trajectory is.
    """
    same, nothing = with_pose_prior(source, None)
    assert same is source
    assert nothing is None
    hidden, recorded = with_pose_prior(source, "recorded")
    assert hidden.truth is None
    assert recorded is not None
    assert source.truth is not None
    np.testing.assert_array_equal(recorded.trajectory.poses, source.truth.poses)
    source.truth.save_tum(tmp_path / "odometry.txt")
    same, recorded = with_pose_prior(source, tmp_path / "odometry.txt")
    assert same.truth is source.truth
    assert recorded is not None
    np.testing.assert_allclose(recorded.trajectory.poses, source.truth.poses, atol=1e-6)


def test_a_run_says_what_became_of_the_prior() -> None:
    """Two frames compare no motion: the prior is not used, and the summary and a note say so; there is no truth."""
    sequence = vg.simulate("room", 2, size=(160, 120))
    summary = vg.reconstruct(
        sequence, settings=SETTINGS, pose_prior="recorded", options=vg.RunOptions(dense="none")
    ).summary
    assert summary["pose_prior"] == {"used": False, "scale": None, "compared": 0, "evidence": 0.0}
    assert "truth" not in summary
    other = vg.Trajectory(np.array([100.0, 101.0]), np.tile(np.eye(4), (2, 1, 1)))
    summary = vg.reconstruct(sequence, settings=SETTINGS, pose_prior=other, options=vg.RunOptions(dense="none")).summary
    assert not summary["pose_prior"]["used"]
    assert "truth" in summary or summary["frames"] < 3
