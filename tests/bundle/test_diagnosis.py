"""What a solve reports beside its result: derivatives that are not finite, rejected terms, other frames, digits."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_terms import PositionFix

import vggtgeo as vg
from vggtgeo.bundle.diagnosis import Diagnosis, diagnose, is_finite
from vggtgeo.bundle.linearise import linearise
from vggtgeo.bundle.objective import prepared
from vggtgeo.bundle.problem import Problem, State

WINDOW = vg.simulate_window(keyframes=3, points=10, lines=1, noise=0.5)
PROBLEM, START, _ = WINDOW.pack()
CENTRES = np.asarray(WINDOW.centres)


class Range(vg.terms.PoseTerm):
    """A distance from an anchor, by a norm that has no derivative at zero."""

    anchor: jax.Array
    distance: jax.Array

    def residual(self, pose: vg.terms.PoseTerm, camera: object) -> jax.Array:
        return jnp.linalg.norm(pose.inverse().translation() - self.anchor) - self.distance


def ranges(anchor: np.ndarray) -> Problem:
    """Distances of all keyframes from one anchor, the last with no weight."""
    distance = jnp.asarray(np.linalg.norm(CENTRES - anchor, axis=1))
    anchors = jnp.asarray(np.tile(anchor, (3, 1)))
    return PROBLEM.with_term(Range(keyframe=[0, 1, 2], anchor=anchors, distance=distance, weight=[400.0, 400.0, 0.0]))


def fixes(offset: float, kernel: vg.kernels.AbstractKernel | None = None, sigma: float = 0.02) -> Problem:
    """A fix on each keyframe, all in a frame that is `offset` metres aside of the held pose's."""
    there = jnp.asarray(CENTRES + np.array([offset, 0.0, 0.0]))
    weight, kernel = jnp.full(3, sigma**-2), kernel or vg.kernels.Square()
    return PROBLEM.with_term(PositionFix(keyframe=[0, 1, 2], position=there, weight=weight, kernel=kernel))


@partial(jax.jit, static_argnames="failed")
def _diagnosed(problem: Problem, state: State, failed: bool = False) -> Diagnosis:
    del failed
    return diagnose(prepared(problem), state, state)


def said(problem: Problem, state: State, failed: bool = False) -> str:
    return " ".join(_diagnosed(problem, state).sentences(failed))


def test_a_derivative_that_is_not_finite_is_found() -> None:
    # Proves that the term, the first observation and the derivative are named, and that numbers are refused outside
    # `jit` and NaN inside. Oracle: the norm has no derivative at zero; an anchor elsewhere has none of this.
    good, bad = ranges(np.array([2.0, 0.0, 1.0])), ranges(CENTRES[0])
    assert said(good, START, failed=True) == ""
    words = said(bad, START, failed=True)
    assert "`range`" in words
    assert "derivative" in words
    assert "observation 0" in words
    assert not bool(jax.jit(lambda problem, state: is_finite(linearise(prepared(problem), state)))(bad, START))
    for function in (vg.covariances, vg.observability):
        with pytest.raises(vg.InputError, match="`range`"):
            function(bad, START)
    inside = jax.jit(vg.covariances)(bad, START)
    assert np.isnan(inside.poses).all()


def test_a_solve_says_what_is_not_finite() -> None:
    # Proves the message of a failed solve, by derivative and by value. Oracle: as above, and an infinite distance.
    bad = ranges(CENTRES[0])
    solution = jax.jit(vg.solve)(bad, START)
    assert solution.result == "nonfinite_step"
    assert "`range`" in solution.message
    assert "weights" not in solution.message
    worse = infinite(bad)
    solution = jax.jit(vg.solve)(worse, START)
    assert solution.result == "nonfinite_input"
    assert "residual of `range` is not finite, first at observation 1" in solution.message


def infinite(problem: Problem) -> Problem:
    """The second distance is infinite."""
    return problem.with_term(
        Range(
            keyframe=[0, 1, 2],
            anchor=problem.terms["range"].anchor,
            distance=problem.terms["range"].distance.at[1].set(jnp.inf),
            weight=problem.terms["range"].weight,
        ),
        replace=True,
    )


@pytest.mark.long
def test_a_gradient_at_a_failed_solve_is_not_finite() -> None:
    # Proves that no finite gradient comes of a linearisation that is not finite. Oracle: there is none.
    bad = ranges(CENTRES[0])

    def loss(distance: jax.Array) -> jax.Array:
        known = bad.terms["range"]
        term = Range(keyframe=[0, 1, 2], anchor=known.anchor, distance=distance, weight=known.weight)
        return jnp.sum(vg.solve(bad.with_term(term, replace=True), START).state.poses.translation() ** 2)

    assert np.isnan(jax.jit(jax.grad(loss))(bad.terms["range"].distance)).any()


def test_a_term_that_its_kernel_rejects_is_named() -> None:
    # Proves that a redescending kernel that drops a term is reported with the share, and that noise is not, nor a
    # kernel that goes on pulling. Oracle: positions a metre off at a stated 2 cm.
    truth = WINDOW.truth()
    for kernel in (vg.kernels.GemanMcClure(1.5), vg.kernels.Cauchy(1.5)):
        found = _diagnosed(fixes(1.0, kernel), truth)
        assert float(found.rejected[-1]) == 1
        assert "`position_fix` rejects 100%" in said(fixes(1.0, kernel), truth)
        assert "fix" not in said(fixes(0.02, kernel), truth)
    assert float(_diagnosed(fixes(1.0, vg.kernels.Huber(1.5)), truth).rejected[-1]) == 0


def test_a_held_pose_in_another_frame_is_named() -> None:
    # Proves that a held pose that contradicts positions is reported with the motion that would mend it, and one that
    # does not is not. Oracle: positions moved by a metre; at the truth a rigid motion of a metre removes all of it.
    truth = WINDOW.truth()
    found, redundancy = _diagnosed(fixes(1.0), truth), 0
    squares = 3 / 0.02**2
    assert float(found.saved[-1]) == pytest.approx(squares, rel=1e-6)
    assert np.linalg.norm(found.motion[-1][:3]) == pytest.approx(1.0, rel=1e-6)
    assert int(found.redundancy) > redundancy
    words = said(fixes(1.0), truth)
    assert "`position_fix`" in words
    assert "1 m" in words
    assert said(fixes(0.005), truth) == ""
    assert said(fixes(1.0, sigma=2.0), truth) == ""  # a metre is noise there
    relative = vg.terms.RelativePose(
        first=[0],
        second=[1],
        measured=jnp.array([[1.0, 0, 0, 0, 9.0, 0, 0]]),
        root=100 * jnp.eye(6)[None],
        weight=jnp.ones(1),
    )
    assert float(_diagnosed(PROBLEM.with_term(relative), truth).saved[-1]) == 0  # feels no common motion


def test_a_solve_without_diagnosis_is_the_same_solve() -> None:
    """The state is equal to the last digit, and the message is that of the termination; oracle: the solve with it."""
    problem, initial, _ = vg.simulate_window(keyframes=3, points=10, lines=1).pack()
    expected, found = vg.solve(problem, initial), vg.solve(problem, initial, diagnosis=False)
    assert found.diagnosis is None
    assert found.message == expected.message
    np.testing.assert_array_equal(found.state.inverse_depth, expected.state.inverse_depth)
    np.testing.assert_array_equal(found.state.poses.wxyz_xyz, expected.state.poses.wxyz_xyz)
