"""Exporters without torch: what is refused before any work, and the parts that are plain numpy or Python.

The networks themselves are exported in test_exporters_torch.py, which needs torch and the published code.
"""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from invoked import invoke
from reported import raises
from vggtgeo.models.exporters.attention import angle_tables, grid
from vggtgeo.models.exporters.network import Checkout, load
from vggtgeo.models.exporters.recipes import RECIPES, recipe_of
from vggtgeo.models.onnx.contracts import CONTRACTS, relative_difference

RANDOM = ("--random-weights", "-o", "file.onnx", "--source", "nowhere")


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
    with raises("no_such_package"):
        load("no_such_package")


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
    checkout = Checkout("owner/name", "clashing/who.py", ("clashing",), hint="install this")
    assert importlib.import_module("clashing.who").WHO == "mine"
    before = list(sys.path)
    with checkout.importable(tmp_path / "code") as imported:
        assert imported("clashing.who").WHO == "checkout"
        with raises("clashing.nothing", "install this"):
            imported("clashing.nothing")
    assert sys.path == before
    assert checkout.find(tmp_path) == tmp_path / "code"
    assert Checkout("owner/name", "nothing.py", ()).find(tmp_path) is None
    assert checkout.revision(tmp_path) == "owner/name@unknown"
    for name in [name for name in sys.modules if name.startswith("clashing")]:
        del sys.modules[name]


def test_difference_is_relative_to_the_largest_value() -> None:
    # Proves the measure of parity, and that it is never small when a value is NaN. Oracle: arithmetic.
    assert relative_difference(np.array([1.0, -4.5]), np.array([1.0, -4.0])) == 0.125
    assert not relative_difference(np.array([np.nan, 1.0]), np.array([1.0, 1.0])) <= 1e9
