"""Gauss-Newton, Levenberg-Marquardt and the Schur complement in numpy; maps use `vggtgeo.solve`.

With the residuals `r` and their Jacobian `J` by a local step, each iteration takes `dx = -(J^T W J)^-1 J^T W r` (the
weights `W` of a robust kernel, Huber and Ronchetti 2009, section 7.8) and halves it until the energy falls.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

Point = TypeVar("Point")
_GAIN = 1e-7
"""Relative decrease of the energy below which the iteration has converged."""
FIRST_DAMPING, LAST_DAMPING = 1e-5, 1e3
"""Of Levenberg-Marquardt, as a share of the diagonal of the Hessian: at the beginning, and where it gives up."""


def gauss_newton(
    start: Point,
    evaluate: Callable[[Point], tuple[float, Callable[[], np.ndarray]]],
    moved: Callable[[Point, np.ndarray], Point],
    *,
    steps: int = 10,
    trials: int = 4,
) -> Point:
    """Return the point to which Gauss-Newton with step halving descends from `start`.

    evaluate: returns the energy at a point, infinite where it is undefined, and a function that returns the step from
    there; the function is called for accepted points only. moved: applies a step to a point. trials: number of lengths
    that are tried for a step, each half of the one before.
    """
    current, (energy, step) = start, evaluate(start)
    for _ in range(steps):
        full = step()
        for halvings in range(trials):
            trial = moved(current, full * 0.5**halvings)
            # The Jacobian is behind a function, so a rejected trial costs an energy only.
            trial_energy, trial_step = evaluate(trial)
            if trial_energy < energy:
                break
        else:
            return current
        gain, current, energy, step = energy - trial_energy, trial, trial_energy, trial_step
        if gain < _GAIN * energy + 1e-12:
            return current
    return current


def levenberg_marquardt(
    start: Point,
    energy: Callable[[Point], float],
    stepped: Callable[[Point, float], Point],
    *,
    steps: int,
    gain: float,
) -> Point:
    """Return the point to which Levenberg-Marquardt descends from `start` (Nocedal and Wright 2006, section 10.3).

    energy: at a point, never negative. stepped: returns the point after a step with a damping, a share of the diagonal
    of the Hessian. The damping falls tenfold after a decrease of the energy, and rises tenfold where there is none.
    gain: relative decrease of the energy below which the iteration has converged.
    """
    damping = FIRST_DAMPING
    for _ in range(steps):
        trial = stepped(start, damping)
        before, after = energy(start), energy(trial)
        if after < before:
            start, damping = trial, max(damping / 10.0, 1e-10)
            if before - after < gain * before:
                break
        else:
            damping *= 10.0
            if damping > LAST_DAMPING:
                break
    return start


def damped_step(hessian: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Return `-H^-1 g`, with a damping of 1e-9 of the trace so that undetermined directions stay."""
    damped = hessian.copy()
    damped[np.diag_indices(len(hessian))] += 1e-9 * np.trace(hessian) + 1e-12
    return np.asarray(-np.linalg.solve(damped, gradient))


@dataclass(frozen=True, eq=False)
class SchurComplement:
    """Normal equations of n parameters after t landmarks of d numbers are eliminated (Triggs et al. 2000, section 6.1).

    matrix: float64 [n, n]; side: [n]. inverse: [t, d, d], `L^-1` of the landmarks' blocks `L L^T`; coupling: [t, d, n],
    `L^-1` times their coupling with the parameters; landmark_side: [t, d], `L^-1` times their own right-hand side.
    """

    matrix: np.ndarray
    side: np.ndarray
    inverse: np.ndarray
    coupling: np.ndarray
    landmark_side: np.ndarray

    @classmethod
    def of(cls, matrix: np.ndarray, coupling: np.ndarray, blocks: np.ndarray) -> SchurComplement:
        """Eliminate landmarks with information `blocks`, float64 [t, d, d].

        matrix: float64 [n + 1, n + 1], of the parameters, and coupling: [t, d, n + 1]; their last columns are the
        right-hand sides.
        """
        inverse = np.linalg.inv(np.linalg.cholesky(blocks))
        coupling = inverse @ coupling
        flat = coupling.reshape(-1, len(matrix))
        matrix = matrix - flat.T @ flat
        return cls(matrix[:-1, :-1], matrix[:-1, -1], inverse, coupling[:, :, :-1], coupling[:, :, -1])

    def landmarks(self, step: np.ndarray) -> np.ndarray:
        """Return the step of the landmarks, [t, d], that belongs to one of the parameters, [n]."""
        right = self.landmark_side - self.coupling @ step
        return np.asarray((np.swapaxes(self.inverse, 1, 2) @ right[:, :, None])[:, :, 0])

    def gain(self, step: np.ndarray) -> float:
        """Return the decrease of `r^T W r` that this step, [n], promises."""
        return float(np.sum(self.landmark_side**2) + self.side @ step)
