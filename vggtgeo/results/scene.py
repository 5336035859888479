"""Images, cameras and tracks of a run's views, for export to other programs.

Views are the keyframes, or all frames. Files: `scene.npz`, `images/`, and `image-mask.png` if the undistorted images
have invalid borders. `scene.npz` contains plain arrays, no pickles; `version` is that of its layout.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from vggtgeo.datasets import Sequence as Frames
from vggtgeo.geometry import rigid
from vggtgeo.io.archives import Archive, ArrayHeader, read_archive
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open
from vggtgeo.io.pictures import write_picture
from vggtgeo.mapping.tracks import Tracks, make_tracks
from vggtgeo.results.reread_frames import reread_frames
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.submaps import pieces_by_size

VERSION = 1
MASK = "image-mask.png"
JPEG_QUALITY = 95
_LAYOUT: dict[str, tuple[int | str, ...]] = {
    "frames": ("k",),
    "timestamps": ("k",),
    "poses": ("k", 4, 4),
    "intrinsics": (4,),
    "size": (2,),
    "metric": (),
    "track_points": ("n", 3),
    "track_colours": ("n", 3),
    "track_point": ("m",),
    "track_view": ("m",),
    "track_pixel": ("m", 2),
}
"""Shapes of the arrays: `k` views, `n` points, `m` observations."""
_MAX_COORDINATE, _MAX_PIXEL = 1e10, 1e7
_MAX_SIDE = 100_000
"""Pixels."""
_ROTATION_TOLERANCE = 1e-3
"""Largest entry of `R R^T - I`."""
_TIME_TOLERANCE, _POSITION_TOLERANCE = 1e-5, 1e-4
"""Seconds, and relative length: the rounding of pose files."""
_INTEGERS = ("frames", "size", "track_point", "track_view")


def image_name(frame: int) -> str:
    """Return the name of a frame's image in `images/`."""
    return f"{frame:06d}.jpg"


@dataclass(frozen=True, eq=False)
class Scene:
    """Views of a map: its keyframes, and other frames whose images were written.

    Fields: frames int [k], frame number of each view; timestamps float64 [k], s; poses float64 [k, 4, 4],
    world -> camera; intrinsics float64 [4], pixels, of the undistorted images; size (width, height); tracks, whose
    view numbers index these arrays; metric: whether lengths are metres.
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
        """Return the scene of the largest submap, as `map.ply`: the pose of other submaps relative to it is unknown.

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

    def mismatch(self, times: np.ndarray, centres: np.ndarray) -> str:
        """Describe the first view that is not one of these poses (times [n], s, and camera centres [n, 3]); empty if
        there is none.
        """
        order = np.argsort(times, kind="stable")
        times, centres = times[order], centres[order]
        own = rigid.invert(self.poses)[:, :3, 3]
        first, behind = (np.searchsorted(times, self.timestamps + span) for span in (-_TIME_TOLERANCE, _TIME_TOLERANCE))
        for view, (low, high) in enumerate(zip(first, behind, strict=True)):
            if low == high:
                return f"frame {self.frames[view]} has no pose at its time"
            off = np.linalg.norm(centres[low:high] - own[view], axis=1).min()
            if off > _POSITION_TOLERANCE * (1.0 + np.linalg.norm(own[view])):
                return f"the poses of frame {self.frames[view]} differ by {off:.3g}"
        return ""

    def with_frames(self, others: Sequence[tuple[int, float, np.ndarray]]) -> Scene:
        """Return the scene with more views, which observe no points; each is (frame number, time in s, pose
        world -> camera). Views are sorted by frame number.
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
        """Load `scene.npz` of a run's folder; raise InputError if it is missing, invalid or of another layout."""
        path = Path(folder) / "scene.npz"
        try:
            return cls._of(read_archive(path, "the scene of a run", _read))
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"`{path}` is invalid ({error}); give a folder that `vggtgeo run` wrote") from None

    @classmethod
    def _of(cls, values: Mapping[str, np.ndarray]) -> Scene:
        count = len(values["frames"])
        poses, (width, height) = values["poses"], values["size"]
        tracks = Tracks(*(values[f"track_{name}"] for name in ("points", "colours", "point", "view", "pixel")))
        if not (len(tracks.point) == len(tracks.view) == len(tracks.pixel)):
            raise ValueError("`track_point`, `track_view` and `track_pixel` must have equal lengths")
        if len(tracks.point) and not (0 <= tracks.view.min() <= tracks.view.max() < count):
            raise ValueError(f"`track_view` must be in [0, {count})")
        if len(tracks.point) and not (0 <= tracks.point.min() <= tracks.point.max() < len(tracks)):
            raise ValueError(f"`track_point` must be in [0, {len(tracks)})")
        if len(np.unique(values["frames"])) != count or not np.isfinite(values["timestamps"]).all():
            raise ValueError("`frames` must be distinct and `timestamps` finite")
        size, intrinsics = (int(width), int(height)), values["intrinsics"]
        wrong = _invalid_value(poses, intrinsics, size, tracks)
        if wrong:
            raise ValueError(wrong)
        return cls(values["frames"], values["timestamps"], poses, intrinsics, size, tracks, bool(values["metric"]))


def _invalid_value(poses: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], tracks: Tracks) -> str | None:
    """Describe the first invalid value, if any: the programs that import an export do not check."""
    if not len(poses):
        return "`frames` is empty"
    if not (0 < min(size) <= max(size) <= _MAX_SIDE):
        return f"`size` is {size[0]} x {size[1]} pixels, at most {_MAX_SIDE} a side"
    if not (np.isfinite(intrinsics).all() and (intrinsics[:2] > 0).all() and np.abs(intrinsics).max() < _MAX_PIXEL):
        return f"`intrinsics` is {intrinsics}; it must be finite, with positive focal lengths"
    rotations = poses[:, :3, :3].astype(np.float64)
    if not (
        np.isfinite(poses).all()
        and np.abs(poses).max() < _MAX_COORDINATE
        and np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max() < _ROTATION_TOLERANCE
    ):
        return "`poses` must be rigid motions"
    if not (np.isfinite(tracks.points).all() and np.isfinite(tracks.pixel).all()):
        return "`track_points` and `track_pixel` must be finite"
    if np.abs(tracks.points).max(initial=0.0) > _MAX_COORDINATE or np.abs(tracks.pixel).max(initial=0.0) > _MAX_PIXEL:
        return f"`track_points` or `track_pixel` is above {_MAX_COORDINATE:g} or {_MAX_PIXEL:g}"
    if tracks.colours.dtype != np.uint8:
        return f"`track_colours` is {tracks.colours.dtype}; expected uint8"
    seen = np.bincount(tracks.point, minlength=len(tracks))
    if (np.diff(tracks.point) < 0).any() or (seen == 0).any():
        return "`track_point` must be sorted and contain every point"
    return None


def _read(archive: Archive) -> dict[str, np.ndarray]:
    version = archive.read(["version"], lambda headers: None)["version"] if "version" in archive else np.array(0)
    if version.shape or version != VERSION:
        raise InputError(f"`{archive.path}` has layout version {version}, expected {VERSION}; run again")
    missing = [name for name in _LAYOUT if name not in archive]
    if missing:
        raise ValueError(f"the arrays {', '.join(missing)} are missing")
    return archive.read(_LAYOUT, _check)


def _check(headers: Mapping[str, ArrayHeader]) -> None:
    """Validate shapes and types against the layout, before the arrays are read."""
    lengths: dict[int | str, int] = {}
    for name, layout in _LAYOUT.items():
        found = headers[name]
        for axis, length in zip(layout, found.shape, strict=False):
            lengths.setdefault(axis, length if isinstance(axis, str) else axis)
        expected = tuple(lengths.get(axis, axis) for axis in layout)
        kinds, expected_type = ("iu", "integers") if name in _INTEGERS else ("iufb", "numbers")
        if found.shape != expected or found.dtype.kind not in kinds:
            raise ValueError(f"`{name}` is {found.dtype} of shape {found.shape}; expected {expected_type}, {expected}")


def _largest_submap(slam: Slam) -> tuple[Keyframe, ...]:
    return tuple(slam.keyframes[number] for number in pieces_by_size(slam)[0])


def write_scene(folder: Path, slam: Slam, valid: np.ndarray | None = None, frames: Frames | None = None) -> None:
    """Write `scene.npz` and the undistorted image of each keyframe in `images/`, each atomically.

    valid: bool [H, W], pixels of the undistorted images inside the original one; saved as `image-mask.png`, white where
    valid. frames: what the run read, to write the image of every frame of the same submap as well.
    """
    scene = Scene.of(slam)
    for view, keyframe in enumerate(_largest_submap(slam)):
        _write_image(folder / "images" / scene.image_name(view), keyframe.image)
    if frames is not None:
        scene = scene.with_frames(list(_other_frames(folder / "images", slam, scene, frames)))
    if valid is not None:
        write_picture(folder / MASK, np.where(valid, 255, 0).astype(np.uint8))
    tracks = scene.tracks
    with atomic_open(folder / "scene.npz", "wb") as handle:
        np.savez_compressed(
            handle,
            version=VERSION,
            frames=scene.frames,
            timestamps=scene.timestamps,
            poses=scene.poses,
            intrinsics=scene.intrinsics,
            size=scene.size,
            metric=scene.metric,
            track_points=tracks.points,
            track_colours=tracks.colours,
            track_point=tracks.point,
            track_view=tracks.view,
            track_pixel=tracks.pixel,
        )


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
