"""EuRoC MAV in the ASL layout: `mav0/cam0/data.csv`, `mav0/cam0/data/NANOSECONDS.png`, `sensor.yaml`, ground truth.

Only the left camera is read; its distortion is removed later, as for all readers.

Source: M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.intrinsics import intrinsics_of, is_fisheye
from vggtgeo.datasets.pose_files import check_size, load_trajectory, parsing, trajectory_of, yaml_numbers
from vggtgeo.geometry.camera import Camera, check_distortion
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, NoteWarning, warn
from vggtgeo.io.files import whole_text

_MODEL = re.compile(r"^\s*distortion_model\s*:\s*['\"]?([\w-]+)", re.MULTILINE)


@dataclass(frozen=True)
class Euroc(FolderSequence):
    """One flight, left camera. Truth: `state_groundtruth_estimate0`, poses of the body, transformed to the camera."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        return _base(folder) is not None

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the left camera's images; warn that the IMU is not used."""
        base = _base(folder)
        if base is None:
            raise InputError(f"`{folder}` must have `mav0/cam0/data.csv`, as a sequence of EuRoC")
        if (base / "imu0" / "data.csv").is_file():
            warn(f"`{folder}`: the IMU is not used; from images alone the scale is unknown", NoteWarning)
        camera_folder = base / "cam0"
        frames = [(time, camera_folder / "data" / name, None) for time, name in _images(camera_folder / "data.csv")]
        sensor = camera_folder / "sensor.yaml"
        whole = cls.listed(folder, sorted(frames), lambda width, height: _camera(sensor, width, height))
        return replace(whole, folder=base)

    def ground_truth(self) -> Trajectory | None:
        """Return the true poses of the left camera, at their own times."""
        file = self.folder / "state_groundtruth_estimate0" / "data.csv"
        if not file.is_file():
            return None
        body = load_trajectory(file)
        extrinsics = np.reshape(yaml_numbers(self.folder / "cam0" / "sensor.yaml", "data", 16), (4, 4))
        return trajectory_of(body.timestamps, body.poses @ extrinsics, file)


def _camera(sensor: Path, width: int, height: int) -> Camera:
    """Return the camera of a `sensor.yaml` for images of this size. EuRoC's lenses are "radial-tangential", those of
    TUM VI "equidistant".
    """
    check_size(sensor, yaml_numbers(sensor, "resolution", 2, [width, height]), (width, height))
    intrinsics = intrinsics_of(sensor, yaml_numbers(sensor, "intrinsics"))
    coefficients = yaml_numbers(sensor, "distortion_coefficients")
    found = _MODEL.search(whole_text(sensor))
    fisheye = is_fisheye(f"`{sensor}`: `distortion_model`", found.group(1) if found else "")
    with parsing(sensor, "the coefficients of its lens"):
        return Camera(intrinsics, width, height, check_distortion(coefficients), fisheye=fisheye)


def _base(folder: Path) -> Path | None:
    return next((base for base in (folder / "mav0", folder) if (base / "cam0" / "data.csv").is_file()), None)


def _images(file: Path) -> list[tuple[float, str]]:
    with parsing(file, "lines `nanoseconds,file`"):
        lines = [line.split("#", 1)[0] for line in whole_text(file).splitlines()]
        parts = [[part.strip() for part in line.partition(",")[::2]] for line in lines if line.strip()]
        return [(int(time) * 1e-9, name or f"{time}.png") for time, name in parts]
