"""Exporters without torch: what is refused before any work, and the parts that are plain numpy or Python.

The networks themselves are exported in test_exporters_torch.py, which needs torch and the published code.
"""

import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from invoked import invoke
from reported import raises
from vggtgeo.models.exporters import request
from vggtgeo.models.exporters.attention import angle_tables, grid
from vggtgeo.models.exporters.checkout import Checkout, import_from, stand_in
from vggtgeo.models.exporters.export import difference
from vggtgeo.models.exporters.recipes import RECIPES, recipe_of
from vggtgeo.models.exporters.request import ExportError
from vggtgeo.models.exporters.weights import load_strictly, weights_of
from vggtgeo.models.onnx.contracts import CONTRACTS

RANDOM = ("--random-weights", "-o", "file.onnx", "--source", "nowhere")


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("vggt", "-o", "a.onnx", "--source", "x"), ("`--checkpoint`", "`--random-weights`", "neither")),
        (("vggt", "--checkpoint", "x.pt", *RANDOM), ("`--checkpoint`", "`--random-weights`", "both")),
        (("vgg", *RANDOM), ("`NAME`", "'vgg'", "vggt", "mlsd")),
        (("vggt", "--height", "300", *RANDOM), ("`--height`", "300", "multiples of 14", "294")),
        (("vggt", "--width", "504", *RANDOM), ("`--width`", "504", "518")),
        (("dinov3", "--width", "636", *RANDOM), ("`--width`", "636", "multiples of 16", "640")),
        (("mlsd", "--height", "480", *RANDOM), ("`--height`", "480", "512")),
        (("letr", "--variant", "resnet18", *RANDOM), ("`--variant`", "resnet18", "resnet101")),
        (("letr", "--views", "3", *RANDOM), ("`--views`", "letr")),
        (("vggt", "--views", "0", *RANDOM), ("`--views`", "0", "at least 1")),
        (("dinov3", "--tokens", "900", *RANDOM), ("`--tokens`", "dinov3")),
        (("mlsd", "--half", *RANDOM), ("`--half`", "mlsd")),
        (("moge2", *RANDOM), ("`--source`", "nowhere", "no such folder", "microsoft/MoGe")),
        (("moge2", *RANDOM, "--source", str(Path(__file__).parent)), ("`--source`", "`moge/model/v2.py`")),
        (("moge2", *RANDOM, "-o", "file.pt"), ("`--output`", "file.pt", ".onnx")),
        (("moge2", *RANDOM, "-o", "."), ("`--output`", ".onnx")),
    ],
)
def test_a_wrong_argument_is_one_clear_line(arguments: tuple[str, ...], parts: tuple[str, ...]) -> None:
    # Proves that each wrong argument ends in one line that names it, what was found and what fits. Oracle: the words.
    result = invoke("models", "export", *arguments)
    assert result.exit_code == 2, result.output
    lines = result.output.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert [part for part in parts if part not in lines[0]] == [], lines[0]


def test_a_missing_package_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that without torch the error says what to install. Oracle: the words, with torch made unimportable.
    marker = tmp_path / "code" / RECIPES["moge2"].checkout.marker
    marker.parent.mkdir(parents=True)
    marker.touch()
    monkeypatch.setitem(sys.modules, "torch", None)
    result = invoke("models", "export", "moge2", *RANDOM, "--source", str(tmp_path / "code"))
    assert result.exit_code == 2
    assert "`torch`" in result.output
    assert "pip install -e '.[export]'" in result.output
    with raises("no_such_package", error=ExportError):
        request.load("no_such_package")


SLOW = """
import signal, sys, time, types
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell starts jobs in the background without it
sys.modules.update({name: types.ModuleType(name) for name in ("torch", "onnx", "onnxscript")})
from vggtgeo.models.exporters import export
def write(recipe, request, path, *_):
    path.write_bytes(b"half of it")
    print(path.parent, flush=True, file=sys.__stdout__)  # what exporters print is not shown
    time.sleep(20)
export._write = write
from vggtgeo.cli import main
main()
"""
"""`vggtgeo`, whose exports stop in the middle of the file, without torch."""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=lambda number: number.name)
def test_an_export_that_is_ended_leaves_nothing(tmp_path: Path, number: signal.Signals) -> None:
    # Proves that SIGTERM and Ctrl-C in the middle of an export take its temporary folder away. Oracle: the folder.
    marker = tmp_path / "code" / RECIPES["mlsd"].checkout.marker
    marker.parent.mkdir(parents=True)
    marker.touch()
    arguments = ["models", "export", "mlsd", "--random-weights", "--source", tmp_path / "code"]
    command = [sys.executable, "-c", SLOW, *arguments, "-o", tmp_path / "out/mlsd.onnx"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        folder = Path(process.stdout.readline().strip())
        assert folder.parent == tmp_path / "out"
        assert [file.name for file in folder.iterdir()] == ["mlsd.onnx"]
        process.send_signal(number)
        process.wait(30)
    assert process.returncode == 128 + number
    assert list((tmp_path / "out").iterdir()) == []


def test_every_contract_can_be_exported() -> None:
    # Proves that there is a recipe for each contract, with sizes that the contract allows. Oracle: the contracts.
    assert set(RECIPES) == set(CONTRACTS)
    for name, recipe in RECIPES.items():
        assert recipe.multiple % CONTRACTS[name].multiple == 0
        request = recipe_of(name).request(Path("code"), None)
        assert request.height % recipe.multiple == request.width % recipe.multiple == 0
        assert request.random_images(-1, 1, 2).shape == (2, 3, request.height, request.width)


def test_rotary_tables_turn_by_the_distance_of_positions() -> None:
    # Proves the property that defines a rotary embedding: the product of two turned vectors depends on the difference
    # of their positions alone. Oracle: the property, on shifted grids; and a position of zero turns nothing.
    size, shift = 16, np.array([3, 5])
    positions = grid(4, 6)
    query, key = np.random.default_rng(0).normal(size=(2, size)).astype(np.float32)

    def turned(vector: np.ndarray, places: np.ndarray) -> np.ndarray:
        cosine, sine = angle_tables(places, size, 100.0)
        a, b, c, d = np.split(vector, 4)
        return vector * cosine + np.concatenate([-b, a, -d, c]) * sine

    products = turned(query, positions) @ turned(key, positions).T
    shifted = turned(query, positions + shift) @ turned(key, positions + shift).T
    np.testing.assert_allclose(shifted, products, atol=1e-4)
    np.testing.assert_allclose(turned(query, positions)[0], query, atol=1e-6)
    assert np.ptp(products) > 1  # the angles do matter


def test_code_is_imported_from_the_checkout_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that a checkout's package wins against one of the same name on the path or already imported, also when it
    # has no `__init__.py`, and that the path is restored. Oracle: two packages that say who they are.
    for folder, text in (("mine", "WHO = 'mine'"), ("code", "WHO = 'checkout'")):
        (tmp_path / folder / "clashing").mkdir(parents=True)
        (tmp_path / folder / "clashing" / "who.py").write_text(text)
    (tmp_path / "mine" / "clashing" / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path / "mine"))
    assert import_from(tmp_path, "clashing.who", "").WHO == "mine"
    checkout = Checkout("owner/name", "clashing/who.py", ("clashing",))
    before = list(sys.path)
    with checkout.importable(tmp_path / "code"):
        assert import_from(tmp_path, "clashing.who", "").WHO == "checkout"
        with pytest.raises(ExportError, match=r"clashing\.nothing.*install this"):
            import_from(tmp_path, "clashing.nothing", "install this")
    assert sys.path == before
    assert checkout.find(tmp_path) == tmp_path / "code"
    assert Checkout("owner/name", "nothing.py", ()).find(tmp_path) is None
    assert checkout.revision(tmp_path) == "owner/name@unknown"
    for name in [name for name in sys.modules if name.startswith("clashing")]:
        del sys.modules[name]


def test_a_stand_in_leaves_no_trace() -> None:
    # Proves that a module that is only lent can be imported meanwhile and is gone after. Oracle: `sys.modules`.
    with stand_in("lent_package.inner", answer=42):
        assert __import__("lent_package.inner").inner.answer == 42
    assert not [name for name in sys.modules if name.startswith("lent_package")]


def test_a_wrong_checkpoint_names_what_differs() -> None:
    # Proves that weights must fit exactly, and that the error names some of those that do not. Oracle: a state with
    # one of each fault; one that fits is loaded.
    loaded = {}
    module = SimpleNamespace(
        state_dict=lambda: {"a": np.zeros((2, 3)), "b": np.zeros(4), "c": np.zeros(1)},
        load_state_dict=lambda weights, strict: loaded.update(weights),
    )
    with pytest.raises(ExportError) as caught:
        load_strictly(module, {"a": np.zeros((3, 2)), "c": np.zeros(1), "d": np.zeros(1)}, Path("x.pt"), "a network")
    for part in ("x.pt", "a network", "1 missing: b", "1 superfluous: d", "a [3, 2] instead of [2, 3]"):
        assert part in str(caught.value)
    assert loaded == {}
    load_strictly(module, weights_of({"model": {"module.a": np.zeros((2, 3)), "b": np.ones(4), "c": np.ones(1)}}),
                  Path("x.pt"), "a network")  # fmt: skip
    assert set(loaded) == {"a", "b", "c"}
    extra = {"a": np.zeros((2, 3)), "b": np.ones(4), "c": np.ones(1), "d": np.ones(1)}
    load_strictly(module, extra, Path("x.pt"), "a network", allow_extra=True)
    assert set(loaded) == {"a", "b", "c"}


def test_difference_is_relative_to_the_largest_value() -> None:
    # Proves the measure of parity, and that it is never small when a value is NaN. Oracle: arithmetic.
    assert difference(np.array([1.0, -4.5]), np.array([1.0, -4.0])) == 0.125
    assert not difference(np.array([np.nan, 1.0]), np.array([1.0, 1.0])) <= 1e9
