"""Recordings whose layout is known and not read: what they are, and what to do."""

from pathlib import Path

from vggtgeo.datasets.image_files import OTHER_PICTURES
from vggtgeo.datasets.images import files_like

_RAW_PARTS = ("image_00", "image_01", "image_02", "image_03", "oxts", "velodyne_points")


def reason_not_read(place: Path) -> str | None:
    """A sentence about a file or folder that is such a recording; None for any other."""
    if _is_part_of_raw_kitti(place):
        return (
            f"`{place}` is a part of KITTI's raw recordings; give the folder of a drive, which holds `image_02/data` "
            "or `image_00/data`"
        )
    files = [place] if place.is_file() else _downloads(place)
    if sensed := next((file for file in files if file.suffix == ".sens"), None):
        return (
            f"`{sensed}` is a scan of ScanNet as it is downloaded; export its images, depth, poses and intrinsics with "
            "ScanNet's SensReader, and give the folder of those"
        )
    if packed := next((file for file in files if _archive(file)), None):
        return f"`{packed}` is {_archive(packed)}; unpack it, and give the folder of images or the video that is in it"
    folders = [place, *sorted(path for path in place.iterdir() if path.is_dir())] if place.is_dir() else []
    for folder in folders:
        if other := next((file for file in files_like(folder, "*") if file.suffix.lower() in OTHER_PICTURES), None):
            return (
                f"`{folder}` holds `{other.name}`, ..., a kind of image that is not read; convert them to PNG or JPEG"
            )
    return None


def _downloads(folder: Path) -> list[Path]:
    """Files of a folder that are named as archives and scans are; none beside a folder, which may be what they held."""
    if any(path.is_dir() and path.name[0] != "." for path in folder.iterdir()):
        return []
    return [file for file in files_like(folder, "*") if file.suffix.lower() in _DOWNLOADED]


_DOWNLOADED = frozenset({".sens", ".zip", ".tgz", ".gz", ".tar", ".7z", ".rar", ".bz2", ".tbz", ".xz", ".zst"})


_ARCHIVES = {
    b"PK\x03\x04": "a zip archive",
    b"\x1f\x8b": "a gzip archive",
    b"7z\xbc\xaf\x27\x1c": "a 7-Zip archive",
    b"Rar!": "a RAR archive",
    b"BZh": "a bzip2 archive",
    b"\xfd7zXZ": "an xz archive",
    b"\x28\xb5\x2f\xfd": "a zstd archive",
}
"""First bytes of the common ones; FFmpeg takes one that holds a picture for a video of one frame."""
_TAR = 257, b"ustar"


def _archive(file: Path) -> str | None:
    try:
        with file.open("rb") as opened:
            head = opened.read(_TAR[0] + len(_TAR[1]))
    except OSError:
        return None
    if head[_TAR[0] :] == _TAR[1]:
        return "a tar archive"
    return next((kind for start, kind in _ARCHIVES.items() if head.startswith(start)), None)


def _is_part_of_raw_kitti(place: Path) -> bool:
    if not place.is_dir():
        return False
    inside = place.resolve().name in _RAW_PARTS and (place / "data").is_dir()
    drive = any((place / name / "data").is_dir() for name in _RAW_PARTS)
    return inside or drive or (place / "calib_cam_to_cam.txt").is_file()
