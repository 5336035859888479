"""The keyframes of a run as other programs want them: pictures, cameras, tracks; `scene.npz` and `images/` in its
folder.

Nothing in the file is code: it is read without pickles. `version` is that of its layout.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open
from vggtgeo.mapping.tracks import Tracks, make_tracks
from vggtgeo.slam.state import Slam

VERSION = 1
QUALITY = 95
"""Of the JPEG pictures."""
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile)


@dataclass(frozen=True, eq=False)
class Scene:
    """Fields: frames int [k], number of each keyframe's frame; timestamps float64 [k], s; poses float64 [k, 4, 4],
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
        """The scene of a state with at least one keyframe."""
        keyframes = slam.keyframes
        height, width = keyframes[0].size
        return cls(
            np.array([keyframe.frame for keyframe in keyframes]),
            np.array([keyframe.timestamp for keyframe in keyframes]),
            np.array([keyframe.pose for keyframe in keyframes]),
            np.asarray(slam.intrinsics, np.float64),
            (width, height),
            make_tracks(keyframes, slam.pairs, slam.intrinsics),
            slam.metric,
        )

    def image_name(self, view: int) -> str:
        """The picture of a keyframe, in `images/`."""
        return f"{self.frames[view]:06d}.jpg"

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Scene:
        """Reads `scene.npz` of a run's folder; InputError where there is none, or one of another layout."""
        path = Path(folder) / "scene.npz"
        try:
            with path.open("rb") as handle, np.load(handle, allow_pickle=False) as data:
                values = {name: data[name] for name in data.files}
            if int(values.get("version", 0)) != VERSION:
                raise InputError(f"`{path}` is of layout {values.get('version', 0)}, expected {VERSION}; run again")
            return cls._of(values)
        except _UNREADABLE as error:
            raise InputError(f"`{path}` cannot be read ({error}); give a folder that `vggtgeo run` wrote") from None

    @classmethod
    def _of(cls, values: Mapping[str, np.ndarray]) -> Scene:
        count = len(values["frames"])
        poses, (width, height) = values["poses"].reshape(count, 4, 4), values["size"]
        tracks = Tracks(*(values[f"track_{name}"] for name in ("points", "colours", "point", "view", "pixel")))
        if not (len(tracks.point) == len(tracks.view) == len(tracks.pixel)):
            raise ValueError("its tracks have observations of unequal number")
        if len(tracks.point) and not (0 <= tracks.view.min() <= tracks.view.max() < count):
            raise ValueError("its tracks name keyframes that are not there")
        if len(tracks.point) and not (0 <= tracks.point.min() <= tracks.point.max() < len(tracks)):
            raise ValueError("its tracks name points that are not there")
        size, intrinsics = (int(width), int(height)), values["intrinsics"].reshape(4)
        return cls(values["frames"], values["timestamps"], poses, intrinsics, size, tracks, bool(values["metric"]))


def write_scene(folder: Path, slam: Slam) -> None:
    """`scene.npz` and a picture of each keyframe in `images/`, undistorted, each written atomically."""
    scene = Scene.of(slam)
    for view, keyframe in enumerate(slam.keyframes):
        bgr = np.ascontiguousarray(keyframe.image[..., ::-1])
        # Encoded first: OpenCV's own writing of a file does not tell that a disk is full.
        with atomic_open(folder / "images" / scene.image_name(view), "wb") as handle:
            handle.write(cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))[1].tobytes())
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
