"""Choose the reader of a path, and open it."""

import os
from pathlib import Path
from typing import Any

from vggtgeo.datasets.bags import RosBag, is_bag, why_incomplete
from vggtgeo.datasets.euroc import Euroc
from vggtgeo.datasets.frame import Sequence
from vggtgeo.datasets.icl import IclNuim, IclNuimRaw
from vggtgeo.datasets.image_files import IMAGE_SUFFIXES, OTHER_PICTURES, path_exists
from vggtgeo.datasets.images import ImageFolder, RgbdFolders
from vggtgeo.datasets.intrinsics import check_plausible
from vggtgeo.datasets.kitti import Kitti
from vggtgeo.datasets.live_camera import LiveCamera, is_live
from vggtgeo.datasets.nerfstudio import Nerfstudio
from vggtgeo.datasets.phones import ArkitScenes, Polycam, Scanner3d, StrayScanner
from vggtgeo.datasets.record3d import Record3d
from vggtgeo.datasets.replica import Replica
from vggtgeo.datasets.scannet import ScanNet
from vggtgeo.datasets.seven_scenes import SevenScenes
from vggtgeo.datasets.tanks import TanksAndTemples
from vggtgeo.datasets.tum import TumRgbd
from vggtgeo.datasets.video import VideoFile
from vggtgeo.datasets.views import with_rate
from vggtgeo.io.argument_checks import path_of
from vggtgeo.io.errors import InputError, warn

FOLDER_KINDS: dict[str, Any] = {
    "euroc": Euroc,
    "replica": Replica,
    "scannet": ScanNet,
    "arkitscenes": ArkitScenes,
    "stray": StrayScanner,
    "record3d": Record3d,
    "kitti": Kitti,
    "tanks": TanksAndTemples,
    "icl": IclNuim,
    "icl-raw": IclNuimRaw,
    "7scenes": SevenScenes,
    "tum": TumRgbd,
    "nerfstudio": Nerfstudio,
    "3dscanner": Scanner3d,
    "polycam": Polycam,
    "rgbd": RgbdFolders,
    "images": ImageFolder,
}
"""Readers by name, in the order in which they are tried: plain folders last. Each has `matches` and `open`."""
KINDS = (*FOLDER_KINDS, "video", "bag", "camera")


def open_sequence(
    path: str | os.PathLike[str], kind: str | None = None, rate: float | None = None, depth: bool = True
) -> Sequence:
    """Open a folder of a benchmark or of images, a video file, a ROS bag, a webcam (`webcam:0`) or a stream
    (`rtsp://`).

    Args:
        path: the folder or file, or the name of a camera.
        kind: one of `KINDS` to name the reader; None to choose it by the content.
        rate: frames a second of a plain folder of images, whose files have no times (by default 30), or of a video.
        depth: False to ignore the depth of a bag or a video, which may be of another camera than the images.

    The camera comes from `calibration.txt` or `camera-intrinsics.txt` in the folder, else from published values of the
    benchmark, else it is a guess (`camera.known` is False), with an InputWarning. Raises InputError if nothing can be
    read.

    Example:
        >>> import vggtgeo as vg
        >>> vg.open_sequence("no/such/folder")
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `no/such/folder` does not exist; give a folder of images or a video file

    """
    if kind is not None and kind not in KINDS:
        raise InputError(f"`kind` must be one of {', '.join(KINDS)}, got {kind!r}")
    place = path_of("path", path)
    if kind == "camera" or (kind is None and is_live(os.fspath(path))):
        return LiveCamera.open(os.fspath(path))
    sequence = _open_place(place, kind, depth)
    if sequence.camera.known:
        check_plausible(f"the camera of `{os.fspath(path)}`", sequence.camera)
    return sequence if rate is None else with_rate(sequence, rate)


def is_readable(place: Path) -> bool:
    """Return whether a path is a file, or a folder of a known layout; no sequence is opened."""
    try:
        return place.is_file() or any(reader.matches(place) for reader in FOLDER_KINDS.values())
    except OSError:  # a folder without permission to read
        return False


def check_path(path: str | os.PathLike[str]) -> None:
    """Raise InputError if the path does not exist, or this user has no permission to read it."""
    place = path_of("path", path)
    if is_live(os.fspath(path)):
        return
    if not path_exists(place):
        raise InputError(f"`{place}` does not exist; give a folder of images or a video file")
    if not os.access(place, os.R_OK | os.X_OK if place.is_dir() else os.R_OK):
        raise InputError(f"`{place}` cannot be read by this user (permission denied)")


def _open_place(place: Path, kind: str | None, depth: bool) -> Sequence:
    check_path(place)
    if kind == "bag" or (kind is None and is_bag(place)):
        return RosBag.open(place, depth)
    if place.is_file() and (kind == "record3d" or (kind is None and Record3d.matches(place))):
        return Record3d.open(place)
    if kind == "video" or (kind is None and not place.is_dir()):
        return _open_video(place, depth)
    if not place.is_dir():
        raise InputError(f"`{place}` must be a folder for the reader {kind!r}, got a file")
    return _open_folder(place, kind)


def _open_folder(place: Path, kind: str | None) -> Sequence:
    if not any(place.iterdir()):
        raise InputError(f"`{place}` is empty; give a folder with images")
    _warn_of_broken_links(place)
    if kind is not None:
        return FOLDER_KINDS[kind].open(place)
    if all((place / name).is_file() for name in ("summary.json", "trajectory.txt")):
        raise InputError(f"`{place}` holds the result of a run; give the recording instead")
    for reader in FOLDER_KINDS.values():
        if reader.matches(place):
            return reader.open(place)
    names = sorted(path.name for path in place.iterdir())
    other = next((name for name in names if Path(name).suffix.lower() in OTHER_PICTURES | ARCHIVES), None)
    raise InputError(
        why_incomplete(place)
        or (other and f"`{place}` holds `{other}`: {_UNSUPPORTED}{_recordings_inside(place)}")
        or f"`{place}` holds {', '.join(f'`{name}`' for name in names[:4])}; expected images, folders `rgb` "
        f"and `depth`, or another layout of `vggtgeo data list`{_recordings_inside(place)}"
    )


def _warn_of_broken_links(folder: Path) -> None:
    broken = [path for path in (*folder.iterdir(), *folder.glob("*/*")) if path.is_symlink() and not path_exists(path)]
    if broken:
        warn(f"`{folder}`: {len(broken)} broken links are ignored, first `{min(broken)}`: is a disk missing?")


def _open_video(file: Path, depth: bool) -> Sequence:
    if not file.is_file():
        raise InputError(f"`{file}` must be a video file, or a folder of images")
    if file.suffix.lower() in IMAGE_SUFFIXES:
        raise InputError(f"`{file}` is a single image; give the folder of the sequence, or a video file")
    if file.suffix.lower() in OTHER_PICTURES | ARCHIVES:
        raise InputError(f"`{file}`: {_UNSUPPORTED}")
    return VideoFile.open(file, depth)


def _recordings_inside(folder: Path) -> str:
    """Return the recordings in the folders of a folder, as the end of a message."""
    inside = (path for path in sorted(folder.iterdir()) if path.is_dir() and path.name[0] != ".")
    found = [f"`{path}`" for path in inside if is_readable(path)]
    return f"; it holds {', '.join(found[:3])}" if found else ""


ARCHIVES = frozenset({".zip", ".tgz", ".gz", ".tar", ".7z", ".rar", ".sens"})
_UNSUPPORTED = (
    "an unsupported image or archive format; convert images to PNG or JPEG, unpack archives, export a scan of "
    "ScanNet (`.sens`) with its SensReader"
)
