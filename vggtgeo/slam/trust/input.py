"""What the input cannot be asked: frames that a reader left out, answers of networks that were refused, and a picture
of which a large part belongs to the camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from vggtgeo.io.errors import LeftOutWarning
from vggtgeo.models.onnx.bounds import Refusals
from vggtgeo.slam.perception.still_parts import StillParts
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
            f"the network of {role} answered {counts.without} of {counts.asked} times with nothing that can be used"
            + (f", and {counts.refused} of {counts.values} values were out of bounds" if counts.values else "")
            + ": left out",
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


def check_still_parts(seen: StillParts | None, left_out: bool) -> tuple[Finding, ...]:
    """Parts of the picture that stay in their place while the rest moves: whether they were left out, and whether it is
    sure that the camera carries them.
    """
    if seen is None or (left_out and seen.sure):
        return ()
    text = f"{100 * seen.share:.0f} % of the picture stays in its place while the rest moves; "
    if left_out:
        text += "that was taken for the camera's own and left out: if it is the room, the poses follow what passes it"
    elif seen.separable:
        text += "that was not left out, because frames came once or the search was off: the poses may follow it"
    else:
        text += "it cannot be told which of them is the room, and nothing was left out: the poses may follow either"
    return (Finding("still parts", "degraded", text),)
