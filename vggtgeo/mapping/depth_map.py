"""Depth of every pixel of a keyframe, and how far it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.io.errors import InputError


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Fields: depth float32 [H, W], z in metres (in the map's own unit where the scale is free), NaN = none; sigma
    float32 [H, W], its relative standard deviation; confidence float32 [H, W] in [0, 1], 0 where there is no depth.
    """

    depth: np.ndarray
    sigma: np.ndarray
    confidence: np.ndarray

    def __post_init__(self) -> None:
        for name in ("depth", "sigma", "confidence"):
            shape = getattr(self, name).shape
            if shape != self.depth.shape or len(shape) != 2:
                raise InputError(f"`{name}` has shape {shape}; it must be [H, W], as `depth` {self.depth.shape}")

    def __repr__(self) -> str:
        share = float(np.isfinite(self.depth).mean())
        return f"DepthMap({self.depth.shape[1]} x {self.depth.shape[0]}, {share:.0%} known)"

    @property
    def empty(self) -> bool:
        """Whether no pixel has a depth."""
        return not bool(np.isfinite(self.depth).any())
