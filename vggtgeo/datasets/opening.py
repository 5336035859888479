"""Which reader a path needs, by looking at it."""

import os
from pathlib import Path

from vggtgeo.datasets.frame import Sequence
from vggtgeo.datasets.image_files import IMAGE_SUFFIXES
from vggtgeo.datasets.images import ImageFolder
from vggtgeo.datasets.seven_scenes import SevenScenes
from vggtgeo.datasets.tum import TumRgbd
from vggtgeo.datasets.video import VideoFile
from vggtgeo.io.errors import InputError

_FolderReader = type[SevenScenes] | type[TumRgbd] | type[ImageFolder]

FOLDER_KINDS: dict[str, _FolderReader] = {"7scenes": SevenScenes, "tum": TumRgbd, "images": ImageFolder}
KINDS = (*FOLDER_KINDS, "video")


def open_sequence(path: str | os.PathLike[str], kind: str | None = None) -> Sequence:
    """Opens a 7-Scenes folder, a TUM RGB-D folder, a folder of images, or a video file.

    Args:
        path: the folder or file.
        kind: one of `KINDS` to name the reader; None to find it by looking.

    The camera comes from `calibration.txt` or `camera-intrinsics.txt` in the folder, else from published
    values where the name tells the camera, else it is a guess (`camera.known` is False), with an
    InputWarning. InputError where the path is missing or empty, or holds nothing that can be read.

    Example:
        >>> import vggtgeo as vg
        >>> vg.open_sequence("no/such/folder")
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `no/such/folder` does not exist; give a folder of images or a video file

    """
    place = Path(path).expanduser()
    if kind is not None and kind not in KINDS:
        raise InputError(f"`kind` is {kind!r}; it must be one of {', '.join(KINDS)}")
    if not place.exists():
        raise InputError(f"`{place}` does not exist; give a folder of images or a video file")
    if kind == "video" or (kind is None and not place.is_dir()):
        return _open_video(place)
    if not place.is_dir():
        raise InputError(f"`{place}` is a file; the reader {kind!r} needs a folder")
    if not any(place.iterdir()):
        raise InputError(f"`{place}` is empty; give a folder with images")
    if kind is not None:
        return FOLDER_KINDS[kind].open(place)
    for reader in FOLDER_KINDS.values():
        if reader.matches(place):
            return reader.open(place)
    raise InputError(
        f"`{place}` holds {_names(place)}; expected a 7-Scenes folder (`frame-XXXXXX.color.png`), "
        "a TUM RGB-D folder (`rgb.txt`), or a folder of images"
    )


def _open_video(file: Path) -> Sequence:
    if file.is_dir():
        raise InputError(f"`{file}` is a folder; the reader 'video' needs a file")
    if not file.is_file():
        raise InputError(f"`{file}` is no regular file; give a folder of images or a video file")
    if file.suffix.lower() == ".gif":
        raise InputError(f"`{file}` is a GIF, whose colours and times are not those of a camera; give the video itself")
    if file.suffix.lower() in IMAGE_SUFFIXES:
        raise InputError(f"`{file}` is a single image; give the folder of the sequence, or a video file")
    return VideoFile.open(file)


def _names(folder: Path, most: int = 4) -> str:
    names = sorted(path.name for path in folder.iterdir())
    return ", ".join(f"`{name}`" for name in names[:most]) + (", ..." if len(names) > most else "")
