"""A plain folder of images, in natural order (2 before 10)."""

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import cv2
import numpy as np

from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.frame import Frame
from vggtgeo.datasets.image_files import IMAGE_SUFFIXES, OTHER_PICTURES, UNFINISHED, read_image
from vggtgeo.datasets.intrinsics import camera_or_guess
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning, LeftOutWarning, NoteWarning

FRAMES_PER_SECOND = 30.0
_SECONDS = re.compile(r"-?\d+\.\d+")
_NANOSECONDS = re.compile(r"\d{18,19}")
_MICROSECONDS, _MILLISECONDS = re.compile(r"1\d{15}"), re.compile(r"1\d{12}")
"""Unix times of 2001 to 2033."""
_PREFERRED = (".png", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".webp", ".jpg", ".jpeg")
"""Order of preference among two formats of the same images: lossless first."""
_DIGITS = re.compile(r"[0-9]+")
_SMALL = (64, 64)
_ALIKE = 0.95
"""Correlation of two files of one image; a colour image and its depth or mask are below it."""
_NO_IMAGES = re.compile(r"depth|conf", re.IGNORECASE)
_NUMBERS = re.compile(r"((?:^-)?\d+)")
_CAMERAS = re.compile(r"(.*(?:cam|camera|view|sensor|lens|eye)[ ._-]*\d+)(?!\d)(.*)", re.IGNORECASE)
"""Names with the number of a camera, `cam0_17`."""
_UNITS = ((_SECONDS, 1.0), (_NANOSECONDS, 1e-9), (_MICROSECONDS, 1e-6), (_MILLISECONDS, 1e-3))
_COUNTED = re.compile(r"-?\d+\.\d+0")
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
        images = _without_doubles(folder, images)
        warn_of_unread(folder, images)
        _warn_of_series(folder, images)
        _warn_of_more(folder, len(images))
        times = times_by_name(images)
        frames = [(time, image, None) for time, image in sorted(zip(times, images, strict=True))]
        return cls.listed(folder, frames, lambda *size: camera_or_guess(folder, *size))

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """See `FolderSequence.frames`; warns at the end of images that were added since the folder was opened."""
        read = super().frames(start, end, stride)
        return read if end is not None and end < len(self) else self._then_warn_of_new(read)

    def _then_warn_of_new(self, read: Iterator[Frame]) -> Iterator[Frame]:
        yield from read
        listed = {file.image for file in self.files}
        kinds = {image.suffix.lower() for image in listed}
        there = image_files(self.folder) if self.folder.is_dir() else []
        new = [image for image in there if image not in listed and image.suffix.lower() in kinds]
        if new:
            text = (
                f"`{self.folder}` got {len(new)} more images while it was read, `{new[0].name}` the first: they are "
                "left out; run again for them, or once the folder is whole"
            )
            warnings.warn(LeftOutWarning(text, len(new)), stacklevel=3)

    def ground_truth(self) -> Trajectory | None:
        """Return the ground truth, if the folder has it."""
        file = self.folder / "groundtruth.txt"
        return Trajectory.load_tum(file) if file.exists() else None


def _without_doubles(folder: Path, images: list[Path]) -> list[Path]:
    """Keep one file of each image if all are there in the same two formats (`1.jpg`, `1.png`), with a NoteWarning.

    Pairs of different images, such as colour and a mask, are kept.
    """
    formats = sorted({image.suffix.lower() for image in images}, key=_PREFERRED.index)
    if len(formats) != 2:
        return images
    first, second = ([image for image in images if image.suffix.lower() == suffix] for suffix in formats)
    if [image.stem for image in first] != [image.stem for image in second]:
        return images
    ends = sorted({0, len(first) // 2, len(first) - 1})
    if not all(_show_the_same(first[row], second[row]) for row in ends):
        return images
    warnings.warn(
        f"`{folder}`: each of {len(first)} images is there twice, as `{formats[0]}` and as `{formats[1]}`: the "
        f"`{formats[0]}` are read",
        NoteWarning,
        stacklevel=4,
    )
    return first


def _show_the_same(one: Path, other: Path) -> bool:
    """Return whether two files are of one image, whatever their size, tone and compression."""
    try:
        small = [cv2.resize(read_image(path), _SMALL, interpolation=cv2.INTER_AREA) for path in (one, other)]
    except InputError:
        return False
    first, second = (picture.astype(float).ravel() - picture.mean() for picture in small)
    return bool(first @ second >= _ALIKE * np.sqrt((first @ first) * (second @ second)))


def warn_of_unread(folder: Path, images: list[Path]) -> None:
    """Warn of images that are not read, or not complete, among `images`; not of those that are there in a format that
    is read, too (HEIC of a phone beside JPEG, raw of a camera).
    """
    read = {image.stem for image in images}
    files = [path for path in folder.iterdir() if path.is_file()]
    shown = [path for path in files if path.name[0] != "."]
    other = [path for path in shown if path.suffix.lower() in OTHER_PICTURES and path.stem not in read]
    partial = [
        path
        for path in files
        if path.suffix.lower() in UNFINISHED
        and Path(path.stem).suffix.lower() in IMAGE_SUFFIXES | OTHER_PICTURES
        and Path(path.stem.lstrip(".")).stem not in read
    ]
    for found, what in (
        (other, "of a format that is not read: convert to PNG or JPEG"),
        (partial, "not complete: wait for the copy"),
    ):
        if found:
            first = min(path.name for path in found)
            count = f"{len(found)} images" if len(found) > 1 else "an image"
            text = f"`{folder}` holds {count} {what} (`{first}`); left out"
            warnings.warn(LeftOutWarning(text, len(found)), stacklevel=4)


def _warn_of_series(folder: Path, images: list[Path]) -> None:
    """Warn of names that differ in words and share their numbers: two cameras, or two recordings."""
    series: dict[str, set[str]] = {}
    for image in images:
        camera = _CAMERAS.fullmatch(image.stem)
        first, rest = (camera[1], camera[2]) if camera and _DIGITS.search(camera[2]) else ("", image.stem)
        name = first + _DIGITS.sub("*", rest)
        name = name[1:] if name.startswith("-*") else name  # below zero
        series.setdefault(name, set()).add("-".join(_DIGITS.findall(rest)))
    several = [name for name, numbers in series.items() if name != "*" and len(numbers) > 1]
    if len(several) > 1 and series[several[0]] & series[several[1]]:
        warnings.warn(
            f"`{folder}` holds {len(several)} series, `{several[0]}` and `{several[1]}`, of the same numbers: are "
            "these two cameras, or pictures and masks? They are read as one recording; give a folder for each",
            InputWarning,
            stacklevel=4,
        )


def _warn_of_more(folder: Path, count: int) -> None:
    """Warn of a folder below with more images: it may be the recording, and these a few images of it."""
    below = _folders_in(folder)
    below += [inner for place in below for inner in _folders_in(place)]
    more = {path.relative_to(folder).as_posix(): len(image_files(path)) for path in below}
    larger = [name for name, number in more.items() if number > count]
    if larger:
        # Of colour, depth and confidence the first is meant.
        name = next((name for name in larger if not _NO_IMAGES.search(name)), larger[0])
        text = f"reading its {count} images; `{name}` in it has {more[name]}: give that folder to read those"
        warnings.warn(f"`{folder}`: {text}", InputWarning, stacklevel=4)


def _folders_in(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != ".")
    except OSError:  # one that may not be looked into
        return []


def files_like(folder: Path, pattern: str) -> list[Path]:
    """Return the files in `folder` whose names match, in natural order, without hidden ones.

    macOS puts a hidden one beside each file that it copies to another disk (`._0.txt` beside `0.txt`).
    """
    found = (path for path in folder.glob(pattern) if path.name[0] != "." and path.is_file())
    return sorted(found, key=lambda path: (natural_key(path.stem), path.name))


def natural_key(name: str) -> list[int | str]:
    """Return a key that sorts digits as numbers: `a2` before `a10`, and `-2` before `-1`; `a-2` has a dash."""
    # The groups of the pattern are every second part; `isdigit` also holds of signs that are no numbers, as in `m²`.
    return [int(part) if row % 2 else part.lower() for row, part in enumerate(_NUMBERS.split(name))]


def image_files(folder: Path, suffixes: frozenset[str] = IMAGE_SUFFIXES) -> list[Path]:
    """Return the images in `folder`, as `files_like`; suffixes: of images."""
    return [path for path in files_like(folder, "*") if path.suffix.lower() in suffixes]


def times_by_name(images: list[Path]) -> list[float]:
    """Return seconds by the names if all are times, else position / 30 s."""
    stems = [image.stem for image in images]
    for pattern, unit in _UNITS:
        if all(pattern.fullmatch(stem) for stem in stems) and not (unit == 1.0 and _are_counted(stems)):
            times = [float(stem) * unit for stem in stems]
            if len(set(times)) == len(times):
                return times
    return [index / FRAMES_PER_SECOND for index in range(len(images))]


def _are_counted(stems: list[str]) -> bool:
    """Return whether names like 1.9, 1.10 count: a time is written with as many decimals each time, or without zeros at
    its end.
    """
    decimals = {len(stem.partition(".")[2]) for stem in stems}
    return len(decimals) > 1 and any(_COUNTED.fullmatch(stem) for stem in stems)


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
