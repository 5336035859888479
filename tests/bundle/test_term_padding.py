"""Terms of any class are padded, batched, saved and read by their kind: nothing that is done so knows them by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from own_terms import SCENE, LogCosh, PointToPlane, PositionFix, StepOfWheels, own_terms
from reported import raises

import vggtgeo as vg
from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.marginalisation import permute_prior

OWN = [PositionFix, StepOfWheels, PointToPlane, LogCosh]
LARGER = vg.PaddedSize(5, 8, 4, 4, terms=(("position_fix", 4), ("step_of_wheels", 3)))
Packed = tuple[vg.Problem, vg.State, object]


@eqx.filter_jit
def energy_and_gradient(problem: vg.Problem, state: vg.State) -> tuple[jax.Array, vg.State]:
    ba = BundleAdjustment(problem)
    gradient = ba.gradient(state)
    split = 6 * problem.num_keyframes
    poses = gradient.dense[:split].reshape(-1, 6)
    return ba.energy(state), (poses, gradient.dense[split:], gradient.landmarks)


@pytest.fixture(scope="module")
def packed() -> Packed:
    return SCENE.pack(terms=own_terms())


def test_a_small_weight_has_the_derivative_that_a_weight_of_0_lacks() -> None:
    """By a weight of 0 the energy has derivative 0, though it rises when the weight does; by a small positive weight it
    has that one-sided slope. Oracle: a one-sided difference.
    """
    window = vg.simulate_window(2, points=3, lines=0)
    problem, initial, _ = window.pack(kernel=vg.kernels.Square())
    energy = jax.jit(lambda weight: vg.energy(problem.with_term(problem.terms["points"].reweighted(weight)), initial))
    absent = problem.terms["points"].weight.at[0, 0].set(0.0)
    slope = float((energy(absent.at[0, 0].set(1e-3)) - energy(absent)) / 1e-3)
    derivative = jax.jit(jax.grad(energy))
    assert slope > 1e-3
    assert float(derivative(absent)[0, 0]) == 0.0
    assert float(derivative(absent.at[0, 0].set(1e-6))[0, 0]) == pytest.approx(slope, rel=1e-6)


@pytest.mark.long
def test_padding_changes_neither_energy_nor_gradient(packed) -> None:
    # Proves that room for more keyframes, edges, landmarks and observations says nothing, for terms on edges, poses
    # and pairs and a marginal prior. Oracle: the problem without room; with one observation less it differs.
    prior = vg.empty_prior(3)
    rng = np.random.default_rng(0)
    prior = eqx.tree_at(lambda t: (t.root, t.offset), prior, (rng.normal(size=(22, 22)), rng.normal(size=22)))
    terms = [*own_terms(), prior]
    (tight, start, index), (roomy, larger, other) = SCENE.pack(terms=terms), SCENE.pack(terms=terms, size=LARGER)
    assert roomy.terms["position_fix"].weight.shape == (4,)
    assert roomy.terms["step_of_wheels"].measured.shape == (3, 3)
    assert roomy.terms["point_to_plane"].normal.shape == (20, 12, 3)
    assert roomy.terms["marginal"].root.shape == (34, 34)
    assert set(energy_terms(tight, start)) == set(energy_terms(roomy, larger))
    for name, value in energy_terms(tight, start).items():
        assert float(value) > 0 or name == "intrinsics_prior", name
        assert float(energy_terms(roomy, larger)[name]) == pytest.approx(float(value), rel=1e-12), name
    energy, (poses, camera, landmarks) = energy_and_gradient(tight, start)
    same, (more_poses, same_camera, more_landmarks) = energy_and_gradient(roomy, larger)
    assert float(same) == pytest.approx(float(energy), rel=1e-12)
    size = float(jnp.abs(ravel_pytree(poses)[0]).max())
    np.testing.assert_allclose(more_poses[:3], poses, atol=1e-12 * size)
    np.testing.assert_allclose(more_poses[3:], 0.0, atol=0)
    np.testing.assert_allclose(same_camera, camera, atol=1e-12 * size)
    np.testing.assert_allclose(other.gather(more_landmarks), index.gather(landmarks), rtol=1e-9, atol=1e-12 * size)
    fix = roomy.terms["position_fix"]
    missing = roomy.with_term(fix.reweighted(fix.weight.at[1].set(0.0)), replace=True)
    assert float(energy_terms(missing, larger)["position_fix"]) < float(energy_terms(roomy, larger)["position_fix"])


energy_terms = eqx.filter_jit(vg.analysis.energy_terms)


def test_a_prior_of_more_keyframes_says_nothing_about_them() -> None:
    # Proves how a dense prior grows. Oracle: `permute_prior`, which puts unknown keyframes behind the known ones.
    prior = vg.empty_prior(2)
    rng = np.random.default_rng(0)
    prior = eqx.tree_at(lambda t: (t.root, t.offset), prior, (rng.normal(size=(16, 16)), rng.normal(size=16)))
    grown = prior.padded(3)
    np.testing.assert_array_equal(grown.root[:16], permute_prior(prior, np.array([0, 1, -1])).root)
    assert float(jnp.abs(grown.root[16:]).max()) == 0.0
    assert grown.padded(3) is grown
    with raises("marginal", 3, 2):
        grown.padded(2)


def test_a_file_gives_back_every_leaf(tmp_path: Path, packed) -> None:
    # Proves that own terms and an own kernel are saved and read without loss. Oracle: the problem itself, bit by bit,
    # and that the structure (classes, static fields) is equal.
    problem, state, index = packed
    path = tmp_path / "own.npz"
    vg.save_problem(path, problem, state, index)
    read = vg.load_problem(path, terms=OWN)
    assert jax.tree.structure(read[:2]) == jax.tree.structure((problem, state))
    for found, expected in zip(jax.tree.leaves(read[:2]), jax.tree.leaves((problem, state)), strict=True):
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(read[2].gather(state.inverse_depth), SCENE.start_inverse_depth)
    half = vg.load_problem(path, np.float32, terms=OWN)
    assert {leaf.dtype for leaf in jax.tree.leaves(half[1])} == {np.dtype(np.float32)}


@pytest.mark.long
def test_a_batch_of_windows_with_different_terms(packed) -> None:
    # Proves that windows may differ in which own terms they have and how many observations of each. Oracle: the energy
    # and gradient of each window packed alone.
    fix, wheels, planes = own_terms()
    one = PositionFix(keyframe=[2], position=fix.position[1:], weight=fix.weight[1:], kernel=LogCosh())
    rows = {**planes.rows(), **planes.shared()}
    some = replace(
        planes, fields={k: v[:5] for k, v in rows.items()}, landmark=planes.landmark[:5], edge=planes.edge[:5]
    )
    intrinsics = vg.cameras.Intrinsics(SCENE.start_intrinsics, prior_sigma=5.0)
    window = (SCENE.observations, SCENE.start_poses, intrinsics, SCENE.start_inverse_depth)
    lists = [[fix, wheels, planes], [one, some], []]
    problems, states, _ = vg.batches.pack_batch([(*window, terms) for terms in lists])
    assert problems.terms["position_fix"].weight.shape == (3, 2)
    found, gradients = jax.vmap(energy_and_gradient)(problems, states)
    for number, terms in enumerate(lists):
        energy, gradient = energy_and_gradient(*SCENE.pack(terms=terms)[:2])
        assert float(found[number]) == pytest.approx(float(energy), rel=1e-12)
        for batched, alone in zip(gradients, gradient, strict=True):
            np.testing.assert_allclose(batched[number], alone, rtol=1e-9, atol=1e-9 * float(jnp.abs(alone).max()))
