"""Rows of the table of bad inputs: maps that were kept, and changed since."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import bad_files as bad
import numpy as np
from bad_row import Row, rows
from changed_file import with_header
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors
from vggtgeo.models.roles import Features, LineFeatures, LineMatches, PointMatches, Segments

from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.known_map import save_map
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots
from vggtgeo.slam.sparse_map.keyframe_images import KeyframeImages
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam

WIDTH, HEIGHT = bad.WIDTH, bad.HEIGHT
COUNT = 8
CAMERA = np.array([55.0, 55.0, 31.5, 23.5])


def slots(count: int) -> Slots:
    """Points at 2 m."""
    half, one = np.full(count, 0.5), np.ones(count)
    return Slots(pixels(count), half, half, 0.1 * half, one, one, 0.1 * half)


def pixels(count: int) -> np.ndarray:
    """Along a diagonal."""
    return np.linspace(5.0, 40.0, 2 * count).reshape(count, 2)


def keyframe(number: int) -> Keyframe:
    """A picture with a few key points and a segment."""
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float16)
    images = KeyframeImages(bad.picture(number), depth, depth, np.full((HEIGHT, WIDTH), 255, np.uint8))
    described = PixelDescriptors(np.eye(COUNT, 128, dtype=np.float32), np.zeros((HEIGHT, WIDTH), np.uint8))
    lines = LineFeatures(Segments(np.array([[[5.0, 5.0], [40.0, 30.0]]]), np.ones(1)), np.ones((1, 64), np.float32))
    return Keyframe(
        number=number,
        frame=number,
        timestamp=float(number),
        pose=np.eye(4),
        images=images,
        features=Features(pixels(COUNT), np.ones(COUNT), described),
        lines=lines,
        line_depths=np.full((1, 2), 2.0),
        points=slots(COUNT),
        samples=slots(2),
        sample_segment=np.zeros(2, int),
    )


def state() -> Slam:
    """Two keyframes that see the same."""
    index, sure = np.arange(COUNT), np.ones(COUNT)
    matches = PointMatches(index, index, pixels(COUNT), pixels(COUNT), sure)
    pair = Pair(0, 1, matches, LineMatches(np.zeros(1, int), np.zeros(1, int), np.ones(1)))
    motion = MeasuredRelativePose(0, 1, np.eye(4), np.eye(6))
    return Slam(
        map=Map(True, (keyframe(0), keyframe(1)), (pair,), (motion,), roots=(0,)),
        camera=CameraEstimate(intrinsics=CAMERA, given=CAMERA, sigma=0.1 * CAMERA),
    )


def changed(change: Callable[[Slam], Slam]) -> Callable[[Path], Path]:
    """Good images, and beside them a map of a state that `change` has changed."""

    def make(folder: Path) -> Path:
        save_map(folder / "office.map", change(state()))
        return bad.frames(folder / "frames")

    return make


def first(**fields: Any) -> Callable[[Path], Path]:
    """A map whose first keyframe has other fields."""
    return changed(
        lambda slam: replace(
            slam, map=replace(slam.map, keyframes=(replace(slam.keyframes[0], **fields), slam.keyframes[1]))
        )
    )


def motion(**fields: Any) -> Callable[[Path], Path]:
    """A map whose keyframes are tied otherwise."""
    return changed(lambda slam: replace(slam, map=replace(slam.map, factors=(replace(slam.map.factors[0], **fields),))))


def headed(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], Path]:
    """A map with another header."""

    def make(folder: Path) -> Path:
        made = changed(lambda slam: slam)(folder)
        with_header(folder / "office.map", change)
        return made

    return make


def cut(folder: Path) -> Path:
    """Half a map."""
    made, file = changed(lambda slam: slam)(folder), folder / "office.map"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return made


def in_a_folder(folder: Path) -> Path:
    """A folder that is called like a map."""
    (folder / "office.map").mkdir()
    return bad.frames(folder / "frames")


def with_points(points: Slots) -> Callable[[Path], Path]:
    """A map whose first keyframe has these points."""
    return first(points=points)


FAR = np.where(np.arange(2 * COUNT).reshape(COUNT, 2) == 3, 1e300, pixels(COUNT))
MAPS: list[Row] = rows(
    "Known maps",
    [
        ("a folder", in_a_folder),
        ("cut off", cut),
        ("of a newer version", headed(lambda header: header.update(version=99))),
        ("a checkpoint", headed(lambda header: header.update(vggtgeo="checkpoint"))),
        ("a field that another version has", headed(lambda header: header["classes"][1][1].append("weather"))),
        ("a pose with a NaN", first(pose=np.full((4, 4), np.nan))),
        ("key points at 1e300", first(features=replace(keyframe(0).features, pixels=FAR))),
    ],
    argv=lambda made: ["run", made, "-o", made.parent / "out", "--map", made.parent / "office.map"],
)
