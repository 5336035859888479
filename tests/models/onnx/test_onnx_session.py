"""The session of all networks: what it refuses, what it computes, where it leaves results."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_networks as tiny
from onnx import helper
from reported import raises
from vggtgeo.models.onnx import contracts
from vggtgeo.models.onnx.contracts import NetworkFileError, file_parts
from vggtgeo.models.onnx.session import NetworkRunError, choose_provider, open_session


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One tiny file of each network."""
    folder = tmp_path_factory.mktemp("networks")
    return {name: getattr(tiny, name)(folder / f"{name}.onnx") for name in contracts.CONTRACTS}


@pytest.mark.parametrize("given", contracts.CONTRACTS)
def test_a_file_is_taken_for_its_own_network_only(files: dict[str, Path], given: str) -> None:
    # Proves that of all pairs of file and contract the equal ones open and the others are refused, with the name of
    # what the file looks like: no two contracts accept one file. Oracle: the names under which the files were made.
    session = open_session(files[given])
    session.warm_up()
    assert session.random_weights
    for asked, contract in contracts.CONTRACTS.items():
        if asked == given:
            assert open_session(files[given], contract).contract is session.contract is contract
        else:
            with raises(files[given], asked, given, error=NetworkFileError):
                open_session(files[given], contract)


def _without_data(path: Path) -> None:
    tiny.vggt(path, external=True)
    path.with_name("vggt.onnx.data").unlink()


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]), "onnxruntime"),
    "no external data": (_without_data, "vggt.onnx.data"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_refused_by_what_is_wrong_with_it(tmp_path: Path, case: str) -> None:
    # Proves that only a whole ONNX file opens, and that the error names it and the fault. Oracle: how it was broken.
    spoil, named = BROKEN[case]
    path = tiny.vggt(tmp_path / "vggt.onnx")
    spoil(path)
    with raises(path, named, error=NetworkFileError):
        open_session(path, contracts.VGGT)


LETR_LINES = {"pred_logits": np.zeros((1, 2, 2)), "pred_lines": np.zeros((1, 2, 4))}
WRONG_SIZES = {
    "multiple": ("vggt", {"images": (2, 3, 29, 42)}, {"depth": np.zeros((2, 29, 42))}, ("H", 29, 14)),
    "fixed": ("mlsd", {"image": (1, 4, 512, 512)}, {"maps": np.zeros((1, 8, 256, 256))}, ("maps", 8, 9)),
    "rank": ("letr", {"image": (3, 28, 42)}, LETR_LINES, ("image", "[3, 28, 42]")),
    "letter": ("letr", {"image": (1, 3, 28, 42)}, LETR_LINES | {"pred_lines": np.zeros((1, 3, 4))}, ("Q", 2, 3)),
    "tokens": ("mast3r_encoder", {"image": (1, 3, 48, 64)}, {"features": np.zeros((1, 6, 8))}, ("H/16", 6, 12)),
}


@pytest.mark.parametrize("case", WRONG_SIZES)
def test_wrong_shapes_are_named(tmp_path: Path, case: str) -> None:
    # Proves each rule of a contract (multiples, fixed sizes, ranks, equal letters, tokens). Oracle: the one fault.
    network, inputs, outputs, named = WRONG_SIZES[case]
    if network == "vggt":
        outputs = {"pose_enc": np.zeros((2, 9)), "depth_conf": outputs["depth"], **outputs}
    path = tiny.constant(tmp_path / "wrong.onnx", network, inputs, outputs)
    with raises(path, *named, error=NetworkFileError):
        open_session(path, contracts.CONTRACTS[network])


def test_a_wrong_element_type_is_named(tmp_path: Path) -> None:
    # Proves that float64 is refused. Oracle: the type of the file.
    path = tiny.letr(tmp_path / "letr.onnx", dtype=np.float64)
    with raises(path, "image", "float32", "double", error=NetworkFileError):
        open_session(path, contracts.LETR)


def test_sizes_that_a_file_leaves_open_are_accepted(tmp_path: Path) -> None:
    # Proves that a letter in the file constrains nothing, and that such a file still runs. Oracle: its constants.
    outputs = {"pred_logits": np.zeros((1, 2, 2)), "pred_lines": np.ones((1, 2, 4))}
    path = tiny.constant(tmp_path / "letr.onnx", "letr", {"image": (1, 3, "height", "width")}, outputs)
    session = open_session(path, contracts.LETR)
    session.warm_up()
    found = session.run({"image": np.zeros((1, 3, 20, 30), np.float32)})
    np.testing.assert_array_equal(found["pred_lines"], outputs["pred_lines"])


def test_calls_are_counted_once_a_network_is_warm(tmp_path: Path) -> None:
    # Proves that a session counts what it was asked, without its warming up. Oracle: the number of calls made here.
    session = open_session(tiny.letr(tmp_path / "letr.onnx"), contracts.LETR)
    session.warm_up()
    assert (session.tally.calls, session.tally.seconds) == (0, 0.0)
    for _ in range(3):
        session.run({"image": np.zeros((1, 3, 48, 64), np.float32)})
    assert session.tally.calls == 3
    assert session.tally.seconds > 0


def test_half_precision_goes_in_and_comes_back(tmp_path: Path) -> None:
    # Proves that a float16 file takes float32 arrays and gives them back. Oracle: values that float16 holds exactly.
    session = open_session(tiny.vggt(tmp_path / "half.onnx", dtype=np.float16), contracts.VGGT)
    assert session.inputs["images"].dtype == "float16"
    found = session.run({"images": np.full((2, 3, 28, 42), 0.5, np.float32)}, ("depth", "depth_conf"))
    assert {name: array.dtype.name for name, array in found.items()} == {"depth": "float32", "depth_conf": "float32"}
    np.testing.assert_array_equal(found["depth_conf"], 3.0)


def test_values_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    # Proves that NaN does not leave a network silently. Oracle: the constant that was put in.
    outputs = {"pred_logits": np.array([[[np.nan, 0.0]]]), "pred_lines": np.zeros((1, 1, 4))}
    path = tiny.constant(tmp_path / "letr.onnx", "letr", {"image": (1, 3, 28, 42)}, outputs)
    session = open_session(path, contracts.LETR)
    for attempt in (lambda: session.run({"image": np.zeros((1, 3, 28, 42))}), session.warm_up):
        with raises("pred_logits", "1 of 2", error=NetworkRunError):
            attempt()


def test_an_answer_of_other_sizes_is_an_error_of_the_network(tmp_path: Path) -> None:
    # Proves that sizes that a file leaves open are those of the contract when it runs: as many views as were given, of
    # their size. Oracle: a constant for two views, asked with three.
    outputs = {"pose_enc": np.zeros((2, 9)), "depth": np.ones((2, 28, 42)), "depth_conf": np.ones((2, 28, 42))}
    nodes = [helper.make_node("Identity", [f"value of {name}"], [name]) for name in outputs]
    values = {f"value of {name}": np.asarray(value, np.float32) for name, value in outputs.items()}
    shapes: dict[str, tiny.Shape] = {"pose_enc": ("n", 9), "depth": ("n", "h", "w"), "depth_conf": ("n", "h", "w")}
    path = tiny.save(tmp_path / "vggt.onnx", nodes, {"images": ("n", 3, "h", "w")}, shapes, values)
    session = open_session(path, contracts.VGGT)
    assert session.run({"images": np.zeros((2, 3, 28, 42))})["depth"].shape == (2, 28, 42)
    with raises("vggt", "pose_enc", 2, 3, error=NetworkRunError):
        session.run({"images": np.zeros((3, 3, 28, 42))})
    with raises("depth", 28, 14, error=NetworkRunError):
        session.run({"images": np.zeros((2, 3, 14, 42))})


def test_outputs_stay_where_they_are(files: dict[str, Path]) -> None:
    # Proves that an output goes into another network without a copy to the host. Oracle: the host's route.
    encoder = open_session(files["mast3r_encoder"], contracts.MAST3R_ENCODER)
    decoder = open_session(files["mast3r_decoder"], contracts.MAST3R_DECODER)
    image = np.random.default_rng(0).uniform(-1, 1, (1, 3, 48, 64)).astype(np.float32)
    features = encoder.run_on_device({"image": image})["features"]
    direct = decoder.run({"features_1": features, "features_2": features}, ("descriptors_1",))
    host = features.numpy()
    again = decoder.run({"features_1": host, "features_2": host}, ("descriptors_1",))
    np.testing.assert_array_equal(direct["descriptors_1"], again["descriptors_1"])


def test_the_digest_follows_the_names_in_the_graph(tmp_path: Path) -> None:
    # Proves that weights beside the file count, also for a graph that was given another name: they have kept theirs.
    # Oracle: one bit of them changed; and the bytes of the graph, which do not change.
    path = tiny.vggt(tmp_path / "vggt.onnx", external=True).rename(tmp_path / "renamed.onnx")
    digest = lambda: open_session(path, contracts.VGGT).digest
    before, data = digest(), tmp_path / "vggt.onnx.data"
    assert file_parts(path) == [path, data]
    raw = bytearray(data.read_bytes())
    raw[0] ^= 1
    data.write_bytes(raw)
    assert digest() != before


def test_cuda_is_refused_where_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves the choice of the provider. Oracle: the list that onnxruntime would give.
    available = "vggtgeo.models.onnx.session.onnxruntime.get_available_providers"
    monkeypatch.setattr(available, lambda: ["CPUExecutionProvider"])
    assert choose_provider("auto") == "cpu"
    with raises("[gpu]", error=NetworkFileError):
        choose_provider("cuda")
    monkeypatch.setattr(available, lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"])
    assert choose_provider("auto") == "cuda"
    assert choose_provider("cpu") == "cpu"
