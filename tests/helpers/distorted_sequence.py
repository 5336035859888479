"""A sequence, and a window of matches, seen through a lens that distorts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import vggtgeo as vg
from vggtgeo.datasets import Frame
from vggtgeo.geometry.camera import Camera

WINDOW = {"keyframes": 12, "points": 100, "lines": 0, "noise": 0.5, "depth_error": 0.005, "start_error": 0.01}
"""Of `simulate_window`: enough views to tell what camera took them."""
_solve = eqx.filter_jit(vg.solve)


def adjusted(problem: vg.Problem, state: vg.State) -> vg.State:
    """The state that fits the matches."""
    return _solve(problem, state).state


class Bent:
    """A simulated sequence as a lens draws it, whose camera nobody knows."""

    def __init__(self, source: Any, lens: Camera) -> None:
        self.source, self.name, self.has_depth, self.lens = source, source.name, False, lens
        self.camera = Camera.guess(self.lens.width, self.lens.height)

    def __len__(self) -> int:
        return len(self.source)

    def ground_truth(self) -> Any:
        return self.source.ground_truth()

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Any:
        y, x = np.mgrid[: self.lens.height, : self.lens.width].astype(np.float64)
        u, v = self.lens.undistorted(np.stack([x, y], -1)).astype(np.float32).transpose(2, 0, 1)
        for frame in self.source.frames(start, end, stride):
            image = cv2.remap(frame.image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            yield Frame(frame.index, frame.timestamp, image, None, frame.name)


def bent(window: vg.data.SimulatedWindow, *distortion: float, squeeze: float = 1.0) -> vg.data.SimulatedWindow:
    """Its key points and matches as a lens of these k1 and k2 draws them, in images of `squeeze` times the width."""
    lens = vg.cameras.RadialTangential(jnp.asarray([*window.intrinsics, *distortion, 0.0, 0.0]))
    straight = vg.cameras.Pinhole(jnp.asarray(window.intrinsics))
    bend = jax.jit(jax.vmap(lambda pixel: lens.project(straight.unproject(pixel))))
    drawn = lambda pixels: (np.asarray(bend(jnp.asarray(pixels))) + 0.5) * np.array([squeeze, 1.0]) - 0.5
    seen = window.observations
    return replace(window, observations=replace(seen, point_target=drawn(seen.point_target), pixel=drawn(seen.pixel)))
