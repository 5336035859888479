"""A plain folder of images, in natural order (2 before 10)."""

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.image_files import IMAGE_SUFFIXES, OTHER_PICTURES
from vggtgeo.datasets.intrinsics import camera_or_guess
from vggtgeo.io.errors import InputError, InputWarning, LeftOutWarning

FRAMES_PER_SECOND = 30.0
_UNITS = (
    (re.compile(r"-?\d+\.\d+"), 1.0),
    (re.compile(r"\d{18,19}"), 1e-9),
    (re.compile(r"1\d{15}"), 1e-6),
    (re.compile(r"1\d{12}"), 1e-3),
)
"""Names that are times, and their unit: seconds, nanoseconds, and micro- and milliseconds since 1970."""
_NUMBERS = re.compile(r"([0-9]+)")
_NUMBERED = re.compile(r"[^0-9]*([0-9]{1,15})")


@dataclass(frozen=True)
class ImageFolder(FolderSequence):
    """Images of one folder, without depth. Truth: `groundtruth.txt` (TUM format), where there is one.

    Time is position / 30 s, unless all names are times: seconds with a decimal point (`12.034.png`), nanoseconds (18 or
    19 digits), or micro- or milliseconds since 1970 (16 or 13), or `with_rate` says otherwise.
    """

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether `folder` has an image."""
        return bool(image_files(folder))

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the images; raise InputError if there is none."""
        images = image_files(folder)
        if not images:
            raise InputError(f"`{folder}` has no images ({', '.join(sorted(IMAGE_SUFFIXES))})")
        warn_of_unread(folder, images)
        _warn_of_more(folder, len(images))
        times = times_by_name(images)
        frames = [(time, image, None) for time, image in sorted(zip(times, images, strict=True))]
        return cls.listed(folder, frames, lambda *size: camera_or_guess(folder, *size))


def warn_of_unread(folder: Path, images: list[Path]) -> None:
    """Warn of images in formats that are not read, unless `images` has them, too (HEIC of a phone beside JPEG)."""
    read = {image.stem for image in images}
    other = [
        path for path in files_like(folder, "*") if path.suffix.lower() in OTHER_PICTURES and path.stem not in read
    ]
    if other:
        text = f"`{folder}`: {len(other)} images (`{other[0].name}`) are of a format that is not read"
        warnings.warn(LeftOutWarning(f"{text}; left out: convert to PNG or JPEG", len(other)), stacklevel=4)


def _warn_of_more(folder: Path, count: int) -> None:
    """Warn of a folder below with more images: it may be the recording, and these a few images of it."""
    for place in sorted(path for path in folder.iterdir() if path.is_dir()):
        if (more := len(image_files(place))) > count:
            text = f"reading its {count} images; `{place.name}` in it has {more}: give that folder to read those"
            warnings.warn(f"`{folder}`: {text}", InputWarning, stacklevel=4)
            return


def files_like(folder: Path, pattern: str) -> list[Path]:
    """Return the files in `folder` whose names match, in natural order, without hidden ones.

    macOS puts a hidden one beside each file that it copies to another disk (`._0.txt` beside `0.txt`).
    """
    found = (path for path in folder.glob(pattern) if path.name[0] != "." and path.is_file())
    return sorted(found, key=lambda path: (natural_key(path.stem), path.name))


def natural_key(name: str) -> list[int | str]:
    """Return a key that sorts digits as numbers: `a2` before `a10`."""
    # The groups of the pattern are every second part.
    return [int(part) if row % 2 else part.lower() for row, part in enumerate(_NUMBERS.split(name))]


def image_files(folder: Path, suffixes: frozenset[str] = IMAGE_SUFFIXES) -> list[Path]:
    """Return the images in `folder`, as `files_like`; suffixes: of images."""
    return [path for path in files_like(folder, "*") if path.suffix.lower() in suffixes]


def times_by_name(images: list[Path]) -> list[float]:
    """Return seconds by the names if all are times, else position / 30 s."""
    stems = [image.stem for image in images]
    for pattern, unit in _UNITS:
        if all(pattern.fullmatch(stem) for stem in stems):
            return [float(stem) * unit for stem in stems]
    return [index / FRAMES_PER_SECOND for index in range(len(images))]


def rows_of(images: list[Path], lines: int | None) -> tuple[int, ...]:
    """Return the line of each image in a list of a whole recording: the number that its name ends with, so that a part
    of the recording, or one with holes, keeps its times and its truth; those beyond the last line have none. Its place
    where names have no numbers, or others: each image has its line, then.
    """
    found = [_NUMBERED.fullmatch(image.stem) for image in images]
    numbers = [int(match.group(1)) for match in found if match]
    apart = len(set(numbers)) == len(images)
    if apart and (lines != len(images) or max(numbers, default=0) < lines):
        return tuple(numbers)
    return tuple(range(len(images)))
