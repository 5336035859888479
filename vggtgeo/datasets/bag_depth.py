"""The camera of a bag's depth, if it differs from that of the images.

RealSense, Kinect and their like take depth with a camera of its own beside the colour camera. Drivers register it to
the images (topics `aligned_depth_to_color`, `depth_registered`), or leave it as it is. What a bag states decides: the
`CameraInfo` beside the depth, the frames of both topics, and how these lie (`/tf_static`, `/tf`, or RealSense's
`extrinsics/depth_to_color`).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.datasets.bag_cameras import camera_of, is_beside
from vggtgeo.datasets.bag_topics import Chosen, is_registered
from vggtgeo.datasets.bag_transforms import frame_name, motion_between
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """camera: of the depth images. motion: float64 [4, 4], its coordinates -> those of the images' camera, metres."""

    camera: Camera
    motion: np.ndarray


def depth_camera_of(
    path: Path,
    chosen: Chosen,
    first: Mapping[str, Any],
    infos: Mapping[str, Sequence[Any]],
    cameras: tuple[Camera | None, tuple[int, int]],
    transforms: Callable[[], Iterable[Any]],
    extrinsics: np.ndarray | None,
) -> DepthCamera | None:
    """Return the camera of the depth; None if it is that of the images, or the bag does not say.

    first: messages of the two topics. infos: of `CameraInfo`, by topic. cameras: of the images, and width and height of
    the depth. transforms: reads the messages of tf. extrinsics: [4, 4], depth -> colour, as RealSense publishes it.

    Raises:
        InputError: the depth is of another camera, and the bag lacks its intrinsics, those of the images, or the
            extrinsics.

    """
    image, size = cameras
    frames = [frame_name(first[topic].header.frame_id) for topic in (chosen.depth, chosen.colour)]
    stated = all(frames)
    beside = {name: messages for name, messages in infos.items() if _may_be_of_depth(name, messages, chosen, frames[0])}
    own = camera_of(path, beside, chosen.depth, size)
    if own is None and (not stated or frames[0] == frames[1] or is_registered(chosen.depth)):
        return None
    if own is not None and own == image and (not stated or frames[0] == frames[1]):
        return None
    motion = None
    if stated:
        motion = np.eye(4) if frames[0] == frames[1] else motion_between(transforms(), *frames)
    motion = extrinsics if motion is None else motion
    motion = np.eye(4) if motion is None and is_registered(chosen.depth) else motion
    if own is None or image is None or motion is None:
        raise InputError(_refusal(path, chosen, frames, (own, image), motion))
    return DepthCamera(own, motion)


def _may_be_of_depth(info: str, messages: Sequence[Any], chosen: Chosen, frame: str) -> bool:
    """Return whether a camera beside both topics may be the depth's: it has the depth's frame, or none."""
    if not messages or not is_beside(info, chosen.depth):
        return False
    return not is_beside(info, chosen.colour) or frame_name(messages[0].header.frame_id) in ("", frame)


def _refusal(
    path: Path,
    chosen: Chosen,
    frames: Sequence[str],
    cameras: tuple[Camera | None, Camera | None],
    motion: np.ndarray | None,
) -> str:
    missing = [
        f"the `CameraInfo` of `{topic}`"
        for topic, camera in zip((chosen.depth, chosen.colour), cameras, strict=True)
        if camera is None
    ]
    missing += ["how its frame lies in that of the images (`/tf_static`)"] if motion is None else []
    depth, image = (_described(*one) for one in zip(cameras, frames, strict=True))
    return (
        f"`{path}`: the depth of `{chosen.depth}` is that of another camera ({depth}) than the images of "
        f"`{chosen.colour}` ({image}), and cannot be registered to them: {' and '.join(missing)} is missing; record "
        "depth that is registered to the images (RealSense: `align_depth`, "
        "`/camera/aligned_depth_to_color/image_raw`), or what is missing, too; or leave it out with --rgb-only"
    )


def _described(camera: Camera | None, frame: str) -> str:
    lens = "intrinsics not stated"
    if camera is not None:
        fx, fy, cx, cy = camera.intrinsics
        lens = f"f = {fx:.1f}, {fy:.1f}, centre {cx:.1f}, {cy:.1f}"
    return f"{lens}, frame `{frame}`" if frame else lens
