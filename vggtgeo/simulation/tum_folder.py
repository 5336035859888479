"""Write a synthetic sequence as a TUM RGB-D folder, for any SLAM system.

`rgb/`, `depth/` (16-bit PNG, metres x 5000, 0 = none), `rgb.txt`, `depth.txt`, `groundtruth.txt`, and
`calibration.txt` (fx fy cx cy). The lists are written first: after an interruption they name missing files, which
readers report.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import write_picture, write_text
from vggtgeo.simulation.sequence import SyntheticSequence

_DEPTH_UNITS = 5000.0
_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)


def write_tum_folder(sequence: SyntheticSequence, folder: str | os.PathLike[str]) -> Iterator[Frame]:
    """Render `sequence` into `folder`, giving each frame once it is written (for a progress bar).

    Raises InputError if `folder` exists and is not empty, or is not writable.
    """
    target = Path(folder)
    check_new(target)
    for part in ("rgb", "depth"):
        (target / part).mkdir(parents=True, exist_ok=True)
    # Units and times first: without them an interrupted folder would be read with another unit of depth.
    fx, fy, cx, cy = sequence.camera.intrinsics
    write_text(target / "calibration.txt", f"{fx:.9g} {fy:.9g} {cx:.9g} {cy:.9g}\n")
    sequence.ground_truth().save_tum(target / "groundtruth.txt")
    times = [sequence.timestamp(index) for index in range(len(sequence))]
    for part in ("rgb", "depth") if sequence.has_depth else ("rgb",):
        lines = "".join(f"{time:.6f} {part}/{_name(time)}\n" for time in times)
        write_text(target / f"{part}.txt", f"# {sequence.name} (simulated)\n# timestamp filename\n{lines}")
    for frame in sequence.frames():
        name = _name(frame.timestamp)
        write_picture(target / "rgb" / name, np.ascontiguousarray(frame.image[..., ::-1]), _FAST)
        if frame.depth is not None:
            write_picture(target / "depth" / name, _depth_code(frame.depth), _FAST)
        yield frame


def _name(time: float) -> str:
    return f"{time:.6f}.png"


def check_new(folder: Path) -> None:
    """Raise InputError if `folder` exists and is not an empty folder."""
    if folder.is_symlink() and not folder.exists():
        raise InputError(f"`{folder}` is a broken link; give the name of a new folder")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"`{folder}` exists and is not an empty folder; give the name of a new one")


def _depth_code(depth: np.ndarray) -> np.ndarray:
    code = np.nan_to_num(depth * _DEPTH_UNITS, nan=0.0, posinf=0.0)
    return np.where(code < 65535, np.rint(code), 0).astype(np.uint16)
