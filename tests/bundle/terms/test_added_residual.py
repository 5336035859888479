"""A residual added to the package as CONTRIBUTING says: one file under `terms/`, and every part knows it."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import equinox as eqx
import jax.numpy as jnp
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


@pytest.fixture
def added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module, as if `terms/camera_height.py` lay in the package."""
    (tmp_path / "camera_height.py").write_text(FILE)
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
    importlib.invalidate_caches()
    yield importlib.import_module("vggtgeo.bundle.terms.camera_height")
    del sys.modules["vggtgeo.bundle.terms.camera_height"]


def test_one_file_is_all(added: ModuleType, tmp_path: Path) -> None:
    # Proves that a term which no other file names has an energy, is counted, and is saved and read without its class
    # being given (what else is done with terms by their kind: test_user_terms.py, test_term_padding.py). Oracles: the
    # energy by hand; the problem that was saved.
    truth = SCENE.at_truth()[1]
    centres = truth.poses.inverse().translation()
    heights = added.CameraHeight(keyframe=[1, 2], height=centres[1:, 1], weight=jnp.full(2, 1e8))
    problem, start, index = SCENE.pack(terms=[heights])
    off = start.poses.inverse().translation()[1:, 1] - centres[1:, 1]
    energy = float(vg.analysis.energy_terms(problem, start)["heights"])
    assert energy == pytest.approx(0.5e8 * float(jnp.sum(off**2)), rel=1e-9)
    size = vg.analysis.residual_sizes(problem, start)
    assert int(size.count["heights"]) == 2
    assert "heights" in str(size)
    path = tmp_path / "problem.npz"
    vg.save_problem(path, problem, start, index)
    assert bool(eqx.tree_equal(vg.load_problem(path)[0], problem))
