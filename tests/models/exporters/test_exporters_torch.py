"""The exporters on the networks' published code: needs torch (extra `export`) and checkouts.

    VGGTGEO_CHECKOUTS=folder .venv/bin/python -m pytest -m slow tests/models/exporters/test_exporters_torch.py

The folder holds checkouts of the networks' code, each in a folder of any name. Small variants and sizes: about ten
minutes and 2 GB. The full sizes are those of benchmarks/networks.py.
"""

import argparse
import os
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from reported import raises
from vggtgeo.models.exporters import point_matchers, vggt
from vggtgeo.models.exporters.export import Report, export
from vggtgeo.models.exporters.network import Request, checkpoint_identity
from vggtgeo.models.exporters.recipes import recipe_of
from vggtgeo.models.onnx.contracts import CONTRACTS, HALF_TOLERANCE, relative_difference

pytestmark = [
    pytest.mark.slow,
    # the published code and torch's exporter warn of their own deprecations
    pytest.mark.filterwarnings("ignore"),
]
SMALL = {
    "vggt": {"variant": "test", "height": 140, "views": 3},
    "dinov3": {"variant": "vits16", "height": 112, "width": 160},
    "moge2": {"variant": "vits", "height": 120, "width": 160, "tokens": 200},
    "letr": {"variant": "test", "height": 160, "width": 224},
    "mast3r_encoder": {"variant": "test", "height": 96, "width": 128},
    "mast3r_decoder": {"variant": "test", "height": 96, "width": 128},
    "mlsd": {},
    "alike": {"variant": "tiny", "height": 96, "width": 128},
    "xfeat": {"height": 96, "width": 128},
}
HALF = ("vggt", "dinov3", "moge2", "mast3r_encoder", "mast3r_decoder")


@pytest.fixture(scope="module")
def checkouts() -> Path:
    pytest.importorskip("torch")
    pytest.importorskip("onnxscript")
    folder = os.environ.get("VGGTGEO_CHECKOUTS")
    if not folder:
        pytest.skip("needs VGGTGEO_CHECKOUTS, a folder of checkouts of the networks' code")
    return Path(folder)


def request_of(network: str, checkouts: Path, checkpoint: Path | None = None, **options) -> Request:
    recipe = recipe_of(network)
    source = recipe.checkout.find(checkouts)
    if source is None:
        pytest.skip(f"VGGTGEO_CHECKOUTS holds no {recipe.checkout.repository}")
    return recipe.request(source, checkpoint, **(SMALL[network] | options))


def run_again(report: Report) -> float:
    """The largest difference of the file from what PyTorch gave, both read from the files."""
    session = onnxruntime.InferenceSession(str(report.path), providers=["CPUExecutionProvider"])
    with np.load(f"{report.path}.parity.npz") as parity:
        names = [value.name for value in session.get_outputs()]
        outputs = session.run(names, {value.name: parity[f"input.{value.name}"] for value in session.get_inputs()})
        gaps = [
            relative_difference(found, parity[f"output.{name}"]) for name, found in zip(names, outputs, strict=True)
        ]
    return max(gaps)


@pytest.mark.parametrize("network", SMALL)
def test_a_file_gives_what_the_published_code_gives(network: str, checkouts: Path, tmp_path: Path) -> None:
    # Proves, for each network, that the changed module equals the published one, that onnxruntime equals PyTorch on
    # the file alone, that the file has the names and sizes of the contract and says what it is, and that it carries
    # no path of this machine. Oracle: the published code, and the bytes of the file.
    report = export(recipe_of(network), request_of(network, checkouts), tmp_path / "file.onnx")
    assert report.rewrite < 1e-4
    assert report.parity < 1e-4
    assert run_again(report) < 1e-4
    session = onnxruntime.InferenceSession(str(report.path), providers=["CPUExecutionProvider"])
    contract = CONTRACTS[network]
    assert [value.name for value in session.get_inputs()] == [t.name for t in contract.inputs if not t.optional]
    assert {t.name for t in contract.outputs if not t.optional} <= {value.name for value in session.get_outputs()}
    said = session.get_modelmeta().custom_metadata_map
    assert said["vggtgeo.network"] == network
    assert said["vggtgeo.weights"] == "random"
    assert {key.split(".")[0] for key in said} == {"vggtgeo"}
    model = onnx.load(report.path, load_external_data=False)
    del model.graph.initializer[:]  # bytes of weights may spell anything
    for path in (str(checkouts), str(tmp_path), "site-packages", ".py"):
        assert path.encode() not in model.SerializeToString()
    left = {file.name for file in tmp_path.iterdir()}
    assert {"file.onnx", "file.onnx.parity.npz"} <= left <= {"file.onnx", "file.onnx.parity.npz", "file.onnx.data"}


def test_vggt_never_holds_the_weights_of_all_pairs_of_tokens(checkouts: Path, tmp_path: Path) -> None:
    # Proves that global attention goes through the queries of one view at a time, which the memory of ten views hangs
    # on. Oracle: the shapes that onnx infers for every softmax of the file: 3 views of 10 x 37 patches and 5 tokens.
    report = export(recipe_of("vggt"), request_of("vggt", checkouts), tmp_path / "file.onnx")
    graph = onnx.shape_inference.infer_shapes(onnx.load(report.path, load_external_data=False)).graph
    shapes = {value.name: [size.dim_value for size in value.type.tensor_type.shape.dim] for value in graph.value_info}
    weights = [shapes[node.output[0]] for node in graph.node if node.op_type == "Softmax"]
    assert {shape[-2] for shape in weights if shape[-1] == 3 * 375} == {375}


@pytest.mark.parametrize("network", HALF)
def test_half_precision_is_close_and_smaller(network: str, checkouts: Path, tmp_path: Path) -> None:
    # Proves that half precision stays within its tolerance of the published float32, takes float32 and gives it, and
    # makes the file smaller. Oracle: the published code in float32.
    single = export(recipe_of(network), request_of(network, checkouts), tmp_path / "single.onnx")
    half = export(recipe_of(network), request_of(network, checkouts, half=True), tmp_path / "half.onnx")
    session = onnxruntime.InferenceSession(str(half.path), providers=["CPUExecutionProvider"])
    assert {value.type for value in (*session.get_inputs(), *session.get_outputs())} == {"tensor(float)"}
    assert 1e-6 < half.rewrite < HALF_TOLERANCE
    assert run_again(half) < HALF_TOLERANCE
    assert half.megabytes < 0.95 * single.megabytes


def test_a_checkpoint_is_loaded_in_full(checkouts: Path, tmp_path: Path) -> None:
    # Proves that the file computes with the checkpoint's weights, all of them, and names the checkpoint. Oracle: a
    # network of other random weights, saved; its file gives what that network's file gives.
    import torch

    recipe = recipe_of("dinov3")
    other = Request(**(vars(request_of("dinov3", checkouts)) | {"seed": 7}))
    saved = tmp_path / "saved.pth"
    torch.save({"model": recipe.build(other).module.network.state_dict(), "args": argparse.Namespace(lr=1)}, saved)
    from_file = export(recipe, request_of("dinov3", checkouts, saved), tmp_path / "saved.onnx")
    assert from_file.weights == checkpoint_identity(saved)
    assert from_file.weights.startswith("sha256:")
    random = export(recipe, request_of("dinov3", checkouts), tmp_path / "random.onnx")
    gaps = []
    for path in (from_file.path, random.path):
        network = recipe.build(Request(**(vars(other) | {"seed": 0, "checkpoint": saved}))).module
        with np.load(f"{path}.parity.npz") as parity, torch.inference_mode():
            wanted = network(torch.from_numpy(parity["input.image"]))[0].numpy()
            gaps.append(relative_difference(parity["output.patch_descriptors"], wanted))
    assert gaps[0] == 0
    assert gaps[1] > 0.1


@pytest.mark.parametrize(
    ("network", "module", "function"),
    [("vggt", vggt, "fix_positions"), ("mast3r_decoder", point_matchers, "fix_positions"), ("dinov3", None, "")],
)
def test_an_error_in_a_change_is_seen(
    network: str, module, function: str, checkouts: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Proves that the comparison with the published code has the power to see a wrong change with random weights.
    # Oracle: positions in the wrong order (VGGT, MASt3R); attention of the last block without positions (DINOv3).
    if module is not None:
        right = getattr(module, function)
        monkeypatch.setattr(module, function, lambda rope, places, *others: right(rope, places[::-1].copy(), *others))
    else:
        from vggtgeo.models.exporters import dinov3

        right = dinov3._last_attention
        flat = lambda block, tokens, rope: right(block, tokens, (0 * rope[0], 0 * rope[1] + 1))
        monkeypatch.setattr(dinov3, "_last_attention", flat)
    with raises("the changed module"):
        export(recipe_of(network), request_of(network, checkouts), tmp_path / "file.onnx")
    assert list(tmp_path.iterdir()) == []
