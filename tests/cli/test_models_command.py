"""`vggtgeo models`: what is listed, where files lie, what a check finds, what a download does."""

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import plane_views as views
import pytest
import tiny_networks as tiny
from hub_server import Hub, serve
from huggingface_hub.utils import disable_progress_bars
from typer.testing import CliRunner
from vggtgeo.models.onnx import contracts
from vggtgeo.models.onnx.registry import NETWORKS, HubFile
from vggtgeo.models.onnx.session import open_session

from vggtgeo.cli.main import make_app
from vggtgeo.cli.verify_network import example_inputs
from vggtgeo.io.network_files import networks_folder
from vggtgeo.slam.settings.presets import perception

SMALL = NETWORKS["moge2-small"]


def invoke(*arguments: object):
    return CliRunner().invoke(make_app(), [str(argument) for argument in arguments])


def test_every_network_is_listed_with_its_terms(tmp_path: Path) -> None:
    # Proves that the list names role, paper, licence, what it allows, size, how to get it, and what is there. Oracle:
    # the registry, and one file that was put there.
    tiny.letr(tmp_path / "letr.onnx")
    found = json.loads(invoke("models", "list", "--models", tmp_path, "--json").output)
    assert [row["name"] for row in found["networks"]] == list(NETWORKS)
    assert [row["name"] for row in found["networks"] if row["present"]] == ["letr"]
    assert all(row["licence"] and row["allows"] and row["paper"] and row["megabytes"] > 0 for row in found["networks"])
    uses = {row["name"]: row["use"] for row in found["networks"]}
    assert uses["dinov3"] == "--line-matcher dinov3 --confidence dinov3"
    assert uses["mast3r_decoder"] == "--points mast3r"
    text = invoke("models", "list", "--models", tmp_path).output
    for row in found["networks"]:
        terms = f"{row['licence']}: {row['allows']}"
        assert "\n    ".join((row["paper"], terms, row["get"], f"vggtgeo run PATH {row['use']}")) in text
    assert "vggtgeo models fetch moge2\n" in text
    assert "letr  present, random weights: its outputs are meaningless" in text
    assert [row["name"] for row in found["networks"] if row["random"]] == ["letr"]


def test_the_registry_is_sound() -> None:
    # Proves that each entry has a contract and each contract an entry, and that hashes are SHA-256, revisions commits.
    assert {network.contract_name for network in NETWORKS.values()} == set(contracts.CONTRACTS)
    published = [network.hub for network in NETWORKS.values() if network.hub]
    assert published
    assert all(len(bytes.fromhex(hub.sha256)) == 32 for hub in published)
    assert all(hub.revision == "main" or len(bytes.fromhex(hub.revision)) == 20 for hub in published)


def test_paths_follow_option_variable_and_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves the order of precedence of the folder. Oracle: each of the three ways in turn.
    monkeypatch.setenv("VGGTGEO_MODELS", str(tmp_path / "named"))
    assert invoke("models", "path", "--models", tmp_path).output.strip() == str(tmp_path)
    assert invoke("models", "path", "vggt").output.strip() == str(tmp_path / "named" / "vggt.onnx")
    monkeypatch.delenv("VGGTGEO_MODELS")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert networks_folder() == tmp_path / "data" / "vggtgeo" / "models"


# --- verify ------------------------------------------------------------------------------------------------------


@pytest.fixture
def check(tmp_path: Path) -> Callable[..., object]:
    """`vggtgeo models verify` with a small image of the test's own, timed once."""
    image = tmp_path / "image.png"
    cv2.imwrite(str(image), views.texture(0, (64, 48)))
    return lambda *arguments: invoke("models", "verify", *arguments[:1], "--image", image, "--runs", 1, *arguments[1:])


@pytest.mark.parametrize("name", contracts.CONTRACTS)
def test_a_good_file_of_each_network_is_fit(check: Callable, tmp_path: Path, name: str) -> None:
    # Proves that each contract can be checked on an image, by the name the file carries. Oracle: tiny files.
    path = getattr(tiny, name)(tmp_path / f"{name}.onnx")
    result = check(path, "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.output)
    assert report["network"] == name
    assert report["random_weights"]
    assert report["sha256"] == hashlib.sha256(hashlib.sha256(path.read_bytes()).digest()).hexdigest()
    assert {n for n, output in report["outputs"].items() if output["not_finite"] == 0} == set(report["outputs"])


def test_a_file_without_metadata_is_recognised(check: Callable, tmp_path: Path) -> None:
    # Proves that published files, which know nothing of this program, are named by their signature.
    import onnx

    path = tiny.moge2(tmp_path / "model.onnx", tokens=True)
    model = onnx.load(path)
    del model.metadata_props[:]
    onnx.save(model, path)
    report = json.loads(check(path, "--json").output)
    assert report["network"] == "moge2"
    assert not report["random_weights"]


def test_what_is_not_fit_ends_with_a_reason(check: Callable, tmp_path: Path) -> None:
    # Proves that NaN, a foreign network and an unknown one end with status 2 and say what is wrong.
    outputs = {"pred_logits": np.full((1, 2, 2), np.nan), "pred_lines": np.zeros((1, 2, 4))}
    bad = tiny.constant(tmp_path / "bad.onnx", "letr", {"image": (1, 3, 28, 42)}, outputs)
    other = tiny.constant(tmp_path / "other.onnx", "other", {"image": (1, 3, 28, 42)}, {"y": np.zeros(3)})
    for arguments, message in (
        ((bad,), "`pred_logits`"),
        ((bad, "--network", "vggt"), "is not a file of `vggt`"),
        ((other,), "matches no known network"),
        ((bad, "--image", bad), "bad.onnx"),
    ):
        result = check(*arguments)
        assert result.exit_code == 2, result.output
        assert message in result.output


def test_parity_is_shown_again_from_the_record(check: Callable, tmp_path: Path) -> None:
    # Proves that the record beside a file is compared, and that a difference makes it unfit. Oracle: outputs of the
    # same file, and the same with one value moved by 1 % of the largest.
    path = tiny.dinov3(tmp_path / "dinov3.onnx")
    session = open_session(path, contracts.DINOV3)
    inputs = example_inputs(session, views.texture(0, (64, 48)))
    outputs = session.run(inputs)
    record = {f"input.{name}": value for name, value in inputs.items()}
    record |= {f"output.{name}": value for name, value in outputs.items()}
    beside = tmp_path / "dinov3.onnx.parity.npz"
    np.savez(beside, **record)
    report = json.loads(check(path, "--json").output)
    assert report["parity"] == {"patch_descriptors": 0.0, "attention": 0.0}
    moved = outputs["attention"].copy()
    moved.flat[3] += 0.01 * moved.max()
    np.savez(beside, **{**record, "output.attention": moved})
    result = check(path)
    assert result.exit_code == 2
    assert "`attention` differs from PyTorch by 0.01, expected at most 0.001" in result.output


# --- fetch -------------------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _quiet_hub() -> None:
    disable_progress_bars()


def test_a_file_is_carried_to_a_machine_without_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves the steps of docs/guides/networks.md: fetched on one machine, copied, checked and used on another, where
    # nobody answers; a file that was damaged on the way is not taken for the right one. Oracle: a server that is gone.
    content = tiny.moge2(tmp_path / "published.onnx").read_bytes()
    hub_file = HubFile("someone/something", "model.onnx", hashlib.sha256(content).hexdigest())
    monkeypatch.setitem(NETWORKS, SMALL.name, replace(SMALL, hub=hub_file))
    with serve(Hub(content)) as hub:
        done = invoke("models", "fetch", SMALL.name, "--models", tmp_path / "one", "--endpoint", hub.address)
    assert done.exit_code == 0, done.output
    assert (tmp_path / "one" / SMALL.file).read_bytes() == content
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    file = tmp_path / "two" / SMALL.file
    again = invoke("models", "fetch", SMALL.name, "--models", tmp_path / "two", "--endpoint", hub.address)
    assert again.stdout.strip() == str(file)
    assert invoke("models", "verify", file, "--runs", 1).exit_code == 0
    roles = perception("classical", None, tmp_path / "two", mixed={"depth": SMALL.name}).roles
    assert np.isfinite(roles.depth.estimate(views.texture(0, (64, 48)), None, (55.4, 55.4, 31.5, 23.5)).depth).any()
    file.write_bytes(content[:-1])
    monkeypatch.setattr("time.sleep", lambda _: None)
    damaged = invoke("models", "fetch", SMALL.name, "--models", tmp_path / "two", "--endpoint", hub.address)
    assert damaged.exit_code == 2
    assert "could not be downloaded" in damaged.output
