"""A run that is killed and resumed ends with the bits of one that nobody disturbed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_sequences as tiny
from recorded_run import FRAMES, ROLES, SETTINGS
from reported import raises
from same_leaves import differences
from typer.testing import CliRunner
from vggtgeo.models.onnx.bounds import Refusals

import vggtgeo.results.reconstruction as reconstruction
from vggtgeo.cli.main import make_app
from vggtgeo.datasets.frame import Frame
from vggtgeo.io.errors import InputError, InputWarning, LeftOutWarning
from vggtgeo.results.checkpoints import CHECKPOINT, Checkpoints, RunSoFar, frame_count_text, notice_of
from vggtgeo.results.output_checks import unfinished_message
from vggtgeo.results.reconstruction import RunOptions, reconstruct
from vggtgeo.results.result import Result
from vggtgeo.results.run_folder import open_run_folder
from vggtgeo.simulation import SyntheticSequence, simulate
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.corner_recorder import FrameCorners
from vggtgeo.slam.verdict.judge import judge

TIMES = ("seconds_by_stage", "frames_per_second", "peak_memory_gb")


class Killed(Exception):
    """What ends a run in the middle of everything."""


@dataclass
class KilledAfter(Callback):
    """Ends the run at a frame, before its state is kept."""

    frame: int

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        if frame.index == self.frame:
            raise Killed


@dataclass(frozen=True, eq=False)
class Run:
    """What a run left, and what was noted of its frames for the verdict."""

    result: Result
    evidence: tuple[FrameCorners, ...]


@cache
def sequence(seed: int = 0) -> SyntheticSequence:
    return simulate("room", FRAMES, seed, (320, 240), rate=10.0)


def run(
    monkeypatch: pytest.MonkeyPatch,
    checkpoints: Checkpoints | None = None,
    options: Mapping[str, Any] | None = None,
    **given: Any,
) -> Run:
    seen: list[FrameCorners] = []

    def judged(slam: Slam, evidence: Any, *rest: Any) -> Any:
        seen.extend(evidence)
        return judge(slam, evidence, *rest)

    monkeypatch.setattr(reconstruction, "judge_or_report", judged)
    given = {"frames": sequence(), "roles": ROLES, "settings": SETTINGS, **given}
    selected = RunOptions(dense="none", checkpoints=checkpoints, **(options or {}))
    return Run(reconstruct(**given, options=selected), tuple(seen))


def killed(monkeypatch: pytest.MonkeyPatch, path: Path, frame: int) -> Checkpoints:
    """What a run that was killed at a frame kept; how to go on."""
    with pytest.raises(Killed):
        run(monkeypatch, Checkpoints(path, every=0), callbacks=[KilledAfter(frame)])
    return Checkpoints(path, resume=True, every=0)


@pytest.fixture(scope="module")
def undisturbed() -> Run:
    """The run that nobody disturbs."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        return run(monkeypatch)


@pytest.mark.parametrize("frame", [5, pytest.param(FRAMES - 1, marks=pytest.mark.long)])
def test_a_resumed_run_ends_as_an_undisturbed_one(
    frame: int, undisturbed: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """State, windows, evidence, verdict and summary are the same to the bit, but for times; oracle: the other run."""
    before = killed(monkeypatch, tmp_path / "kept", frame)
    assert frame_count_text(before.path) == f"{frame} frame{'s' * (frame > 1)}"
    again = run(monkeypatch, before)
    for one, other in ((undisturbed.result.record, again.result.record), (undisturbed.evidence, again.evidence)):
        assert list(differences(one, other)) == []
    plain = lambda found: {key: value for key, value in found.result.summary.items() if key not in TIMES}
    assert plain(again) == plain(undisturbed)
    assert len(again.evidence) == FRAMES
    assert len(again.result.record.windows) == len(undisturbed.result.record.windows) > 1


def test_only_the_same_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another setting, role, seed, selection, version or source is refused with its name, and what was kept stays;
    oracle: the sentence."""
    before = killed(monkeypatch, tmp_path / "kept", 2)
    content = before.path.read_bytes()
    window = replace(SETTINGS, window=replace(SETTINGS.window, point_slots=97))
    for given, sentence in (
        ({"settings": window}, "`window.point_slots` must be 96.*got 97"),
        ({"roles": replace(ROLES, flow=None)}, "`flow` .*PatchFlow"),
        ({"options": {"seed": 1}}, "`seed` must be 0.*got 1"),
        ({"options": {"end": 4}}, r"`start, end, stride` must be \(0, None, 1\).*got \(0, 4, 1\)"),
        ({"frames": replace(sequence(), seed=1)}, "`name` must be 'synthetic room, seed 0'.*'synthetic room, seed 1'"),
        ({"frames": iter(sequence().frames())}, "`resume` must be False for a stream.*`frames`"),
    ):
        with pytest.raises(InputError, match=sentence):
            run(monkeypatch, before, **given)
    monkeypatch.setattr("vggtgeo.results.checkpoints.digest_of", lambda frame: "of another image")
    with raises("frame 1"):
        run(monkeypatch, before)
    monkeypatch.setattr("vggtgeo.results.checkpoints.versions", lambda: {"vggtgeo": "0.0.9"})
    with pytest.raises(InputError, match=r"`\w+` must be \S*\d.*got unset"):
        run(monkeypatch, before)
    assert before.path.read_bytes() == content


def test_a_state_that_cannot_be_kept_costs_nothing(
    undisturbed: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk, or descriptors of an unknown kind, are told once, and the run ends as ever; oracle: the result."""

    class Told(Callback):
        def __init__(self) -> None:
            self.messages: list[str] = []

        def on_message(self, message: str) -> None:
            self.messages.append(message)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    told = Told()
    monkeypatch.setattr("vggtgeo.io.files.os.fsync", full)
    found = run(monkeypatch, Checkpoints(tmp_path / "kept", every=0), callbacks=[told])
    assert [("No space left" in line, "cannot be resumed" in line) for line in told.messages] == [(True, True)]
    assert list(differences(undisturbed.result.record, found.result.record)) == []
    assert list(tmp_path.iterdir()) == []


def test_warnings_are_counted_once() -> None:
    """What was warned of before the kill and is read again counts once, what is new counts; oracle: the list."""
    slam = Slam(map=Map(metric=True), camera=CameraEstimate(intrinsics=np.ones(4), given=np.ones(4), sigma=np.ones(4)))
    said = [InputWarning("a guess"), LeftOutWarning("frame 3", 2), "words"]
    before = RunSoFar(slam, {}, tuple(map(notice_of, said)), {"depth": (4, 1, 9, 2)}, {}, 0.0, 0.0)
    now = [LeftOutWarning("frame 3", 2), LeftOutWarning("frame 4"), LeftOutWarning("frame 4"), InputWarning("a guess")]
    found = before.merge_warnings(now)
    assert [str(warning) for warning in found] == ["a guess", "frame 3", "words", "frame 4", "frame 4"]
    assert sum(warning.frames for warning in found if isinstance(warning, LeftOutWarning)) == 4
    refusals = {"depth": Refusals(), "lines": Refusals()}
    before.restore_refusals(refusals)
    assert (refusals["depth"], refusals["lines"]) == (Refusals(4, 1, 9, 2), Refusals())


def keep(folder: Path) -> None:
    """What a run that was killed left in its folder."""
    (folder / "unfinished").mkdir(parents=True)
    facts = {"identity": {}, "frames": 812, "last": 811, "digest": ""}
    CHECKPOINT.write(folder / "unfinished/checkpoint.npz", (), facts)
    (folder / "unfinished/keyframes.txt").write_text("")


def test_the_folder_of_a_killed_run(tmp_path: Path) -> None:
    """Nobody throws a state away unasked: the folder is refused without a word, kept for a run that goes on, also if
    that fails, and emptied for one that begins anew or is published; oracle: the files.

    """
    keep(tmp_path)
    kept = tmp_path / "unfinished/checkpoint.npz"
    with raises(812, "--resume", "--no-resume"):
        open_run_folder(tmp_path, resume=None).__enter__()
    assert "`vggtgeo run --resume`" in (unfinished_message(tmp_path) or "")
    with open_run_folder(tmp_path, resume=True) as place:
        assert sorted(path.name for path in place.stage.iterdir()) == ["README.txt", "checkpoint.npz"]
    assert kept.is_file()
    with open_run_folder(tmp_path, resume=True) as place:
        (place.stage / "summary.json").write_text("{}")
        place.publish()
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]
    keep(tmp_path)
    with open_run_folder(tmp_path, resume=False) as place:
        assert [path.name for path in place.stage.iterdir()] == ["README.txt"]
    assert not kept.exists()


@pytest.mark.usefixtures("uncompiled")
def test_the_command_says_what_it_does(tmp_path: Path) -> None:
    """Without a word the folder of a killed run is refused; `--resume` in an empty one begins and says so; oracle: what
    is printed.
    """
    pixels = np.random.default_rng(1).integers(0, 255, (12, 16, 3)).astype(np.uint8).repeat(10, 0).repeat(10, 1)
    for row in range(3):
        tiny.write_image(tmp_path / f"frames/{row}.png", pixels)
    tiny.write_calibration(tmp_path / "frames", (150.0, 150.0, 79.5, 59.5))
    command = ["run", str(tmp_path / "frames"), "-o", str(tmp_path / "out")]
    call = lambda *flags: CliRunner().invoke(make_app(), [*command, *flags])
    keep(tmp_path / "out")
    refused = call()
    assert refused.exit_code == 2, refused.exception
    assert "`--resume`" in refused.stderr
    other = call("--resume")
    assert other.exit_code == 2
    assert "`frames` must be unset" in other.stderr
    assert call("--no-resume").exit_code == 3
    begun = call("--resume")
    assert begun.exit_code == 3
    assert f"`{tmp_path / 'out'}` has no checkpoint: the run starts at the first frame" in begun.stderr
    assert "resume" not in (tmp_path / "out/settings.toml").read_text()
