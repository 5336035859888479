"""Former name of `static_overlay.py`, which `slam/verdict/input.py` still imports."""

from vggtgeo.slam.perception.static_overlay import StaticOverlay as StillParts

__all__ = ["StillParts"]
