"""Findings about the input: frames that a reader skipped, invalid answers of networks, a static overlay mask."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from vggtgeo.io.errors import LeftOutWarning
from vggtgeo.models.onnx.bounds import Refusals
from vggtgeo.slam.perception.static_overlay import StaticOverlay
from vggtgeo.slam.verdict.finding import Finding
from vggtgeo.slam.verdict.thresholds import MAX_LOST


def check_refusals(refusals: Mapping[str, Refusals]) -> tuple[Finding, ...]:
    """Check for roles whose network gave invalid answers, or none."""
    return tuple(
        Finding(
            "network",
            "degraded",
            f"the network of {role} gave no valid answer {counts.without} of {counts.asked} times"
            + (f", and {counts.refused} of {counts.values} values were out of bounds" if counts.values else "")
            + ": ignored",
        )
        for role, counts in refusals.items()
        if counts.share > MAX_LOST
    )


def check_input(warned: Iterable[Warning | str], frames: int) -> tuple[Finding, ...]:
    """Check for frames that a reader skipped, beside `frames` that it gave."""
    missing = sum(warning.frames for warning in warned if isinstance(warning, LeftOutWarning))
    if missing <= MAX_LOST * (missing + frames):
        return ()
    text = f"{missing} of {missing + frames} frames of the input were left out (see the warnings)"
    return (Finding("input", "degraded", text),)


def check_static_overlay(seen: StaticOverlay | None, left_out: bool) -> tuple[Finding, ...]:
    """Check for a static part of the picture that was not masked, or may not belong to the camera."""
    if seen is None or (left_out and seen.sure):
        return ()
    text = f"{100 * seen.share:.0f} % of the picture stays in its place while the rest moves; "
    if left_out:
        text += "it was masked as the camera's own: if it is the scene, the poses follow what moves"
    elif seen.separable:
        text += "it was not masked, because frames came once or the search was off: the poses may follow it"
    else:
        text += "it is not clear which of them is the scene, and nothing was masked: the poses may follow either"
    return (Finding("still parts", "degraded", text),)
