"""How many examples a property is tried on: some in the tests, as many as are asked for by `make fuzz`."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from hypothesis import HealthCheck, Phase, settings

COUNT = int(os.environ.get("VGGTGEO_FUZZ", "0"))
"""Examples of each property; 0: those of the tests."""


def examples(quick: int) -> Callable[[Any], Any]:
    """`quick` examples, the same every time; in a campaign `COUNT` others, with what reproduces a finding printed.

    Nothing is timed: a first example compiles for seconds. Nothing is kept on the disk between two calls, so that a
    test depends on its code alone.
    """
    return settings(
        max_examples=COUNT or quick,
        derandomize=not COUNT,
        phases=[phase for phase in Phase if phase != Phase.explain],  # explaining traces every line
        print_blob=bool(COUNT),
        deadline=None,
        database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
