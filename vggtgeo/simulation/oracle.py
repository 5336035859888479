"""Ground truth of a synthetic sequence by image, for the stubs of the five roles.

Roles receive images, not frame numbers. So the oracle is itself a `Sequence`, and remembers a fingerprint of each
image.
"""

from __future__ import annotations

import zlib
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.simulation.raster import View, view_from
from vggtgeo.simulation.render import Picture
from vggtgeo.simulation.sequence import SyntheticSequence
from vggtgeo.simulation.truth import (
    VisibleEdges,
    farthest_depth,
    is_visible,
    locate,
    project,
    texture_strength,
    visible_edges,
)

_KEPT_FRAMES = 14  # about 10 MB each at 640 x 480, 3 MB at 320 x 240


@dataclass(frozen=True, eq=False)
class _Known:
    picture: Picture
    view: View
    texture: np.ndarray
    farthest: np.ndarray
    edges: list[VisibleEdges]  # empty until they are asked for, which most frames never are


@dataclass(frozen=True, eq=False)
class SimulatedOracle:
    """A `Sequence` with the ground truth of each of its images.

    kept: number of frames whose ground truth is kept in memory; others are rendered again on request.
    """

    sequence: SyntheticSequence
    kept: int = _KEPT_FRAMES
    _given: dict[tuple[int, int], int] = field(default_factory=dict, repr=False)
    _cache: OrderedDict[int, _Known] = field(default_factory=OrderedDict, repr=False)
    _poses: dict[int, np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def name(self) -> str:
        return self.sequence.name

    @property
    def camera(self) -> Camera:
        return self.sequence.camera

    @property
    def has_depth(self) -> bool:
        return self.sequence.has_depth

    @property
    def intrinsics(self) -> np.ndarray:
        """fx, fy, cx, cy, float64 [4], pixels."""
        return np.array(self.camera.intrinsics)

    def __len__(self) -> int:
        return len(self.sequence)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """Return the sequence's frames; each is known to `index_of` from then on."""
        check_selection(self.name, len(self), start, end, stride)
        for index in range(start, min(len(self), end or len(self)), stride):
            frame = self.sequence.frame(index, self._known(index).picture)
            self._given[_fingerprint(frame.image)] = index
            yield frame

    def ground_truth(self) -> Trajectory:
        return self.sequence.ground_truth()

    def index_of(self, image: np.ndarray) -> int:
        """Return the frame of an image; raise InputError for an image that is not of `frames`."""
        index = self._given.get(_fingerprint(image))
        if index is None:
            raise InputError(
                "`image` is not of this simulated sequence; stubs know only frames of the oracle's `frames()`: run the "
                "pipeline on the oracle, unchanged"
            )
        return index

    def timestamp(self, index: int) -> float:
        """Return the time, seconds."""
        return self.sequence.timestamp(index)

    def pose(self, index: int) -> np.ndarray:
        """Return the true pose, world -> camera, float64 [4, 4]."""
        if index not in self._poses:
            self._poses[index] = self.sequence.pose(index)
        return self._poses[index].copy()

    def depth(self, index: int) -> np.ndarray:
        """Return the true depth float64 [H, W], metres, NaN = none."""
        return self._known(index).picture.depth

    def glass(self, index: int) -> np.ndarray:
        """Return pixels seen through glass, bool [H, W]."""
        return self._known(index).picture.glass

    def texture(self, index: int) -> np.ndarray:
        """Return the strength of texture, float32 [H, W] in [0, 1)."""
        return self._known(index).texture

    def edges(self, index: int) -> VisibleEdges:
        """Return the visible parts of the scene's straight edges."""
        known = self._known(index)
        if not known.edges:
            known.edges.append(visible_edges(self.sequence.scene, self.pose(index), self.camera, known.picture))
        return known.edges[0]

    def correspond(self, index_i: int, index_j: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where `pixels` [n, 2] of frame i are in frame j, float64 [n, 2], and whether they are seen there,
        bool.
        """
        known = self._known(index_i)
        points, there = locate(known.view, self.pose(index_i), self.camera, known.picture, pixels)
        target, depth = project(points, self.pose(index_j), self.camera)
        return target, there & is_visible(target, depth, self._known(index_j).farthest)

    def _known(self, index: int) -> _Known:
        known = self._cache.pop(index, None) or self._learn(index)
        self._cache[index] = known
        if len(self._cache) > self.kept:
            self._cache.popitem(last=False)
        return known

    def _learn(self, index: int) -> _Known:
        picture = self.sequence.picture(index)
        view = view_from(self.sequence.scene.surfaces, self.pose(index))
        return _Known(picture, view, texture_strength(picture), farthest_depth(picture), [])


def _fingerprint(image: np.ndarray) -> tuple[int, int]:
    data = np.ascontiguousarray(image).tobytes()
    return zlib.crc32(data), zlib.adler32(data)
