"""A residual added to the package as CONTRIBUTING says: one file under `terms/`, and every part knows it."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import make_scene

import vggtgeo as vg
import vggtgeo.bundle.terms as package

FILE = '''"""A measured height of a camera: a barometer, a known floor."""

import jaxlie
from jaxtyping import Array, Float

from vggtgeo.bundle.terms.node import PoseTerm
from vggtgeo.geometry.camera_models import AbstractCamera


class CameraHeight(PoseTerm):
    """`r = y - height`, metres, of the camera's centre."""

    height: Float[Array, " m"]

    name = "heights"
    unit = "m"

    def residual(self, pose: jaxlie.SE3, camera: AbstractCamera) -> Float[Array, ""]:
        return pose.inverse().translation()[1] - self.height
'''
SCENE = make_scene(3, 6, 0, noise=0.5, depth_error=0.05, seed=6)
SOLVER = vg.SchurLevenbergMarquardt(rtol=1e-12, max_iterations=40)


@pytest.fixture
def added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module, as if `terms/camera_height.py` lay in the package."""
    (tmp_path / "camera_height.py").write_text(FILE)
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
    importlib.invalidate_caches()
    yield importlib.import_module("vggtgeo.bundle.terms.camera_height")
    del sys.modules["vggtgeo.bundle.terms.camera_height"]


@pytest.mark.long
def test_one_file_is_all(added: ModuleType, tmp_path: Path) -> None:
    # Proves that a term which no other file names is solved (from 1 cm off), judged, marginalised, counted,
    # saved, read and batched. Oracles: the truth; the same problem without the term; the problem that was saved.
    truth = SCENE.at_truth()[1]
    centres = truth.poses.inverse().translation()
    heights = added.CameraHeight(keyframe=[1, 2], height=centres[1:, 1], weight=jnp.full(2, 1e8))
    problem, start, index = SCENE.pack(terms=[heights, vg.empty_prior(3)])
    without = problem.with_term(heights.reweighted(jnp.zeros(2)), replace=True)

    energy, size = (
        eqx.filter_jit(vg.analysis.energy_terms)(problem, start),
        eqx.filter_jit(vg.analysis.residual_sizes)(problem, start),
    )
    off = start.poses.inverse().translation()[1:, 1] - centres[1:, 1]
    assert float(energy["heights"]) == pytest.approx(0.5e8 * float(jnp.sum(off**2)), rel=1e-9)
    assert int(size.count["heights"]) == 2
    assert "heights" in str(size)

    solve = eqx.filter_jit(lambda problem: vg.solve(problem, start, solver=SOLVER).state)
    error = lambda state: float(jnp.abs((state.poses.inverse().translation() - centres)[1:, 1]).max())
    found, other = solve(problem), solve(without)
    assert error(start) > 5e-3
    assert error(found) < 5e-5, error(found)
    assert error(other) > 10 * error(found)

    sigma = lambda p: np.sqrt(np.asarray(eqx.filter_jit(vg.covariances)(p, found).poses)[2, 1, 1])
    assert sigma(problem) < 0.5 * sigma(without)
    assert "heights" in eqx.filter_jit(vg.observability)(problem, found).terms
    gone = jax.jit(vg.marginalise)
    information = lambda p: float(jnp.sum(gone(p, found, jnp.asarray(1)).root ** 2))
    assert information(problem) > information(without)

    path = tmp_path / "problem.npz"
    vg.save_problem(path, problem, start, index)
    read = vg.load_problem(path)[0]  # a class of the package needs not be given
    assert bool(eqx.tree_equal(read, problem))

    intrinsics = vg.cameras.Intrinsics(SCENE.start_intrinsics, prior_sigma=5.0)
    window = (SCENE.observations, SCENE.start_poses, intrinsics, SCENE.start_inverse_depth)
    problems, states, _ = vg.batches.pack_batch([(*window, [heights]), window])
    values = jax.vmap(vg.analysis.energy_terms)(problems, states)["heights"]
    np.testing.assert_allclose(values, [float(energy["heights"]), 0.0], rtol=1e-9)
