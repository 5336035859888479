"""The keyframes of a run, or all its frames, as other programs want them: pictures, cameras, tracks; `scene.npz` and
`images/` in its folder, and `image-mask.png` where undistorted pictures have borders that no pixel fills.

Nothing in the file is code: it is read without pickles. `version` is that of its layout.
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
from vggtgeo.results.frames_again import read_again
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.submaps import pieces_by_size

VERSION = 1
MASK = "image-mask.png"
QUALITY = 95
"""Of the JPEG pictures."""
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
_FAR, _FAR_PIXELS = 1e10, 1e7
_LARGEST, _RIGID = 100_000, 1e-3
"""Pixels of a side; how far a rotation's product with its transpose may be from the unit matrix."""
_SAME_TIME, _SAME_PLACE = 1e-5, 1e-4
"""Seconds, and lengths for one of 1: files of poses have so many digits."""
_WHOLE = ("frames", "size", "track_point", "track_view")


def picture_name(frame: int) -> str:
    """Of a frame's picture in `images/`."""
    return f"{frame:06d}.jpg"


@dataclass(frozen=True, eq=False)
class Scene:
    """Views: the keyframes, and other frames that a run kept pictures of.

    Fields: frames int [k], number of each view's frame; timestamps float64 [k], s; poses float64 [k, 4, 4],
    world -> camera; intrinsics float64 [4], pixels, of the undistorted pictures; size (width, height); tracks, whose
    views are places in these arrays; metric: whether lengths are metres.
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
        """The scene of a state with at least one keyframe: of a map in pieces the one of most frames, as in `map.ply`,
        for what nothing ties to it stands anywhere.
        """
        keyframes = _shown(slam)
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
        """The picture of a view, in `images/`."""
        return picture_name(int(self.frames[view]))

    def differs(self, times: np.ndarray, centres: np.ndarray) -> str:
        """What tells that the views are of another run than the poses beside them, whose times, s [n], and places,
        [n, 3], these are; empty where each view is one of them.
        """
        order = np.argsort(times, kind="stable")
        times, centres = times[order], centres[order]
        own = rigid.invert(self.poses)[:, :3, 3]
        first, behind = (np.searchsorted(times, self.timestamps + span) for span in (-_SAME_TIME, _SAME_TIME))
        for view, (low, high) in enumerate(zip(first, behind, strict=True)):
            if low == high:
                return f"no pose is of the time of frame {self.frames[view]}"
            off = np.linalg.norm(centres[low:high] - own[view], axis=1).min()
            if off > _SAME_PLACE * (1.0 + np.linalg.norm(own[view])):
                return f"frame {self.frames[view]} is {off:.3g} from where its picture was taken"
        return ""

    def with_frames(self, others: Sequence[tuple[int, float, np.ndarray]]) -> Scene:
        """The same with views of other frames, which see no points: number, time and pose, world -> camera, of each;
        all in the order of their numbers.
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
        """Reads `scene.npz` of a run's folder; InputError where there is none, or one of another layout."""
        path = Path(folder) / "scene.npz"
        try:
            return cls._of(read_archive(path, "the scene of a run", _read))
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"`{path}` cannot be read ({error}); give a folder that `vggtgeo run` wrote") from None

    @classmethod
    def _of(cls, values: Mapping[str, np.ndarray]) -> Scene:
        count = len(values["frames"])
        poses, (width, height) = values["poses"], values["size"]
        tracks = Tracks(*(values[f"track_{name}"] for name in ("points", "colours", "point", "view", "pixel")))
        if not (len(tracks.point) == len(tracks.view) == len(tracks.pixel)):
            raise ValueError("its tracks have observations of unequal number")
        if len(tracks.point) and not (0 <= tracks.view.min() <= tracks.view.max() < count):
            raise ValueError("its tracks name views that are not there")
        if len(tracks.point) and not (0 <= tracks.point.min() <= tracks.point.max() < len(tracks)):
            raise ValueError("its tracks name points that are not there")
        if len(np.unique(values["frames"])) != count or not np.isfinite(values["timestamps"]).all():
            raise ValueError("two of its views are of one frame, or a time is none")
        size, intrinsics = (int(width), int(height)), values["intrinsics"]
        wrong = _impossible(poses, intrinsics, size, tracks)
        if wrong:
            raise ValueError(wrong)
        return cls(values["frames"], values["timestamps"], poses, intrinsics, size, tracks, bool(values["metric"]))


def _impossible(poses: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], tracks: Tracks) -> str | None:
    """What no run writes, if anything: other programs would take it as it is."""
    if not len(poses):
        return "it has no view"
    if not (0 < min(size) <= max(size) <= _LARGEST):
        return f"its pictures are {size[0]} x {size[1]} pixels"
    if not (np.isfinite(intrinsics).all() and (intrinsics[:2] > 0).all() and np.abs(intrinsics).max() < _FAR_PIXELS):
        return f"its intrinsics are {intrinsics}"
    turns = poses[:, :3, :3].astype(np.float64)
    if not (
        np.isfinite(poses).all()
        and np.abs(poses).max() < _FAR
        and np.abs(turns @ turns.swapaxes(1, 2) - np.eye(3)).max() < _RIGID
    ):
        return "its poses are not all rigid"
    if not (np.isfinite(tracks.points).all() and np.isfinite(tracks.pixel).all()):
        return "its points or their pixels hold a NaN or an infinity"
    if np.abs(tracks.points).max(initial=0.0) > _FAR or np.abs(tracks.pixel).max(initial=0.0) > _FAR_PIXELS:
        return "its points or their pixels are beyond all rooms and pictures"
    if tracks.colours.dtype != np.uint8:
        return f"its colours are {tracks.colours.dtype}; expected uint8"
    seen = np.bincount(tracks.point, minlength=len(tracks))
    if (np.diff(tracks.point) < 0).any() or (seen == 0).any():
        return "its observations are not listed point by point, or a point has none"
    return None


def _read(archive: Archive) -> dict[str, np.ndarray]:
    """The arrays of the layout, and no others."""
    version = archive.read(["version"], lambda headers: None)["version"] if "version" in archive else np.array(0)
    if version.shape or version != VERSION:
        raise InputError(f"`{archive.path}` is of layout {version}, expected {VERSION}; run again")
    missing = [name for name in _LAYOUT if name not in archive]
    if missing:
        raise ValueError(f"it lacks the arrays {', '.join(missing)}")
    return archive.read(_LAYOUT, _check)


def _check(headers: Mapping[str, ArrayHeader]) -> None:
    """Shapes that belong together, known before the arrays are read."""
    lengths: dict[int | str, int] = {}
    for name, layout in _LAYOUT.items():
        found = headers[name]
        for axis, length in zip(layout, found.shape, strict=False):
            lengths.setdefault(axis, length if isinstance(axis, str) else axis)
        expected = tuple(lengths.get(axis, axis) for axis in layout)
        kinds, words = ("iu", "whole numbers") if name in _WHOLE else ("iufb", "numbers")
        if found.shape != expected or found.dtype.kind not in kinds:
            raise ValueError(f"its `{name}` is {found.dtype} of shape {found.shape}; expected {words}, {expected}")


def _shown(slam: Slam) -> tuple[Keyframe, ...]:
    """The keyframes of the piece of map that most frames hang on."""
    return tuple(slam.keyframes[number] for number in pieces_by_size(slam)[0])


def write_scene(folder: Path, slam: Slam, seen: np.ndarray | None = None, frames: Frames | None = None) -> None:
    """`scene.npz` and a picture of each keyframe in `images/`, undistorted, each written atomically.

    seen: bool [H, W], which pixels of an undistorted picture come from the image; kept as `image-mask.png`, white for
    these. frames: what the run read, for a picture of every frame that stands in the same piece of map, too.
    """
    scene = Scene.of(slam)
    for view, keyframe in enumerate(_shown(slam)):
        _write_picture(folder / "images" / scene.image_name(view), keyframe.image)
    if frames is not None:
        scene = scene.with_frames(list(_other_frames(folder / "images", slam, scene, frames)))
    if seen is not None:
        write_picture(folder / MASK, np.where(seen, 255, 0).astype(np.uint8))
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
    """Number, time and pose, world -> camera, of the tracked frames that are no views yet, as their pictures are
    written.
    """
    piece, poses = {keyframe.number for keyframe in _shown(slam)}, frame_poses(slam)[1]
    known, undistorter = set(scene.frames.tolist()), (slam.camera.lens or frames.camera).undistorter()
    for row, frame in read_again(slam, frames):
        record = slam.frames[row]
        if record.tracked and record.reference in piece and record.frame not in known:
            _write_picture(folder / picture_name(record.frame), undistorter.image(frame.image))
            yield record.frame, record.timestamp, poses[row]


def _write_picture(path: Path, image: np.ndarray) -> None:
    bgr = np.ascontiguousarray(image[..., ::-1])
    write_picture(path, bgr, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
