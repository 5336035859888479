"""Messages about recordings of known kinds that are not read."""

import zipfile
from pathlib import Path

from vggtgeo.datasets.image_files import OTHER_PICTURES
from vggtgeo.datasets.images import files_like

_ARCHIVES = frozenset({".zip", ".tgz", ".gz", ".tar", ".7z", ".rar", ".bz2", ".tbz", ".xz", ".zst"})
_RAW_PARTS = ("image_00", "image_01", "image_02", "image_03", "oxts", "velodyne_points")


def reason_not_read(place: Path) -> str | None:
    """Return the message about a file or folder that is such a recording; None for any other."""
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
    if packed := next((file for file in files if _is_archive(file)), None):
        return f"`{packed}` is an archive; unpack it, and give the folder of images or the video that is in it"
    folders = [place, *sorted(path for path in place.iterdir() if path.is_dir())] if place.is_dir() else []
    for folder in folders:
        if other := next((file for file in files_like(folder, "*") if file.suffix.lower() in OTHER_PICTURES), None):
            return (
                f"`{folder}` holds `{other.name}`, ..., a kind of image that is not read; convert them to PNG or JPEG"
            )
    return None


def _downloads(folder: Path) -> list[Path]:
    """Archives and scans in a folder; none if folders lie beside them, which may be their content."""
    if any(path.is_dir() and path.name[0] != "." for path in folder.iterdir()):
        return []
    return [file for file in files_like(folder, "*") if file.suffix.lower() in _ARCHIVES | {".sens"}]


def _is_part_of_raw_kitti(place: Path) -> bool:
    if not place.is_dir():
        return False
    inside = place.resolve().name in _RAW_PARTS and (place / "data").is_dir()
    drive = any((place / name / "data").is_dir() for name in _RAW_PARTS)
    return inside or drive or (place / "calib_cam_to_cam.txt").is_file()


def _is_archive(file: Path) -> bool:
    """Return whether a file is an archive by its name, or a zip by its content, in which FFmpeg may find an image."""
    return file.suffix.lower() in _ARCHIVES or zipfile.is_zipfile(file)
