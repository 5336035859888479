"""Write images, cameras and tracks of a run's views, for export to other programs; compute the depth of its frames.

Views are the keyframes, or all frames. The files are `scene.npz`, `images/`, and `image-mask.png` if the undistorted
images have invalid borders.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from vggtgeo.datasets import Frame
from vggtgeo.datasets import Sequence as Frames
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.files import write_picture
from vggtgeo.io.persistence import Format, by_name
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.mapping.frame_depth import FrameDepths
from vggtgeo.mapping.tracks import Tracks, make_tracks
from vggtgeo.models.classical import SensorDepth
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam, submaps_by_size
from vggtgeo.slam.threads import map_in_threads

MASK = "image-mask.png"
JPEG_QUALITY = 95
BATCH = 16
"""Number of frames in memory at a time. A run keeps the images of its keyframes only, so others are read again."""


def image_name(frame: int) -> str:
    """Return the name of a frame's image in `images/`."""
    return f"{frame:06d}.jpg"


@dataclass(frozen=True, eq=False)
class Scene:
    """Views of a map: its keyframes, and other frames whose images were written.

    Fields: frames int [k], frame number of each view; timestamps float64 [k], s; poses float64 [k, 4, 4],
    world -> camera; intrinsics float64 [4], pixels, of the undistorted images; size (width, height); tracks, whose view
    numbers index these arrays; metric, whether lengths are metres.
    """

    frames: np.ndarray
    timestamps: np.ndarray
    poses: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]
    tracks: Tracks
    metric: bool

    @classmethod
    def of(cls, slam: Slam) -> Scene:
        """Return the scene of the largest submap, the one in `map.ply`, since the poses relative to others are unknown.

        `slam` must have a keyframe.
        """
        keyframes = _largest_submap(slam)
        numbers = {keyframe.number for keyframe in keyframes}
        pairs = [pair for pair in slam.map.pairs if numbers.issuperset(pair.key)]
        height, width = keyframes[0].size
        return cls(
            np.array([keyframe.frame for keyframe in keyframes]),
            np.array([keyframe.timestamp for keyframe in keyframes]),
            np.array([keyframe.pose for keyframe in keyframes]),
            np.asarray(slam.intrinsics, np.float64),
            (width, height),
            make_tracks(keyframes, pairs, slam.intrinsics),
            slam.metric,
        )

    def image_name(self, view: int) -> str:
        """Return the file name of a view's image in `images/`."""
        return image_name(int(self.frames[view]))

    def with_frames(self, others: Sequence[tuple[int, float, np.ndarray]]) -> Scene:
        """Return the scene with more views, sorted by frame number; each is (frame number, time in s, pose).

        Poses are world -> camera. The new views observe no points.
        """
        if not others:
            return self
        numbers, times, poses = zip(*others, strict=True)
        frames = np.concatenate([self.frames, numbers])
        order = np.argsort(frames, kind="stable")
        place = np.argsort(order, kind="stable")
        return replace(
            self,
            frames=frames[order],
            timestamps=np.concatenate([self.timestamps, times])[order],
            poses=np.concatenate([self.poses, poses])[order],
            tracks=replace(self.tracks, view=place[self.tracks.view]),
        )

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Scene:
        """Load `scene.npz` of a run's folder; raise InputError if it is missing, invalid or of another version."""
        scene: Scene = SCENE.read(Path(folder) / "scene.npz")[0]
        return scene


SCENE = Format("scene", 2, by_name((Scene, Tracks)))


def _largest_submap(slam: Slam) -> tuple[Keyframe, ...]:
    return tuple(slam.keyframes[number] for number in submaps_by_size(slam)[0])


def write_scene(folder: Path, slam: Slam, valid: np.ndarray | None = None, frames: Frames | None = None) -> None:
    """Write `scene.npz` and the undistorted image of each keyframe in `images/`, each atomically.

    valid: bool [H, W], pixels of the undistorted images that the original images cover; saved as `image-mask.png`,
    white if valid. frames: the frames that the run read, to write the image of every frame of the same submap, too.
    """
    scene = Scene.of(slam)
    for view, keyframe in enumerate(_largest_submap(slam)):
        _write_image(folder / "images" / scene.image_name(view), keyframe.image)
    if frames is not None:
        scene = scene.with_frames(list(_other_frames(folder / "images", slam, scene, frames)))
    if valid is not None:
        write_picture(folder / MASK, np.where(valid, 255, 0).astype(np.uint8))
    SCENE.write(folder / "scene.npz", scene)


def _other_frames(folder: Path, slam: Slam, scene: Scene, frames: Frames) -> Iterator[tuple[int, float, np.ndarray]]:
    """Write the images of tracked frames that are not views yet; yield number, time and pose, world -> camera."""
    submap, poses = {keyframe.number for keyframe in _largest_submap(slam)}, frame_poses(slam)[1]
    known, undistorter = set(scene.frames.tolist()), (slam.camera.lens or frames.camera).undistorter()
    for row, frame in reread_frames(slam, frames):
        record = slam.frames[row]
        if record.tracked and record.reference in submap and record.frame not in known:
            _write_image(folder / image_name(record.frame), undistorter.image(frame.image))
            yield record.frame, record.timestamp, poses[row]


def _write_image(path: Path, image: np.ndarray) -> None:
    bgr = np.ascontiguousarray(image[..., ::-1])
    write_picture(path, bgr, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))


def reread_frames(slam: Slam, frames: Frames) -> Iterator[tuple[int, Frame]]:
    """Yield each row of `slam.frames` with its frame, as read from `frames`; skip frames that cannot be read.

    Raises:
        InputError: the image size of `frames` differs from that of the run.

    """
    row_of = {record.frame: row for row, record in enumerate(slam.frames)}
    if not row_of:
        return
    height, width = slam.keyframes[0].size
    if (frames.camera.width, frames.camera.height) != (width, height):
        raise InputError(
            f"`frames` must have images of {width} x {height} pixels as in the run, got {frames.camera.width} x "
            f"{frames.camera.height}: pass the frames that the run read"
        )
    numbers = sorted(row_of)
    stride = int(np.gcd.reduce(np.diff(numbers))) if len(numbers) > 1 else 1
    with warnings.catch_warnings():  # of unreadable frames, which the run has reported
        warnings.simplefilter("ignore", InputWarning)
        for frame in frames.frames(numbers[0], numbers[-1] + 1, stride):
            if frame.index in row_of:
                yield row_of[frame.index], frame


def depth_of_frames(
    slam: Slam, depth_maps: Sequence[DepthMap | None], frames: Frames | None = None
) -> Iterator[tuple[int, DepthMap | None]]:
    """Yield frame number and depth of every frame, in order; see `FrameDepths`.

    Args:
        slam: state after the last adjustment.
        depth_maps: dense depth of the keyframes.
        frames: the frames that the run read. Their depth images are undistorted as in the run and get the noise model
            of a depth camera; depth of keyframes fills the holes. None: depth of keyframes only.

    Raises:
        InputError: the image size of `frames` differs from that of the run.

    """
    depths, rows = FrameDepths(slam, depth_maps), iter(_sensor_depths(slam, frames))
    while batch := list(islice(rows, BATCH)):
        found = map_in_threads(lambda pair: depths.of(*pair), batch)
        yield from ((slam.frames[row].frame, depth) for (row, _), depth in zip(batch, found, strict=True))


def _sensor_depths(slam: Slam, frames: Frames | None) -> Iterator[tuple[int, DepthMap | None]]:
    """Yield all rows of `slam.frames`, each with the frame's undistorted depth image, if it has one."""
    unread = set(range(len(slam.frames)))
    if frames is not None and frames.has_depth and slam.metric:
        undistorter, sensor = (slam.camera.lens or frames.camera).undistorter(), SensorDepth()
        for row, frame in reread_frames(slam, frames):
            unread.remove(row)
            depth = None
            if frame.depth is not None:
                found = sensor.estimate(frame.image, undistorter.depth(frame.depth))
                depth = DepthMap(found.depth, found.sigma_rel, found.confidence)
            yield row, depth
    yield from ((row, None) for row in sorted(unread))
