"""What weights and standard deviations mean: one number for a whole term, a stated sigma."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_terms import SCENE, PointToPlane, PositionFix, StepOfWheels

import vggtgeo as vg


class SquarePixels(vg.terms.CameraTerm):
    """Both focal lengths are one."""

    def residual(self, parameters: jax.Array) -> jax.Array:
        return parameters[0] - parameters[1] - 1.0


CENTRES, KEYFRAMES = jnp.arange(6.0).reshape(2, 3), [0, 2]
STEPS = jnp.arange(6.0).reshape(2, 3)
KINDS = {
    "pose": lambda **weight: PositionFix(keyframe=KEYFRAMES, position=CENTRES, **weight),
    "pair": lambda **weight: StepOfWheels(first=[0, 1], second=[1, 2], measured=STEPS, **weight),
    "camera": SquarePixels,
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("given", [{}, {"weight": 2.5}], ids=["default", "number"])
def test_one_number_is_the_weight_of_each_observation(kind: str, given: dict[str, float]) -> None:
    """A term with one number as weight, its default in particular, has the energy of one with a list of it, in
    `with_term` and in `pack`. Oracle: the list, written out.
    """
    problem, initial, _ = SCENE.pack()
    count = 1 if kind == "camera" else 2
    listed = KINDS[kind](weight=jnp.full(count, given.get("weight", 1.0)))
    name, short = listed.name, KINDS[kind](**given)
    expected = vg.analysis.energy_terms(problem.with_term(listed), initial)[name]
    assert float(expected) > 0
    packed, start, _ = SCENE.pack(terms=[short])
    for found, state in ((problem.with_term(short), initial), (packed, start)):
        assert found.terms[name].weight.shape == (count,)
        assert float(vg.analysis.energy_terms(found, state)[name]) == pytest.approx(float(expected), rel=1e-12)


def test_one_number_is_the_weight_of_each_row_of_a_flat_term() -> None:
    """The same of a `FlatTerm`. Oracle: a list of that number."""
    rows = {"normal": np.tile([0.0, 0.0, 1.0], (3, 1)), "distance": np.full(3, 2.0)}
    at = {"landmark": SCENE.observations.point_landmark[:3], "edge": SCENE.observations.point_edge[:3]}
    one, listed = (
        SCENE.pack(terms=[vg.terms.FlatTerm(PointToPlane, {**rows, "weight": weight}, **at)])[0]
        .terms["point_to_plane"]
        .weight
        for weight in (2.0, np.full(3, 2.0))
    )
    assert float(one.sum()) == 6.0
    np.testing.assert_array_equal(one, listed)


SIGMA = 0.1
"""1/m, of a depth."""


def known_depth(**options: float) -> vg.Observations:
    """A window in which landmark 0 has no match of any weight, and depths of a stated standard deviation."""
    seen = vg.simulate_window(3, points=10, lines=0).observations
    fields = {name: value for name, value in vars(seen).items() if name != "alpha"}
    weight = np.where(seen.point_landmark == 0, 0.0, seen.point_weight)
    stated = np.full(len(seen.host), SIGMA)
    return vg.Observations(**{**fields, "point_weight": weight, "depth_sigma": stated, **options})


@pytest.mark.parametrize(("options", "factor"), [({}, 1.0), ({"alpha": 2.0}, 2.0), ({"alpha": 0.25}, 0.25)])
def test_a_stated_sigma_of_a_depth_is_its_standard_deviation(options: dict[str, float], factor: float) -> None:
    """Where a depth prior alone determines a landmark, `covariances` gives back the variance that was stated, over the
    `alpha` that was stated. Oracle: the definition `sigma^2 / alpha`.
    """
    window = replace(vg.simulate_window(3, points=10, lines=0), observations=known_depth(**options))
    problem, initial, index = window.pack(kernel=vg.kernels.Square())
    found = index.gather(vg.covariances(problem, initial).inverse_depth)[0]
    assert found == pytest.approx(SIGMA**2 / factor, rel=1e-9)
