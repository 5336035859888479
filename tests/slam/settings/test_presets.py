"""`--preset`: networks behind every role of a whole run, from tiny files."""

import importlib
import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_networks as tiny
from reported import raises, warns
from tiny_sequences import seven_scenes
from typer.testing import CliRunner
from vggtgeo.models.onnx.point_matchers import Mast3rMatcher
from vggtgeo.models.onnx.registry import files_of, players
from vggtgeo.models.onnx.session import Session
from vggtgeo.models.window_locator import WindowLocator

from vggtgeo.cli.main import make_app
from vggtgeo.cli.models import FLAGS
from vggtgeo.io.errors import InputWarning
from vggtgeo.simulation.sequence import simulate, write_tum_folder
from vggtgeo.slam.run import frame_trajectory, run
from vggtgeo.slam.settings.groups import GlobalMapSettings
from vggtgeo.slam.settings.presets import CHOICES, NEEDED, Perception, perception
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings

RUN_AND_WRITE = "vggtgeo.cli.run_sequence"
"""The module from which the command takes `run_and_write`."""
SIZE = (192, 256)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a tiny file of every network."""
    folder = tmp_path_factory.mktemp("networks")
    tiny.vggt(folder / "vggt.onnx", views=3, size=(84, 112))
    for name in ("dinov3", "dinov3-small"):
        tiny.dinov3(folder / f"{name}.onnx", SIZE)
    for name in ("moge2", "moge2-small"):
        tiny.moge2(folder / f"{name}.onnx", SIZE)
    tiny.letr(folder / "letr.onnx", SIZE)
    tiny.mlsd(folder / "mlsd.onnx")
    tiny.mast3r_encoder(folder / "mast3r_encoder.onnx", SIZE)
    tiny.mast3r_decoder(folder / "mast3r_decoder.onnx", SIZE, reach=4)
    for name in ("alike", "alike-tiny"):
        tiny.alike(folder / f"{name}.onnx", SIZE)
    tiny.xfeat(folder / "xfeat.onnx", SIZE)
    return folder


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How often each file ran, by its name, once it was warm."""
    runs: dict[str, int] = {}
    real = Session.run_on_device

    def run(self: Session, inputs: object, wanted: object = None) -> object:
        runs[self.path.stem] = runs.get(self.path.stem, 0) + 1
        return real(self, inputs, wanted)

    monkeypatch.setattr(Session, "run_on_device", run)
    monkeypatch.setattr(Session, "warm_up", lambda self: None)
    return runs


@pytest.mark.long
def test_a_run_asks_every_network_and_from_a_cache_none(files: Path, tmp_path: Path, counted: dict[str, int]) -> None:
    # Proves that a whole run goes through every network of the preset and no other, that its result is finite, and
    # that a second run with the same cache asks none and gives the same. Oracle: a count, and the first trajectory.
    settings = SlamSettings(refinement=GlobalMapSettings(global_adjustment=False))
    walk = simulate("room", 8, 0, SIZE[::-1], rate=5.0)  # enough for three keyframes
    poses = []
    for expected in (set(NEEDED["paper"]), set()):
        found = perception("paper", Roles(), files, tmp_path / "cache")
        counted.clear()
        *_, slam = run(walk, found.roles, settings)
        assert set(counted) == expected
        said = found.facts()["networks"]
        assert {name: network["calls"] for name, network in said.items() if network["calls"]} == counted
        # Rounded to milliseconds, so a single tiny network may well have taken none.
        assert not any(network["seconds"] for network in said.values() if not network["calls"])
        assert (sum(network["seconds"] for network in said.values()) > 0) == bool(expected)
        assert len(slam.frames) == 8
        assert len(slam.keyframes) >= 2
        poses.append(frame_trajectory(slam).poses)
    assert np.isfinite(poses[0]).all()
    np.testing.assert_array_equal(poses[0], poses[1])


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """What `vggtgeo run` would do: the run itself is left out."""
    given: dict[str, object] = {}

    def stand_in(sequence: object, perceived: Perception, *_: object, **__: object) -> None:
        given.update(roles=perceived.roles, facts=perceived.facts())

    module = importlib.import_module(RUN_AND_WRITE)
    monkeypatch.setattr(module, "run_and_write", stand_in)
    return given


def _run(tmp_path: Path, *options: object):
    """The program on a tiny sequence."""
    folder = tmp_path / "sequence"
    if not folder.exists():
        seven_scenes(folder)
    arguments = ["run", folder, "-o", tmp_path / "run", "--quiet", *options]
    return CliRunner().invoke(make_app(), [str(argument) for argument in arguments])


def test_the_program_says_what_random_weights_are_worth(files: Path, tmp_path: Path, called: dict[str, object]) -> None:
    # Proves that the user is warned and that the summary names each network, its hash and its weights. Oracle: the
    # files' own metadata.
    with warns("vggt", "dinov3"):
        result = _run(tmp_path, "--preset", "paper", "--models", files)
    assert result.exit_code == 0, result.output
    assert isinstance(called["roles"].points.source, Mast3rMatcher)
    networks = called["facts"]["networks"]
    assert set(networks) == set(NEEDED["paper"])
    assert {network["weights"] for network in networks.values()} == {"random"}
    assert {len(network["sha256"]) for network in networks.values()} == {64}
    assert "this result means nothing" in called["facts"]["meaningless"]
    json.dumps(called["facts"])


def test_the_preset_builds_the_roles_it_documents(files: Path) -> None:
    # Proves the table of the presets, and that only random weights are warned of. Oracle: the types of the objects.
    classical = Roles()
    found = perception("classical", classical)
    assert found.roles is classical
    assert found.facts() == {}
    found = perception("light", classical, files)
    assert found.random
    trained = {n: replace(one, metadata={"vggtgeo.weights": "checkpoint"}) for n, one in found.networks.items()}
    assert "meaningless" not in replace(found, networks=trained).facts()
    light = found.roles
    assert light.points is classical.points
    assert light.geometry is classical.geometry
    assert light.metric
    paper = perception("paper", classical, files).roles
    assert isinstance(paper.points.source, Mast3rMatcher)
    assert isinstance(paper.geometry, WindowLocator)
    assert paper.geometry.views == 3
    assert paper.geometry.judge is classical.geometry


@pytest.mark.slow
def test_the_program_runs_with_tiny_files(files: Path, tmp_path: Path) -> None:
    # Proves that `vggtgeo run --preset paper` writes every output, and the warning into its summary and its page.
    folder, output = tmp_path / "walk", tmp_path / "run"
    for _ in write_tum_folder(simulate("room", 10, 0, SIZE[::-1], rate=10.0), folder):
        pass
    arguments = ["run", folder, "-o", output, "--quiet", "--preset", "paper", "--models", files]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        result = CliRunner().invoke(make_app(), [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    assert np.isfinite(np.loadtxt(output / "trajectory.txt")).all()
    summary = json.loads((output / "summary.json").read_text())
    assert summary["frames"] == 10
    assert all(network["calls"] > 0 for network in summary["networks"].values()), summary["networks"]
    assert "this result means nothing" in summary["meaningless"]
    assert "this result means nothing" in (output / "report.html").read_text()


def test_a_role_takes_networks_of_its_kind_alone(files: Path) -> None:
    # Proves the error of a name that cannot play a role. Oracle: the names of those who can.
    with raises("lines", "moge2", "orb", "mast3r"):
        perception("classical", Roles(), files, mixed={"lines": "moge2"})


def test_every_mixture_of_roles_is_reached_from_the_command_line(
    files: Path, tmp_path: Path, called: dict[str, object]
) -> None:
    # Proves that each name of each role can be given as a flag, alone and together, is played by its own class and
    # opens its own files; and that a role that nothing asks opens none. Oracle: the classes, the files.
    def run(*flags: str) -> set[str]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            result = _run(tmp_path, "--models", files, *flags)
        assert result.exit_code == 0, result.output
        return set(called["facts"].get("networks", {}))

    kinds = {
        "mast3r": "Mast3rMatcher", "alike": "DensePointMatcher", "alike-tiny": "DensePointMatcher",
        "xfeat": "DensePointMatcher", "mlsd": "MlsdDetector", "letr": "LetrDetector", "moge2": "MogeDepth",
        "moge2-small": "MogeDepth", "vggt": "BoundedWindow", "orb": "OrbMatcher",
        "constant-velocity": "ConstantVelocity",
    }  # fmt: skip
    for role, names in CHOICES.items():
        for name in names:
            networks = run(FLAGS[role], name)
            assert networks == (set(files_of(name)) if name in players(role) else set()), name
            player = getattr(called["roles"], role)
            found = type(getattr(player, "source", getattr(player, "model", player))).__name__
            dense = {"line_matches": "DenseLineMatcher", "confidence": "DinoFeatures"}
            expected = dense[role] if name.startswith("dinov3") else kinds.get(name)
            assert expected in (None, found), name
    mixed = ("--depth", "moge2", "--points", "alike", "--lines", "mlsd", "--confidence", "dinov3-small")
    assert run(*mixed, "--line-matcher", "dinov3") == {"moge2", "alike", "mlsd", "dinov3-small", "dinov3"}
    assert run("--preset", "light", "--no-lines", "--no-confidence") == {"moge2-small"}
    assert run("--preset", "light", "--no-lines") == {"moge2-small", "dinov3-small"}
    assert called["roles"].flow is None or called["roles"].follows is False
