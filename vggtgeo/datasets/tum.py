"""TUM RGB-D folders: `rgb.txt` and `depth.txt` (lines `timestamp file`), `groundtruth.txt`, 16-bit depth / 5000.

ETH3D SLAM (whose `calibration.txt` is read, too) and Bonn RGB-D Dynamic have the same layout. Colour and depth have
different times: an image gets the depth nearest in time, at most 0.02 s away, and each depth is used once. Without
`rgb.txt` a list of pairs is read (`associations.txt`), as ETH3D SLAM has it and ORB-SLAM2 needs it.

Source: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from vggtgeo.datasets.folder import MAX_TIMESTAMP, FolderSequence
from vggtgeo.datasets.image_files import FIVE_THOUSANDTHS
from vggtgeo.datasets.images import partners_in_time
from vggtgeo.datasets.intrinsics import camera_from_folder, guess_with_warning, published_camera
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError, LeftOutWarning, warn
from vggtgeo.io.files import whole_text

_MAX_LETTERS = 200
"""Maximum length of a line that is quoted in an error."""
_PAIRS = ("associated.txt", "associations.txt", "association.txt", "associate.txt")
_Entry = tuple[float, Path]
_Frame = tuple[float, Path, Path | None]


@dataclass(frozen=True)
class TumRgbd(FolderSequence):
    """One sequence in the layout of the TUM RGB-D benchmark. Truth: `groundtruth.txt`, at its own times (100 Hz)."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        return _list_of(folder) is not None

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Read and pair the lists; without `depth.txt` the sequence has no depth."""
        file = _list_of(folder)
        frames = _frames_of_lists(folder) if file is None or file.name == "rgb.txt" else _frames_of_pairs(file)
        return cls.listed(folder, frames, lambda *size: _camera(folder, *size), FIVE_THOUSANDTHS)


def _camera(folder: Path, width: int, height: int) -> Camera:
    return (
        camera_from_folder(folder, width, height)
        or published_camera(folder.resolve().name, width, height)
        or published_camera(_recording(folder), width, height)
        or guess_with_warning(str(folder), width, height)
    )


def _list_of(folder: Path) -> Path | None:
    """Return the file with the list of images, else of pairs; None without either."""
    return next((file for name in ("rgb.txt", *_PAIRS) if (file := folder / name).is_file()), None)


def _recording(folder: Path) -> str:
    """Return the name of the recording in the comment of `rgb.txt` (`# file: 'NAME.bag'`): a folder may be renamed."""
    file = folder / "rgb.txt"
    return " ".join(line.partition("file:")[2] for line in head_of(file, comments=True)) if file.is_file() else ""


def head_of(file: Path, comments: bool = False) -> list[str]:
    """Return those of the first lines of a list that are entries, or with `comments` those that are comments."""
    with file.open(encoding="utf-8-sig", errors="replace") as lines:
        head = [line[:_MAX_LETTERS] for line in itertools.islice(lines, 5)]
    return [line for line in head if line.startswith("#") == comments]


def _frames_of_lists(folder: Path) -> list[_Frame]:
    images = _read_list(folder / "rgb.txt", frames=True)
    depths = _read_list(folder / "depth.txt") if (folder / "depth.txt").is_file() else []
    return [
        (time, image, None if partner is None else depths[partner][1])
        for (time, image), partner in zip(images, partners_in_time(images, depths), strict=True)
    ]


def _frames_of_pairs(file: Path) -> list[_Frame]:
    if file.name != _PAIRS[0]:
        warn(f"`{file}`: depth is read in units of 1/5000 m, as in TUM RGB-D; pass --depth-scale 1000 for millimetres")
    depths = {(time, file.parent / image): file.parent / depth for time, image, depth in read_pairs(file, "TIME")}
    return [(at, image, depths[at, image]) for at, image in _in_order(file, list(depths), frames=True)]


def read_pairs(file: Path, time: str) -> list[tuple[float, str, str]]:
    """Return time, image and depth of each line of a list of pairs; on a line either may come first.

    time: name of the column of times, for errors.
    """
    pairs = []
    for words in _rows(file, 4, f"{time} rgb/{time}.png {time} depth/{time}.png"):
        seconds, image, _, depth = (*words[2:], *words[:2]) if "depth" in words[1] else words
        pairs.append((float(seconds), image, depth))
    return pairs


def _read_list(file: Path, frames: bool = False) -> list[_Entry]:
    """Return the entries in the order of time; frames: whether they are images, which are counted if left out."""
    entries = [(float(time), file.parent / name) for time, name in _rows(file, 2, "timestamp file")]
    return _in_order(file, entries, frames)


def _rows(file: Path, columns: int, expected: str) -> list[list[str]]:
    """Return the words of each line; the first and every second after it must be a time in seconds."""
    rows = []
    for number, line in enumerate(whole_text(file).splitlines(), start=1):
        words = line.split("#", 1)[0].replace(",", " ").split(maxsplit=columns - 1)
        if not words:
            continue
        try:
            valid = len(words) == columns and all(abs(float(time)) <= MAX_TIMESTAMP for time in words[::2])
        except ValueError:
            valid = False
        if not valid:
            found = line[:_MAX_LETTERS]
            raise InputError(f"`{file}`, line {number}: expected `{expected}`, times in seconds, got {found!r}")
        rows.append([word.strip() for word in words])
    if not rows:
        raise InputError(f"`{file}` is empty; expected lines `{expected}`")
    return rows


def _in_order(file: Path, entries: list[_Entry], frames: bool) -> list[_Entry]:
    ordered = sorted(entries, key=lambda entry: entry[0])
    if ordered != entries:
        warn(f"`{file}`: timestamps are out of order; the list is sorted by time")
    unique = [entry for row, entry in enumerate(ordered) if row == 0 or entry[0] > ordered[row - 1][0]]
    if len(unique) < len(ordered):
        text = f"`{file}`: {len(ordered) - len(unique)} lines repeat the time of another; only the first is used"
        warn(LeftOutWarning(text, len(ordered) - len(unique)) if frames else text)
    return unique
