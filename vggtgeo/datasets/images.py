"""Plain folders of images, or of colour and depth as recorders and scripts write them.

Images without depth are read in natural order (2 before 10). Colour and depth are in two folders (`rgb/0.png`,
`depth/0.png`), or in one folder with a word in their names (`color_0.jpg`, `depth_0.png`). Open3D's recorders write
`color/`, `depth/` and `intrinsic.json`; scripts often write `rgb/` and `depth/` without a camera. Depth of integers is
in millimetres (Open3D, RealSense, Kinect), depth of floats (TIFF, PFM, `.npy`) in metres, unless `with_depth_scale`
sets another unit.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.frame import MAX_DELAY
from vggtgeo.datasets.image_files import DEPTH_SUFFIXES, IMAGE_SUFFIXES, OTHER_PICTURES
from vggtgeo.datasets.intrinsics import camera_from_folder, camera_or_guess, guess_with_warning
from vggtgeo.io.errors import InputError, LeftOutWarning, warn

FRAMES_PER_SECOND = 30.0
_UNITS = (
    (re.compile(r"-?\d+\.\d+"), 1.0),
    (re.compile(r"\d{18,19}"), 1e-9),
    (re.compile(r"1\d{15}"), 1e-6),
    (re.compile(r"1\d{12}"), 1e-3),
)
"""Names that are times, and their unit: seconds, nanoseconds, and micro- and milliseconds since 1970."""
COLOUR = ("rgb", "color", "colour", "image", "images", "frames")
DEPTH = ("depth", "depths")
_NEITHER = {"conf", "confidence", "mask", "inverse", "disparity"}
"""Words in the names of files that are neither images nor depth."""
_LOOSE_SHARE = 0.5
"""Maximum number of images next to the colour folder, as a share of those in it: more would be the recording."""
_WITH_DEPTH = 0.5
"""Minimum number of depth files per image in a folder of both: a single image called `depth` is not enough."""
_NUMBERS = re.compile(r"([0-9]+)")
_NUMBERED = re.compile(r"[^0-9]*([0-9]{1,15})")


@dataclass(frozen=True)
class ImageFolder(FolderSequence):
    """Images of one folder, without depth. Ground truth: `groundtruth.txt` (TUM format), if present.

    Time is position / 30 s, unless all names are times: seconds with a decimal point (`12.034.png`), nanoseconds (18 or
    19 digits), or micro- or milliseconds since 1970 (16 or 13), or `with_rate` says otherwise.
    """

    @classmethod
    def matches(cls, folder: Path) -> bool:
        return bool(image_files(folder))

    @classmethod
    def open(cls, folder: Path) -> Self:
        images = image_files(folder)
        if not images:
            raise InputError(f"`{folder}` has no images ({', '.join(sorted(IMAGE_SUFFIXES))})")
        warn_of_unread(folder, images)
        times = times_or_rate(images)
        frames = [(time, image, None) for time, image in sorted(zip(times, images, strict=True))]
        return cls.listed(folder, frames, lambda *size: camera_or_guess(folder, *size))


def warn_of_unread(folder: Path, images: list[Path]) -> None:
    """Warn of images in unsupported formats that have no copy in `images` (phones write HEIC and JPEG)."""
    read = {image.stem for image in images}
    other = [
        path for path in files_like(folder, "*") if path.suffix.lower() in OTHER_PICTURES and path.stem not in read
    ]
    if other:
        text = f"`{folder}`: {len(other)} images (`{other[0].name}`) have an unsupported format"
        warn(LeftOutWarning(f"{text} and are left out: convert them to PNG or JPEG", len(other)))


def files_like(folder: Path, pattern: str) -> list[Path]:
    """Return the files in `folder` whose names match, in natural order, without hidden files.

    macOS writes a hidden file for each file that it copies to another disk (`._0.txt` for `0.txt`).
    """
    found = (path for path in folder.glob(pattern) if path.name[0] != "." and path.is_file())
    return sorted(found, key=lambda path: (natural_key(path.stem), path.name))


def natural_key(name: str) -> list[int | str]:
    """Return a key that sorts digits as numbers: `a2` before `a10`."""
    # `split` returns the groups of the pattern, the digits, at odd positions.
    return [int(part) if row % 2 else part.lower() for row, part in enumerate(_NUMBERS.split(name))]


def image_files(folder: Path, suffixes: frozenset[str] = IMAGE_SUFFIXES) -> list[Path]:
    """Return the images in `folder`, as `files_like`; suffixes: of images."""
    return [path for path in files_like(folder, "*") if path.suffix.lower() in suffixes]


def _times_by_name(files: list[Path]) -> list[float] | None:
    """Return seconds if all names are times."""
    stems = [file.stem for file in files]
    for pattern, unit in _UNITS:
        if all(pattern.fullmatch(stem) for stem in stems):
            return [float(stem) * unit for stem in stems]
    return None


def times_or_rate(images: list[Path]) -> list[float]:
    """Return seconds by the names if all are times, else position / 30 s."""
    return _times_by_name(images) or [index / FRAMES_PER_SECOND for index in range(len(images))]


def rows_of(images: list[Path], lines: int | None) -> tuple[int, ...]:
    """Return for each image its line in the list of times or poses of the whole recording.

    It is the number at the end of the image's name, so that a part of a recording keeps its times and its ground truth.
    It is the image's position if names have no distinct numbers, or numbers that do not fit a list with one line for
    each image. lines: of the list; None if there is none.
    """
    found = [_NUMBERED.fullmatch(image.stem) for image in images]
    numbers = [int(match.group(1)) for match in found if match]
    distinct = len(set(numbers)) == len(images)
    if distinct and (lines != len(images) or max(numbers, default=0) < lines):
        return tuple(numbers)
    return tuple(range(len(images)))


def partners_in_time(images: Sequence[tuple[float, Path]], depths: Sequence[tuple[float, Path]]) -> list[int | None]:
    """Return for each image (time, file) the row of its depth in a list in the order of time.

    Pairs are made in the order of their time difference, each row once.
    """
    times = np.array([time for time, _ in depths])
    candidates = []
    for row, (time, _) in enumerate(images):
        low, high = np.searchsorted(times, [time - MAX_DELAY, time + MAX_DELAY], side="left")
        candidates += [(abs(times[k] - time), row, k) for k in range(low, min(high + 1, len(times)))]
    partners: list[int | None] = [None] * len(images)
    taken: set[int] = set()
    for difference, row, k in sorted(candidates):
        if difference <= MAX_DELAY and partners[row] is None and k not in taken:
            partners[row] = k
            taken.add(k)
    return partners


@dataclass(frozen=True)
class RgbdFolders(FolderSequence):
    """Images in one folder, and their depth in a second one or the same. Ground truth: `groundtruth.txt` (TUM format).

    Depth is paired with the image of the same name; else of the same number (`rgb_7.png`, `depth_7.png`); else, if
    names are times, of the nearest time within 0.02 s. Times are those of `ImageFolder`. Depth of a lower resolution (a
    phone's LiDAR) is enlarged to images of the same aspect.
    """

    depth_of_fewer_pixels = True

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether `folder` has a colour folder and few images of its own, or names that distinguish depth."""
        colour = _find_folder(folder, COLOUR, IMAGE_SUFFIXES)
        if colour is None:
            return _files_by_words(folder) is not None
        return len(image_files(folder)) <= _LOOSE_SHARE * len(image_files(colour))

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the images and their depth files; raise InputError if they cannot be paired."""
        colour, (images, depths) = _find_files(folder)
        warn_of_unread(colour, images)
        times = times_or_rate(images)
        partners = _partners(folder, images, depths) if depths else [None] * len(images)
        rows = sorted(zip(times, images, partners, strict=True), key=lambda row: row[0])
        camera = lambda *size: (
            camera_from_folder(folder, *size)
            or camera_from_folder(colour, *size)
            or guess_with_warning(str(folder), *size)
        )
        return cls.listed(folder, rows, camera)


def _find_files(folder: Path) -> tuple[Path, tuple[list[Path], list[Path]]]:
    """Return the folder of the images, and the files of images and depths."""
    colour, depth = _find_folder(folder, COLOUR, IMAGE_SUFFIXES), _find_folder(folder, DEPTH, DEPTH_SUFFIXES)
    if colour is not None:
        return colour, (image_files(colour), [] if depth is None else image_files(depth, DEPTH_SUFFIXES))
    both = _files_by_words(folder)
    if both is None:
        raise InputError(f"`{folder}` has no folder of images named {', '.join(f'`{name}`' for name in COLOUR)}")
    return folder, both


def _files_by_words(folder: Path) -> tuple[list[Path], list[Path]] | None:
    """Return images and depth files of one folder, by words in their names; None if too few names mark depth."""
    depths = [path for path in image_files(folder, DEPTH_SUFFIXES) if _is_depth(path)]
    others = [path for path in image_files(folder) if not _words(path) & {*DEPTH, *_NEITHER}]
    images = [path for path in others if _words(path) & set(COLOUR)] or others
    return (images, depths) if images and len(depths) >= _WITH_DEPTH * len(images) else None


def _words(path: Path) -> set[str]:
    return set(re.findall(r"[a-z]+", path.stem.lower()))


def _is_depth(path: Path) -> bool:
    return bool(_words(path) & set(DEPTH)) and not _words(path) & _NEITHER


def _find_folder(folder: Path, names: Sequence[str], suffixes: frozenset[str]) -> Path | None:
    """Return the first folder of `names`, in upper or lower case, that has images; None without one.

    Any name with the word depth counts as `depth`, for example `aligned_depth_to_color`.
    """
    there = {}
    for path in sorted(path for path in folder.iterdir() if path.is_dir() and image_files(path, suffixes)):
        there[path.name.lower()] = path
        if _is_depth(path):
            there.setdefault(DEPTH[0], path)
    return next((there[name] for name in names if name in there), None)


def _partners(folder: Path, images: list[Path], depths: list[Path]) -> list[Path | None]:
    """Return the depth of each image, None without one."""
    for key in (lambda path: path.stem, _number):
        found = _paired_by(key, images, depths)
        if found is not None:
            return found
    image_times, depth_times = _times_by_name(images), _times_by_name(depths)
    if image_times is not None and depth_times is not None:
        listed = sorted(zip(depth_times, depths, strict=True))
        rows = partners_in_time(list(zip(image_times, images, strict=True)), listed)
        if any(row is not None for row in rows):
            return [None if row is None else listed[row][1] for row in rows]
    raise InputError(
        f"`{folder}`: the {len(images)} images ({images[0].name}, ...) and the {len(depths)} depths ({depths[0].name}, "
        f"...) cannot be paired: give both the same names or numbers, or times no more than {MAX_DELAY} s apart"
    )


def _paired_by(key: Callable[[Path], str | None], images: list[Path], depths: list[Path]) -> list[Path | None] | None:
    """Pair images and depths by a key of their names; None if keys are not distinct, or pair less than half."""
    keys = [[key(path) for path in paths] for paths in (images, depths)]
    if any(None in own or len(set(own)) < len(own) for own in keys):
        return None
    known = dict(zip(keys[1], depths, strict=True))
    found = [known.get(one) for one in keys[0]]
    paired = len(found) - found.count(None)
    return found if paired >= 0.5 * min(len(images), len(depths)) else None


def _number(path: Path) -> str | None:
    """Return the last number in a name; None without one, or if the name is a time."""
    numbers = re.findall(r"\d+", path.stem)
    return str(int(numbers[-1])) if numbers and _times_by_name([path]) is None else None
