"""Choice of the reader of a path."""

import math
import os
import statistics
import warnings
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice, pairwise
from pathlib import Path
from typing import Protocol

from vggtgeo.datasets.bags import RosBag, is_bag, no_whole_bag
from vggtgeo.datasets.euroc import Euroc
from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.frame import Sequence
from vggtgeo.datasets.icl import IclNuim
from vggtgeo.datasets.icl_raw import IclNuimRaw
from vggtgeo.datasets.image_files import IMAGE_SUFFIXES, OTHER_PICTURES, is_there
from vggtgeo.datasets.images import ImageFolder
from vggtgeo.datasets.intrinsics import check_plausible
from vggtgeo.datasets.kitti import Kitti
from vggtgeo.datasets.live import LiveCamera, is_live
from vggtgeo.datasets.nerfstudio import Nerfstudio
from vggtgeo.datasets.not_read import reason_not_read
from vggtgeo.datasets.phone_exports import Polycam, Scanner3d
from vggtgeo.datasets.phones import ArkitScenes, StrayScanner
from vggtgeo.datasets.record3d import Record3d
from vggtgeo.datasets.replica import Replica
from vggtgeo.datasets.rgbd_folders import RgbdFolders
from vggtgeo.datasets.scannet import ScanNet
from vggtgeo.datasets.seven_scenes import SevenScenes
from vggtgeo.datasets.tanks import TanksAndTemples
from vggtgeo.datasets.tum import TumRgbd
from vggtgeo.datasets.video import FASTEST, VideoFile
from vggtgeo.datasets.views import with_rate
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.given import path_of


class FolderReader(Protocol):
    """A reader of one layout."""

    def matches(self, folder: Path) -> bool:
        """Return whether `folder` has this layout."""
        ...

    def open(self, folder: Path) -> Sequence:
        """Open the sequence in `folder`; raise InputError if it is invalid."""
        ...


FOLDER_KINDS: dict[str, FolderReader] = {
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
"""Readers by name, in the order in which a folder is tried: the plain ones last."""
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
        depth: False to leave the depth of a bag or a video alone, which may not be that of its images' camera.

    The camera comes from `calibration.txt` or `camera-intrinsics.txt` in the folder, else from published values of the
    benchmark, else it is a guess (`camera.known` is False), with an InputWarning.

    Raises:
        InputError: the path is missing or empty, or has nothing that can be read.

    Example:
        >>> import vggtgeo as vg
        >>> vg.open_sequence("no/such/folder")
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `no/such/folder` does not exist; give a folder of images or a video file

    """
    if kind is not None and kind not in KINDS:
        raise InputError(f"`kind` is {kind!r}; it must be one of {', '.join(KINDS)}")
    place = path_of("path", path)
    if kind == "camera" or (kind is None and is_live(os.fspath(path))):
        return LiveCamera.open(os.fspath(path))
    sequence = _open_place(place, kind, depth)
    if sequence.camera.known:
        check_plausible(f"the camera of `{os.fspath(path)}`", sequence.camera)
    if isinstance(sequence, FolderSequence):
        _check_pace(sequence)
    return sequence if rate is None else with_rate(sequence, rate)


def _check_pace(sequence: FolderSequence) -> None:
    """Warn of more frames a second than cameras take, such as microseconds in place of nanoseconds."""
    times = [file.timestamp for file in sequence.files]
    apart = statistics.median(after - before for before, after in pairwise(times)) if len(times) > 1 else math.inf
    if 0 < apart < 1 / FASTEST:
        text = f"its frames are {apart:.2g} s apart, more than {FASTEST} a second: are its times in another unit?"
        warnings.warn(f"`{sequence.folder}`: {text}", InputWarning, stacklevel=3)


def is_readable(place: Path) -> bool:
    """Return whether a path is a file, or a folder of a known layout; nothing is opened."""
    try:
        return place.is_file() or any(reader.matches(place) for reader in FOLDER_KINDS.values())
    except OSError:  # a folder that may not be looked into
        return False


def check_there(path: str | os.PathLike[str]) -> None:
    """Raise InputError if the path does not exist or may not be read, before anything is opened."""
    place = path_of("path", path)
    if not is_live(os.fspath(path)):
        _check_place(place)


def _check_place(place: Path) -> None:
    if not is_there(place):
        raise InputError(f"`{place}` does not exist; give a folder of images or a video file")
    if not os.access(place, os.R_OK | os.X_OK if place.is_dir() else os.R_OK):
        raise InputError(
            f"`{place}` may not be read by this user (permission denied); change that (`chmod -R u+rX`, as its owner), "
            "or give a copy of your own"
        )


def _open_place(place: Path, kind: str | None, depth: bool) -> Sequence:
    _check_place(place)
    if kind == "bag" or (kind is None and is_bag(place)):
        return RosBag.open(place, depth)
    if place.is_file() and (kind == "record3d" or (kind is None and Record3d.matches(place))):
        return Record3d.open(place)
    if kind == "video" or (kind is None and not place.is_dir()):
        return _open_video(place, depth)
    if not place.is_dir():
        raise InputError(f"`{place}` is a file; the reader {kind!r} needs a folder")
    return _open_folder(place, kind)


def _open_folder(place: Path, kind: str | None) -> Sequence:
    if not any(place.iterdir()):
        raise InputError(f"`{place}` is empty; give a folder with images")
    dead = _dead_links(place)
    if dead and (kind is not None or any(reader.matches(place) for reader in FOLDER_KINDS.values())):
        warnings.warn(f"`{place}`: {dead}", InputWarning, stacklevel=4)
    if kind is not None:
        return FOLDER_KINDS[kind].open(place)
    if all((place / name).is_file() for name in ("summary.json", "trajectory.txt")):
        raise InputError(f"`{place}` holds the result of a run; give the recording that it was made of")
    for reader in FOLDER_KINDS.values():
        if reader.matches(place):
            return reader.open(place)
    raise InputError(
        no_whole_bag(place)
        or reason_not_read(place)
        or f"`{place}` holds {_names(place)}; expected a 7-Scenes folder (`frame-XXXXXX.color.png`), "
        "a TUM RGB-D folder (`rgb.txt`), folders `rgb` and `depth`, another layout of `vggtgeo data list`, or a folder "
        f"of images{_hint(place)}{'; ' if dead else ''}{dead}"
    )


def _dead_links(folder: Path) -> str:
    """Broken links in a folder and in those in it, as a message: of a disk that is not mounted, or of files that a tool
    for large files has not fetched.
    """
    dead = []
    for place in (folder, *sorted(path for path in folder.iterdir() if path.is_dir())[:_MAX_FOLDERS]):
        with suppress(OSError), os.scandir(place) as entries:
            links = (Path(entry.path) for entry in entries if entry.is_symlink() and entry.name[0] != ".")
            dead += [path for path in links if not is_there(path)]
    if not dead:
        return ""
    return (
        f"{len(dead)} broken links are not read, `{min(dead).relative_to(folder)}` first; is a disk "
        "missing, or was the content not fetched (git annex, DVC)?"
    )


def _open_video(file: Path, depth: bool) -> Sequence:
    if file.is_dir():
        raise InputError(f"`{file}` is a folder; the reader 'video' needs a file")
    if not file.is_file():
        raise InputError(f"`{file}` is no regular file; give a folder of images or a video file")
    if file.suffix.lower() in IMAGE_SUFFIXES | OTHER_PICTURES:
        raise InputError(f"`{file}` is a single image; give the folder of the sequence, or a video file")
    if reason := reason_not_read(file):
        raise InputError(reason)
    return VideoFile.open(file, depth)


def _hint(folder: Path) -> str:
    """Recordings in a folder, as the end of a message."""
    found = [f"`{path}`" for path in islice(_readable_below(folder), 4)]
    if not found:
        return ""
    return f"; it holds {', '.join(found[:3])}" + (", ..." if len(found) > 3 else "")


def _readable_below(folder: Path) -> Iterator[Path]:
    """Recordings in a folder and those below it, the nearest first."""
    waiting = deque([(folder, 0)])
    for _ in range(_MAX_FOLDERS):
        if not waiting:
            return
        place, depth = waiting.popleft()
        try:
            inside = sorted(path for path in place.iterdir() if not path.name.startswith((".", "__")))
            yield from (path for path in inside if path.suffix.lower() in _FILES and path.is_file())
            for path in (path for path in inside if path.is_dir()):
                if is_readable(path):
                    yield path
                elif depth < _MAX_DEPTH:
                    waiting.append((path, depth + 1))
        except OSError:  # a folder that may not be looked into
            continue


_FILES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".bag", ".mcap", ".r3d"})
_MAX_FOLDERS, _MAX_DEPTH = 100, 2
"""Folders and levels that are searched for a hint."""


def _names(folder: Path, most: int = 4) -> str:
    names = sorted(path.name for path in folder.iterdir())
    return ", ".join(f"`{name}`" for name in names[:most]) + (", ..." if len(names) > most else "")
