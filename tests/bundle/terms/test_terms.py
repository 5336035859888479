"""Terms: what is written by hand equals what is derived, and what is derived is that of the residual."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import oracle
import pytest
from arrow_systems import multiply, zero_step
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from own_terms import PositionFix, Sighting
from priors import prior_on
from reported import raises
from scenes import make_scene
from scipy.spatial.transform import Rotation
from vggtgeo.solvers.kernels import Barron, Cauchy, Square
from vggtgeo.solvers.schur_complement import dense_schur_complement

import vggtgeo as vg
from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.objective import Edge, edge_views, prepared
from vggtgeo.bundle.terms.landmark_edge import EdgeTerm
from vggtgeo.bundle.terms.measured_pose import quadratic
from vggtgeo.bundle.terms.node import DenseTerm, node_derivatives, node_residuals
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import Cameras
from vggtgeo.io.errors import InputError
from vggtgeo.slam.sparse_map.factors import (
    MeasuredBaseline,
    MeasuredRelativePose,
    MeasuredRotation,
    factor_terms,
)

SCENE = make_scene(noise=0.7, outliers=0.3, depth_error=0.1, seed=1)
Pairs = list[tuple[Any, Any]]
BENT, TWO = (-0.2, 0.05, 0.004, -0.003), np.array([0, 1, 0])
"""A lens, and which of two cameras took each keyframe."""


@partial(jax.jit, static_argnames="exact")
def by_hand_and_derived(
    problem: vg.Problem, state: vg.State, correction: jax.Array, exact: bool = True
) -> dict[str, Pairs]:
    """What the hand-written methods give on every edge, beside the derived ones called on the same edge and data.
    exact: gradients and exact models, too.
    """
    edges, seen_along = edge_views(prepared(problem), state)

    def one(edge: Edge) -> dict[str, Pairs]:
        found = {}
        for term, seen in seen_along(edge):
            found[term.name] = [
                (term.energy(seen), EdgeTerm.energy(term, seen)),
                (term.columns(seen, None), EdgeTerm.columns(term, seen, None)),
                (term.columns(seen, correction), EdgeTerm.columns(term, seen, correction)),
            ]
            if exact:
                found[term.name] += [
                    (term.gradient(seen), EdgeTerm.gradient(term, seen)),
                    (used(term.model(seen)), used(EdgeTerm.model(term, seen))),
                ]
        return found

    return jax.vmap(one)(edges)


def used(model: Any) -> tuple[jax.Array, jax.Array]:
    """A local model without the unused corner."""
    return model.gram.at[-1, -1].set(0.0), model.coupled


@pytest.mark.long
@pytest.mark.parametrize(  # one kind of kernel, so that it is compiled once
    ("shape", "shared_focal"),
    [
        (1.0, False),
        (-2.0, False),
        pytest.param(1.0, True, marks=pytest.mark.slow),
    ],
)
def test_what_is_written_by_hand_is_what_is_derived(shape: float, shared_focal: bool) -> None:
    # Proves energy, columns (with and without a correction), gradient and exact model of points and lines, outliers,
    # absent matches and a landmark behind its target included, with two focal lengths and with one. Oracle: automatic
    # differentiation of the residual.
    scene = replace(SCENE, start_intrinsics=SCENE.start_intrinsics[int(shared_focal) :])
    problem, state, _ = scene.pack(kernel=Barron(1.5, shape), size=vg.PaddedSize(3, 8, 5, 3), shared_focal=shared_focal)
    state = eqx.tree_at(lambda s: s.inverse_depth, state, state.inverse_depth.at[0, 0].set(60.0))
    four = eqx.tree_at(lambda s: s.intrinsics, state, jnp.asarray(SCENE.start_intrinsics))
    behind = oracle.seen_from(problem, four)[:, 0, 2] < oracle.LEAST_DEPTH
    assert bool(jnp.any(behind & (problem.edges.source == 0) & (problem.terms["points"].weight[:, 0] > 0)))
    found = by_hand_and_derived(problem, state, jnp.asarray(0.7))
    assert set(found) == {"points", "lines"}
    for name, pairs in found.items():
        for number, (by_hand, derived) in enumerate(pairs):
            for one, other in zip(jax.tree.leaves(by_hand), jax.tree.leaves(derived), strict=True):
                assert bool(jnp.all(jnp.isfinite(one)))
                # Each row in its own unit: pixels a metre, a radian, a pixel, 1/m.
                size = np.abs(other).max(axis=(0, -1) if other.ndim > 1 else 0, keepdims=True)
                error = float((np.abs(one - other) / np.maximum(size, 1e-12 * np.abs(other).max())).max())
                assert error < 1e-12, (name, number, error)


@pytest.mark.parametrize(
    ("camera", "lens", "shared_focal", "groups"),
    [
        pytest.param(vg.cameras.RadialTangential, BENT, True, None, marks=pytest.mark.long),
        (vg.cameras.RadialTangential, BENT, True, TWO),
        pytest.param(vg.cameras.KannalaBrandt, (0.03, -0.01, 0.004, -0.001), False, TWO, marks=pytest.mark.long),
    ],
    ids=["bent, one", "bent, two", "fisheye, two"],
)
def test_columns_with_any_camera_are_what_is_derived(
    camera: type[vg.cameras.AbstractCamera], lens: tuple[float, ...], shared_focal: bool, groups: np.ndarray | None
) -> None:
    # Proves energy and columns (with and without a correction) of points and lines, free pixels in the host and several
    # cameras included, by chain rule and by automatic differentiation of the residual.
    parameters = np.array([*SCENE.start_intrinsics, *lens])[int(shared_focal) :]
    cameras = parameters if groups is None else np.stack([parameters, 1.05 * parameters])
    scene = replace(SCENE, start_intrinsics=cameras).with_observations(pixel_sigma=0.5)
    problem, state, _ = scene.pack(kernel=Cauchy(1.5), model=camera, shared_focal=shared_focal, camera_of=groups)
    state = eqx.tree_at(lambda s: s.pixel_offset, state, state.pixel_offset + 0.3)

    found = by_hand_and_derived(problem, state, jnp.asarray(0.7), exact=False)
    assert set(found) == {"points", "lines"}
    for by_hand, derived in (*found["points"], *found["lines"]):
        assert bool(jnp.all(jnp.isfinite(by_hand)))
        size = np.abs(derived).max(axis=(0, -1) if derived.ndim > 1 else 0, keepdims=True)
        assert float((np.abs(by_hand - derived) / np.maximum(size, 1e-12)).max()) < 1e-11


def test_the_prior_of_marginalisation_is_what_is_derived() -> None:
    # Proves `MarginalPrior.model`, pose by pose. Oracle: the derived one, which moves everything for every coordinate.
    _, state, _ = SCENE.pack()
    prior = replace(prior_on(state, 0.1), kernel=Cauchy(1.5))
    both = lambda *given: (prior.model(*given, False), DenseTerm.model(prior, *given, False))
    for correction in (None, jnp.asarray(0.7)):
        by_hand, derived = eqx.filter_jit(both)(state.poses, state.intrinsics, correction)
        for found, expected in zip(by_hand, derived, strict=True):
            assert oracle.gap(found, expected) < 1e-12


class LogDepth(vg.terms.SlotTerm):
    """A slot's term that a user might write."""

    log: Float[Array, "n s"]

    def residual(self, inverse_depth: Float[Array, ""]) -> Float[Array, ""]:
        return 10 * (jnp.log(inverse_depth) - self.log)


class Epipolar(vg.terms.EdgeTerm):
    """An edge's term with data of every shape: the distance of the pixel seen from the epipolar line."""

    target: Float[Array, "e p 2"]

    def residual(self, view: vg.terms.View) -> Float[Array, ""]:
        line = jnp.cross(view.relative.translation(), view.relative.rotation().as_matrix() @ view.ray)
        off = view.camera.unproject(self.target) @ line
        return 300 * off / jnp.sqrt(line[0] ** 2 + line[1] ** 2 + 1e-6) + view.inverse_depth


class SquarePixels(vg.terms.CameraTerm):
    """A camera's term: both focal lengths are nearly one."""

    def residual(self, parameters: Float[Array, " q"]) -> Float[Array, ""]:
        return jnp.log(parameters[0] / parameters[1]) * 50


def turn(*vector: float) -> np.ndarray:
    return Rotation.from_rotvec(vector).as_matrix()


def made(kind: str, problem: vg.Problem, state: vg.State) -> vg.terms.AbstractTerm:
    """A term of some kind, about keyframes 0 to 2, some distance from its optimum."""
    kernel, information = Cauchy(2.0), np.diag([400.0, 300.0, 500.0, 4e3, 3e3, 5e3])
    information[0, 4] = information[4, 0] = 500.0
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn(0.03, -0.1, 0.02), [-0.3, 0.05, 0.02]
    known = {0: 0, 1: 1, 2: 2}
    factors = {
        "baselines": [MeasuredBaseline(0, 2, 0.5, 0.1), MeasuredBaseline(1, 2, 0.1, 0.2)],
        "rotations": [MeasuredRotation(1, turn(0.1, 0, 0.05), information[3:, 3:])],
        "relative_poses": [MeasuredRelativePose(*pair, pose, information) for pair in ((2, 1), (1, 0))],
    }
    if kind in factors:
        (term,) = factor_terms(factors[kind], known, {type(factors[kind][0]): 4}, metric=True)
    elif kind == "log_depth":
        term = LogDepth(log=jnp.log(problem.terms["depth"].mean) + 0.1, weight=problem.terms["depth"].weight)
    elif kind == "epipolar":
        term = Epipolar(target=problem.terms["points"].target, weight=problem.terms["points"].weight)
    elif kind == "square_pixels":
        term = SquarePixels(weight=jnp.ones(1))
    elif kind == "sighting":
        term = Sighting(
            keyframe=[1, 2, 1],
            place=jnp.array([[0.3, 0.2, 3.0], [0.5, -0.2, 2.0], [0.0, 0, 1]]),
            pixel=jnp.array([[170.0, 130], [160, 100], [0, 0]]),
            weight=jnp.array([1.0, 0.5, 0.0]),
        )
    else:
        term = prior_on(state, 0.1)
    return replace(term, kernel=kernel)


KINDS = ("log_depth", "epipolar", "relative_poses", "sighting", "square_pixels", "marginal")
"""One of each way into the normal equations; the other terms differ in their residual alone."""


@eqx.filter_jit
def assembled(
    problem: vg.Problem, state: vg.State, along: jax.Array
) -> tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]:
    """Products of the Gauss-Newton and the exact matrix with a direction, and gradients: of the solver, and of the
    residuals and the energy of a problem of one term.
    """
    ba = BundleAdjustment(problem)
    flat, unflat = ravel_pytree(zero_step(ba, state))
    times = lambda system: ravel_pytree(multiply(system, unflat(along)))[0]
    forces = lambda system: jnp.concatenate([dense_schur_complement(system).gradient, system.landmark_gradient.ravel()])
    plain, exact = ba.linearise(state), ba.hessian(state)
    found = (times(plain), times(exact), forces(plain), forces(exact), ravel_pytree(ba.gradient(state))[0])
    slope, curved = jax.jvp(jax.grad(lambda step: vg.energy(problem, state.moved(step))), (flat,), (along,))
    (term,) = problem.terms
    residual = lambda step: vg.residuals_at(problem, state.moved(step))[term.name].reshape(*term.weight.shape, -1)
    value, pushed = jax.jvp(residual, (flat,), (along,))
    pull = term.weight * term.kernel.weight(term.weight * jnp.sum(value**2, -1))
    (normal,) = jax.vjp(residual, flat)[1](pull[..., None] * pushed)
    return found, (normal, curved, slope, slope, slope)


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_normal_equations_are_those_of_the_residual(kind: str) -> None:
    # Proves for each kind of term, a user's own among them, the assembly of matrix, exact Hessian and gradient, with a
    # robust kernel. Oracle: `J' W J` of the residuals and second derivatives of the energy, after `State.moved`.
    problem, state, _ = SCENE.pack(fixed_pose=np.zeros(3, bool), size=vg.PaddedSize(3, 6, 3, 2, 6))
    alone = problem.with_terms((made(kind, problem, state),))
    rng = np.random.default_rng(0)
    for _ in range(3):
        along = jnp.asarray(rng.normal(size=problem.num_camera + state.inverse_depth.size))
        for found, expected in zip(*assembled(alone, state, along), strict=True):
            assert oracle.gap(found, expected) < 1e-10, oracle.gap(found, expected)
            assert np.abs(expected).max() > 1e-3


def test_known_terms_by_hand() -> None:
    # Proves the energies of measured rotations, baselines and relative poses, absent ones left out. Oracle: scipy's
    # rotation vectors and matrices, in numpy.
    problem, state, _ = SCENE.pack()
    rotation, shift = Rotation.from_quat(SCENE.start_poses[:, :4], scalar_first=True), SCENE.start_poses[:, 4:]
    centres = -rotation.inv().apply(shift)
    plain = lambda kind: replace(made(kind, problem, state), kernel=Square())
    energy = lambda kind: float(eqx.filter_jit(vg.energy)(problem.with_terms((plain(kind),)), state))
    lengths = np.linalg.norm(centres[[2, 2]] - centres[[0, 1]], axis=1)
    expected = 0.5 * np.sum((np.log(lengths / [0.5, 0.1]) / [0.1, 0.2]) ** 2)
    assert energy("baselines") == pytest.approx(expected, rel=1e-9)
    off = (rotation[1] * Rotation.from_matrix(turn(0.1, 0, 0.05)).inv()).as_rotvec()
    assert energy("rotations") == pytest.approx(0.5 * off @ np.diag([4e3, 3e3, 5e3]) @ off, rel=1e-9)
    poses = jaxlie.SE3(jnp.asarray(SCENE.start_poses))
    term = plain("relative_poses")
    total = 0.0
    for row, (i, j) in enumerate([(2, 1), (1, 0)]):
        apart = jaxlie.SE3(poses.wxyz_xyz[j]) @ jaxlie.SE3(poses.wxyz_xyz[i]).inverse()
        tangent = term.root[row] @ (apart @ jaxlie.SE3(term.measured[row]).inverse()).log()
        total += 0.5 * float(tangent @ tangent)
    assert energy("relative_poses") == pytest.approx(total, rel=1e-9)


def test_a_quadratic_becomes_a_measured_pose() -> None:
    # Proves that normal equations of an alignment and their term are one function, a direction without information
    # included. Oracle: the quadratic itself, evaluated near its linearisation point.
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 6)) * [10, 10, 10, 100, 100, 100]
    hessian, gradient = root.T @ root, root.T @ rng.normal(size=5) * 1e-3
    at = jaxlie.SE3.exp(jnp.asarray(rng.normal(0, 0.5, 6)))
    measured, found = quadratic(at.wxyz_xyz[None], jnp.asarray(hessian)[None], jnp.asarray(gradient)[None])
    term = vg.terms.RelativePose(first=[0], second=[1], measured=measured, root=found, weight=jnp.ones(1)).holding(
        {"measured": measured[0], "root": found[0]}
    )
    energy = jax.jit(lambda eta: 0.5 * jnp.sum(term.residual(jaxlie.SE3.identity(), jaxlie.SE3.exp(eta) @ at) ** 2))
    step = 1e-4 * rng.normal(size=6)
    change = float(energy(jnp.asarray(step)) - energy(jnp.zeros(6)))
    assert change == pytest.approx(0.5 * step @ hessian @ step + gradient @ step, rel=1e-3)
    assert np.abs(jax.grad(energy)(jnp.zeros(6)) - gradient).max() < 1e-3 * np.abs(gradient).max()


class SecondFix(PositionFix):
    """A position of another receiver."""

    name = "second_fix"


def test_a_second_list_of_one_class_does_not_take_the_place_of_the_first() -> None:
    """Adding a second term of a name is an error that names the remedies, in `with_term` as in `pack`, and each remedy
    works: the energy of both lists is their sum. Oracle: the energies of each alone.
    """
    problem, initial, _ = SCENE.pack()
    first, second = (PositionFix(keyframe=[1], position=jnp.full((1, 3), at), weight=jnp.ones(1)) for at in (1.0, 2.0))
    one = problem.with_term(first)
    with raises("`term`", "`position_fix`", "replace=True", "`name`"):
        one.with_term(second)
    with raises("`terms`", "`position_fix`", "`name`"):
        SCENE.pack(terms=[first, second])
    size = lambda problem, name="position_fix": float(vg.analysis.energy_terms(problem, initial)[name])
    replaced = one.with_term(second, replace=True)
    assert len(replaced.terms) == len(one.terms)
    assert size(replaced) != size(one)
    both = one.with_term(SecondFix(**vars(second)))
    assert size(both) + size(both, "second_fix") == pytest.approx(size(one) + size(replaced))
    joined = PositionFix(
        keyframe=[1, 1], position=jnp.concatenate([first.position, second.position]), weight=jnp.ones(2)
    )
    assert size(problem.with_term(joined)) == pytest.approx(size(one) + size(replaced))


def test_names_and_replacement() -> None:
    # Proves how terms are found: by their class's name in snake case, replaced in place, added as the last, left out.
    problem, _, _ = SCENE.pack()
    own = LogDepth(log=problem.terms["depth"].mean, weight=problem.terms["depth"].weight)
    assert problem.with_term(own).terms.names == ("points", "lines", "depth", "intrinsics_prior", "log_depth")
    lighter = problem.terms["lines"].reweighted(0.5 * problem.terms["lines"].weight)
    changed = problem.with_term(lighter)
    assert changed.terms.names == problem.terms.names
    np.testing.assert_array_equal(changed.terms["lines"].weight, lighter.weight)
    assert problem.without_term("lines").terms.names == ("points", "depth", "intrinsics_prior")


def test_terms_are_an_ordered_collection_by_name() -> None:
    # Proves access by name and order, errors that list the existing names, and that any way to give terms is equal.
    problem, initial, _ = SCENE.pack()
    terms = problem.terms
    assert [term.name for term in terms] == list(terms.names) == ["points", "lines", "depth", "intrinsics_prior"]
    assert "lines" in terms
    assert "imu" not in terms
    assert terms["lines"] is terms.ordered[1]
    assert terms.get("lines") is terms["lines"]
    with pytest.raises(InputError, match="no term `imu`; it has points, lines, depth, intrinsics_prior"):
        _ = terms["imu"]
    empty = problem.with_terms(())
    with pytest.raises(AttributeError):
        _ = problem.points
    parts = {field.name: getattr(problem, field.name) for field in fields(problem)}
    again = (vg.Problem(**{**parts, "terms": tuple(terms)}), empty.with_terms(terms), problem.with_terms(tuple(terms)))
    assert {jax.tree.structure(given) for given in again} == {jax.tree.structure(problem)}
    jitted = jax.jit(vg.energy)
    assert len({float(jitted(given, initial)) for given in (problem, *again)}) == 1
    assert jitted._cache_size() == 1


class TwiceRelative(vg.terms.RelativePose):
    """A user's own residual on the fields of a relative pose."""

    def residual(self, first: jaxlie.SE3, second: jaxlie.SE3) -> Float[Array, "6"]:
        return 2 * super().residual(first, second) + first.translation()[0]


@pytest.mark.parametrize("kind", [vg.terms.RelativePose, TwiceRelative])
def test_derivatives_of_a_relative_pose_are_those_of_its_residual(kind: type[vg.terms.RelativePose]):
    """Derivatives by the relative tangent, carried to both poses; oracle: central differences of the residual."""
    rng = np.random.default_rng(3)
    poses, measured = (jaxlie.SE3.exp(jnp.asarray(rng.normal(size=(2, 6)))).wxyz_xyz for _ in range(2))
    root = jnp.asarray(rng.normal(size=(1, 6, 6)))
    term = kind(first=[0], second=[1], measured=measured[:1], root=root, weight=jnp.ones(1))
    cameras = Cameras(jnp.ones(4), vg.cameras.Pinhole)
    value, jacobian = (found[0] for found in node_derivatives(term, poses, cameras))

    def residual(step: np.ndarray) -> np.ndarray:
        moved = lie.move(jaxlie.SE3(poses), jnp.asarray(step).reshape(2, 6)).wxyz_xyz
        return np.asarray(node_residuals(term, moved, cameras)[:, 0])

    steps = 1e-6 * np.eye(12)
    differences = np.stack([(residual(step) - residual(-step)) / 2e-6 for step in steps], 1)
    np.testing.assert_allclose(value, residual(np.zeros(12)), atol=1e-12)
    np.testing.assert_allclose(jacobian, differences, atol=1e-7)
