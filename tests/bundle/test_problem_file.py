"""Problem and solution files: what is written is what is read, and the energy is the one the layout defines."""

import importlib.util
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import jax
import numpy as np
import pytest
from conftest import ROOT
from problem_files import SCENE, write
from reported import raises
from scenes import INTRINSICS

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.objective import energy
from vggtgeo.bundle.problem_file import LAYOUT, load_problem, save_problem, save_solution
from vggtgeo.geometry.camera_models import Pinhole


def test_a_file_is_the_problem(tmp_path: Path) -> None:
    # Proves that reading loses nothing. Oracle: the same scene packed directly, leaf by leaf.
    loaded, packed = load_problem(write(tmp_path)), SCENE.pack()
    for found, expected in zip(jax.tree.leaves(loaded[:2]), jax.tree.leaves(packed[:2]), strict=True):
        np.testing.assert_array_equal(found, expected)


class Own(Pinhole):
    """A camera model of a user."""


@pytest.mark.parametrize(("model", "given"), [(Pinhole, ()), (Own, (Own,))])
def test_a_shared_focal_length_is_saved(tmp_path: Path, model: type[Pinhole], given: tuple[type, ...]) -> None:
    # Proves that a camera class made by `shared_focal`, of the package or of a user, is written and found again.
    # Oracle: the packed class and parameters; without the user's class, the error names it.
    scene = replace(SCENE, start_intrinsics=SCENE.start_intrinsics[1:])
    problem, state, index = scene.pack(model=model, shared_focal=True)
    path = tmp_path / "shared.npz"
    save_problem(path, problem, state, index)
    loaded, again, _ = load_problem(path, terms=given)
    assert loaded.camera is problem.camera
    assert loaded.shared_focal
    np.testing.assert_array_equal(again.intrinsics, state.intrinsics)
    if given:
        with raises("shared.npz", "SharedFocalOwn"):
            load_problem(path)


def test_the_layout_is_documented() -> None:
    # Proves that the page named in the error describes every array that is asked for.
    page = (ROOT / "docs" / "reference" / "problem-file.md").read_text()
    assert [name for name in LAYOUT if f"`{name}`" not in page] == []


def test_a_solution_is_written_in_the_file_s_order(tmp_path: Path) -> None:
    # Proves the arrays of a solution: poses, intrinsics, and inverse depths by landmark. Oracle: the start itself.
    _, state, index = load_problem(write(tmp_path))
    save_solution(tmp_path / "deep" / "solution.npz", state, index)
    with np.load(tmp_path / "deep" / "solution.npz") as solution:
        np.testing.assert_allclose(solution["T"], SCENE.start_poses, atol=1e-15)
        np.testing.assert_array_equal(solution["k"], SCENE.start_intrinsics)
        np.testing.assert_array_equal(solution["d"], SCENE.start_inverse_depth)


@pytest.fixture(scope="module")
def oracle(shared_bench: Path) -> ModuleType:
    """The numpy definition of problems and their energy, written by others."""
    spec = importlib.util.spec_from_file_location("bench_problems", shared_bench / "problems.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("outliers", ["offset", "uniform"])
def test_energy_is_that_of_the_shared_definition(tmp_path: Path, oracle: ModuleType, outliers: str) -> None:
    # Proves that a file means to us what it means to its authors. Oracle: their numpy energy of the start.
    oracle.SIZES["tiny"] = {"N": 4, "P": 12, "L": 3, "S": 4}
    arrays = oracle.generate("tiny", seed=3, outliers=outliers)
    np.savez(tmp_path / "tiny.npz", **arrays)
    problem, state, index = load_problem(tmp_path / "tiny.npz")
    expected = oracle.energy(arrays, arrays["T_init"], arrays["k_init"], arrays["d_init"]).sum()
    fast = lambda problem, state: BundleAdjustment(problem).energy(state)
    for found in (jax.jit(energy)(problem, state), jax.jit(fast)(problem, state)):
        assert float(found) == pytest.approx(expected, rel=1e-10)
    np.testing.assert_array_equal(index.gather(state.inverse_depth), arrays["d_init"])
    assert INTRINSICS.shape == arrays["k_gt"].shape
