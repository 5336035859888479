"""A state of the pipeline with another map, tracker, window or camera."""

from dataclasses import replace
from typing import Any

from vggtgeo.slam.state import Slam


def changed(slam: Slam, part: str, **values: Any) -> Slam:
    """The state with these fields of one of its parts replaced: "map", "tracker", "window" or "camera"."""
    return replace(slam, **{part: replace(getattr(slam, part), **values)})
