"""A standard deviation that a caller states is the one that is meant, and a kernel's width counts in it."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import vggtgeo as vg

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


@pytest.mark.parametrize("sigma", [0.5, 1.0, 3.0])
def test_the_width_of_a_kernel_counts_in_standard_deviations(sigma: float) -> None:
    """With weights `1 / sigma^2`, Huber's width is reached by a residual of `width * sigma` pixels, and no earlier.
    Oracle: the kernel's two formulas, by hand.
    """
    window, width = vg.simulate_window(2, points=1, lines=0, noise=0.0, depth_error=0.0), 1.5
    for share in (0.5, 1.0, 2.0):
        shift = share * width * sigma
        target = window.observations.point_target + np.array([[shift, 0.0]])
        weight = np.full(len(target), 1 / sigma**2)
        seen = replace(window.observations, point_target=target, point_weight=weight)
        problem, _, _ = replace(window, observations=seen).pack(kernel=vg.kernels.Huber(width))
        by_hand = (share * width) ** 2 if share <= 1 else 2 * width * share * width - width**2
        found = vg.analysis.energy_terms(problem, window.truth())["points"]
        assert float(found) == pytest.approx(len(target) * by_hand / 2, rel=1e-9)


def test_a_depth_prior_of_ones_own_has_the_sigma_that_it_states() -> None:
    """The default of `DepthPrior.alpha` leaves `sigma` as it was given. Oracle: `1/2 (difference / sigma)^2`."""
    problem, initial, _ = vg.simulate_window(2, points=1, lines=0).pack()
    mean, sigma = initial.inverse_depth + SIGMA, jnp.full_like(initial.inverse_depth, SIGMA)
    prior = vg.terms.DepthPrior(mean=mean, sigma=sigma, weight=jnp.ones_like(mean))
    found = vg.analysis.energy_terms(problem.with_term(prior), initial)["depth"]
    assert float(found) == pytest.approx(mean.size / 2, rel=1e-9)
