"""What never came: frames that a reader left out, answers of networks that were refused."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from vggtgeo.io.errors import LeftOutWarning
from vggtgeo.models.onnx.bounds import Refusals
from vggtgeo.slam.trust.finding import Finding

MOST_LEFT_OUT = 0.10
"""Share of the frames; as many as may be lost while the result is called good."""


MOST_REFUSED = 0.10
"""Share of a role's answers, or of their values, as of the frames above."""


def check_refusals(refusals: Mapping[str, Refusals]) -> tuple[Finding, ...]:
    """Roles whose network gave what cannot be, or nothing at all."""
    return tuple(
        Finding(
            "network",
            "degraded",
            f"the network of {role} answered {counts.without} of {counts.asked} times with nothing that can be, and "
            f"{counts.refused} of {counts.values} values were out of bounds: they were left out",
        )
        for role, counts in refusals.items()
        if counts.share > MOST_REFUSED
    )


def check_input(warned: Iterable[Warning | str], frames: int) -> tuple[Finding, ...]:
    """Frames that a reader left out, beside `frames` that it gave."""
    missing = sum(warning.frames for warning in warned if isinstance(warning, LeftOutWarning))
    if missing <= MOST_LEFT_OUT * (missing + frames):
        return ()
    text = f"{missing} of {missing + frames} frames of the input were left out (see the warnings)"
    return (Finding("input", "degraded", text),)
