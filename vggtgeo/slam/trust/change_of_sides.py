"""Poses that change sides: corners that agreed with them no longer do, and others that contradicted them now agree.

A thing that crosses the picture contradicts poses that follow the room. Where it has become most of what is seen, it
may take them with it; then both groups change in one step, and each step explains as many corners as a good one does. A
textured board that crosses frames 100 to 139 of redkitchen took the poses along by 13 cm: in the worst step 67 % of 86
corners that had agreed still did, and all 25 that had contradicted the poses agreed. On icl-office and corridor-office
undisturbed at least 91 and 85 % stay, and fewer than ten contradict the poses at all.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np
from scipy.stats import binom

from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.finding import Finding, spans
from vggtgeo.slam.trust.steps import Step

MEMORY, LEAST_STEPS = 5, 3
"""Steps of a track that say which side it is on, and how many of them it must have been seen in."""
ONE_SIDE = 0.75
"""Share of these steps in which it agreed, or contradicted, the poses."""
STAYING, TURNING, LEVEL = 0.9, 0.2, 1e-3
"""Shares of the corners of either side that do so by chance, and the level of both binomial tests."""


def check_sides(estimate: Estimate, taken: list[Step]) -> Iterator[Finding]:
    """Steps in which the poses leave the corners that they had explained for those that they had not."""
    shares = _shares(estimate, taken)
    for first, last in spans(np.array([share is not None for share in shares], bool), join=2):
        stay, turn = min(share for share in shares[first : last + 1] if share is not None)
        start, end = int(estimate.frames[first]), int(estimate.frames[last + 1])
        text = (
            f"frames {start} to {end}: the poses change sides: of the corners that had agreed with them "
            f"{100 * stay:.0f} % still do, of those that had contradicted them {100 * turn:.0f} % do now: something "
            "that moves may have taken them with it"
        )
        yield Finding("change of sides", "degraded", text, start)


def _shares(estimate: Estimate, taken: list[Step]) -> list[tuple[float, float] | None]:
    """Of each step in which the poses change sides, the shares of either side that agree with them; None of others."""
    found: list[tuple[float, float] | None] = []
    sides: dict[int, deque[bool]] = {}
    for row, step in enumerate(taken):
        known = bool(estimate.tracked[row] and estimate.tracked[row + 1])
        side = np.array([_side(sides.get(number)) for number in step.ids])
        stay, turn = step.agrees[side > 0], step.agrees[side < 0]
        changed = known and _leave(stay) and _turn(turn)
        found.append((float(stay.mean()), float(turn.mean())) if changed else None)
        sides = {number: sides.get(number, deque(maxlen=MEMORY)) for number in step.ids.tolist() if known}
        for memory, agrees in zip(sides.values(), step.agrees.tolist(), strict=False):
            memory.append(agrees)
    return found


def _side(agreed: deque[bool] | None) -> int:
    """1 for a track that agreed with the poses so far, -1 for one that contradicted them, 0 for others."""
    if agreed is None or len(agreed) < LEAST_STEPS:
        return 0
    share = sum(agreed) / len(agreed)
    return int(share >= ONE_SIDE) - int(share <= 1 - ONE_SIDE)


def _leave(agree: np.ndarray) -> bool:
    return bool(binom.cdf(np.count_nonzero(agree), len(agree), STAYING) < LEVEL)


def _turn(agree: np.ndarray) -> bool:
    return bool(binom.sf(np.count_nonzero(agree) - 1, len(agree), TURNING) < LEVEL)
