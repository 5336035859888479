"""A walk through a synthetic scene, as a sequence of frames that are rendered when they are asked for, and the errors
of its camera: exposure, noise, motion blur, rolling exposure, depth errors.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.argument_checks import check_kind, check_whole, check_within, real_array
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import write_picture, write_text
from vggtgeo.simulation.corridors import (
    BUILDING_WALK,
    CORRIDOR_WALK,
    STAIRCASE_WALK,
    build_building,
    build_corridor,
    build_staircase,
)
from vggtgeo.simulation.raster import encode
from vggtgeo.simulation.render import Picture, render
from vggtgeo.simulation.rooms import HALL_WALK, OFFICE_WALK, ROOM_WALK, build_hall, build_office, build_room
from vggtgeo.simulation.scene import Scene
from vggtgeo.simulation.trajectories import HandheldMotion, Walk

MAX_SAMPLES = 1000
"""Renderings for one image."""
MAX_ERROR = 1e9
"""Of any kind; larger ones leave nothing to estimate."""


@dataclass(frozen=True)
class Sensor:
    """The error model of the simulated RGB-D camera; zeros switch a part off.

    noise: standard deviation of the image noise in grey levels at middle grey (shot and read noise).
    exposure_swing: relative amplitude of the slow change of exposure, a period of about 6 s.
    exposure_time: seconds the shutter is open; each image is the mean of `blur_samples` instants in it.
    readout_time: seconds from the first to the last row (rolling exposure); timestamps name the middle.
    depth_noise: metres at 1 m; the deviation of depth is `depth_noise * z^2` as for triangulating sensors.
    depth_range: metres; depth outside it is missing.
    Raises InputError where a number is negative or a range is empty.
    """

    noise: float = 2.0
    exposure_swing: float = 0.0
    exposure_time: float = 0.0
    blur_samples: int = 5
    readout_time: float = 0.0
    depth_noise: float = 0.0012
    depth_range: tuple[float, float] = (0.25, 9.0)

    def __post_init__(self) -> None:
        for name in ("noise", "exposure_swing", "exposure_time", "readout_time", "depth_noise"):
            check_within(name, getattr(self, name), 0, MAX_ERROR)
        check_whole("blur_samples", self.blur_samples, 1, MAX_SAMPLES)
        near, far = real_array("depth_range", self.depth_range, (2,))
        if not 0 <= near < far:
            raise InputError(f"`depth_range` must be (near, far) with 0 <= near < far, got {self.depth_range}")

    def gain(self, time: float) -> float:
        """Return the exposure factor at `time` seconds, about 1."""
        return 1.0 + self.exposure_swing * float(np.sin(1.05 * time) + 0.5 * np.sin(0.43 * time + 1.0)) / 1.5

    def image(self, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return linear light float32 [H, W, 3] as a noisy uint8 image."""
        if not self.noise:
            return encode(light)
        noise = rng.standard_normal(light.shape, dtype=np.float32)
        # Shot noise grows as the root of light, the gamma curve flattens it: about even over the grey scale.
        noise *= self.noise * (0.7 + 0.4 * np.sqrt(np.clip(light, 0, 1)))
        return encode(light, noise)

    def depth(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return true depth float64 [H, W] as measured: float32, NaN outside the range."""
        measured = depth
        if self.depth_noise:
            measured = depth + self.depth_noise * depth**2 * rng.standard_normal(depth.shape, dtype=np.float32)
        inside = (measured > self.depth_range[0]) & (measured < self.depth_range[1])
        return np.where(inside, measured, np.nan).astype(np.float32)


IDEAL = Sensor(noise=0.0, depth_noise=0.0, depth_range=(0.0, np.inf))
"""A sensor without any error."""


WORLDS: dict[str, tuple[Callable[[int], Scene], Walk]] = {
    "room": (build_room, ROOM_WALK),
    "office": (build_office, OFFICE_WALK),
    "hall": (build_hall, HALL_WALK),
    "corridor": (build_corridor, CORRIDOR_WALK),
    "staircase": (build_staircase, STAIRCASE_WALK),
    "building": (build_building, BUILDING_WALK),
}
"""The built-in worlds by name: how each is built, and how it is walked through."""
_BAND = 16  # rows that share one pose under rolling exposure

_PACES = 1e-4, 1e4
"""Frames a second, and metres a second, that a walk is simulated at: beyond, times or places are the same, or none."""


@dataclass(frozen=True, eq=False)
class SyntheticSequence:
    """Frames of a synthetic scene (a `Sequence`), and exact truth about each of them.

    scene: what is seen. motion: pose as a function of time. camera: ideal pinhole. sensor: its errors. count: number
    of frames. rate: frames a second. seed: of the noise. Everything follows from these alone.
    """

    scene: Scene
    motion: HandheldMotion
    camera: Camera
    sensor: Sensor
    count: int
    rate: float
    seed: int
    has_depth: bool = True

    @property
    def name(self) -> str:
        return f"synthetic {self.scene.name}, seed {self.seed}"

    def __len__(self) -> int:
        return self.count

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """Render the frames at start, start + stride, ... below end, from the second on two at a time.

        InputError if that selects none.
        """
        check_selection(self.name, self.count, start, end, stride)
        indices = iter(range(start, min(self.count, end or self.count), stride))
        yield self.frame(next(indices))
        with ThreadPoolExecutor(2, thread_name_prefix="render") as pool:
            ahead = deque(pool.submit(self.frame, index) for index in islice(indices, 2))
            while ahead:
                frame = ahead.popleft().result()
                ahead.extend(pool.submit(self.frame, index) for index in islice(indices, 1))
                yield frame

    def ground_truth(self) -> Trajectory:
        """Return the exact poses, camera -> world."""
        times = np.array([self.timestamp(k) for k in range(self.count)])
        return Trajectory(times, np.array([self.motion.camera_to_world(time) for time in times]))

    def timestamp(self, index: int) -> float:
        """Return the time of the middle of the exposure, seconds."""
        return index / self.rate

    def pose(self, index: int) -> np.ndarray:
        """Return the true pose of a frame, world -> camera, float64 [4, 4]."""
        return self._pose_at(self.timestamp(index))

    def frame(self, index: int, picture: Picture | None = None) -> Frame:
        """Return one frame as the sensor sees it. picture: what `picture(index)` gives, where it is at hand."""
        rng = np.random.default_rng([self.seed, 19, index])
        picture = self.picture(index) if picture is None else picture
        light = self._exposed(index, picture) * np.float32(self.sensor.gain(self.timestamp(index)))
        image = self.sensor.image(light, rng)
        depth = self.sensor.depth(picture.depth, rng) if self.has_depth else None
        return Frame(index, self.timestamp(index), image, depth, f"{self.scene.name}-{index:05d}")

    def picture(self, index: int) -> Picture:
        """Render what an ideal camera sees at the frame's instant: light, exact depth, surfaces, glass."""
        return self._render(self.pose(index), 0, self.camera.height)

    def _pose_at(self, time: float) -> np.ndarray:
        return np.linalg.inv(self.motion.camera_to_world(time))

    def _render(self, pose: np.ndarray, top: int, bottom: int) -> Picture:
        fx, fy, cx, cy = self.camera.intrinsics
        return render(self.scene, pose, (fx, fy, cx, cy - top), (self.camera.width, bottom - top))

    def _exposed(self, index: int, picture: Picture) -> np.ndarray:
        """Return light [H, W, 3] gathered over the open shutter, row by row where the exposure rolls."""
        sensor, middle, height = self.sensor, self.timestamp(index), self.camera.height
        if not sensor.exposure_time and not sensor.readout_time:
            return picture.light
        count = sensor.blur_samples if sensor.exposure_time else 1
        instants = middle + sensor.exposure_time * ((np.arange(count) + 0.5) / count - 0.5)
        band = _BAND if sensor.readout_time else height
        light = np.zeros_like(picture.light)
        for top in range(0, height, band):
            bottom = min(top + band, height)
            late = sensor.readout_time * (0.5 * (top + bottom) / height - 0.5)
            for time in instants:
                light[top:bottom] += self._render(self._pose_at(time + late), top, bottom).light / np.float32(count)
        return light


def simulate(
    scene: str = "room",
    frames: int = 60,
    seed: int = 0,
    size: tuple[int, int] = (640, 480),
    *,
    rate: float = 30.0,
    speed: float | None = None,
    sensor: Sensor | None = None,
) -> SyntheticSequence:
    """Return a hand-held walk of `frames` frames through the built-in `scene`.

    scene: a key of `WORLDS`. size: (width, height), pixels. rate: frames a second. speed: metres a second, None for
    the scene's own. sensor: error model, None for `Sensor()`. The horizontal field of view is 62 degrees.
    Raises InputError for an unknown scene or a number that is not positive.

    Example:
        >>> import vggtgeo as vg
        >>> sequence = vg.simulate("room", 10, size=(160, 120))
        >>> frame = next(sequence.frames())
        >>> frame.image.shape, len(sequence.ground_truth())
        ((120, 160, 3), 10)

    """
    check_walk(scene, frames, size, rate, speed)
    check_kind("sensor", sensor, Sensor | None, "a `vggtgeo.simulation.Sensor`")
    check_whole("seed", seed)
    build, walk = WORLDS[scene]
    motion = HandheldMotion.along(walk, seed)
    if speed is not None:
        motion = replace(motion, speed=speed)
    return SyntheticSequence(build(seed), motion, camera_of(size), sensor or Sensor(), frames, rate, seed)


MAX_FRAMES, MAX_SIDE = 1_000_000, 8192
"""More would take all memory before the first frame."""


def check_walk(scene: str, frames: int, size: tuple[int, int], rate: float, speed: float | None) -> None:
    """Raise InputError for what `simulate` cannot take."""
    if scene not in tuple(WORLDS):
        raise InputError(f"`scene` must be one of {', '.join(WORLDS)}, got {scene!r}")
    check_whole("frames", frames, 1, MAX_FRAMES)
    for side in real_array("size", size, (2,)):
        check_whole("size", side, 1, MAX_SIDE)
    check_within("rate", rate, *_PACES)
    check_within("speed", 1.0 if speed is None else speed, *_PACES)


def camera_of(size: tuple[int, int]) -> Camera:
    """Return the simulated camera for images of `size` = (width, height): ideal, 62 degrees wide."""
    width, height = size
    focal = 0.832 * width
    return Camera((focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)), width, height)


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
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"`{folder}` exists and is not an empty folder; give the name of a new one")


def _depth_code(depth: np.ndarray) -> np.ndarray:
    code = np.nan_to_num(depth * _DEPTH_UNITS, nan=0.0, posinf=0.0)
    return np.where(code < 65535, np.rint(code), 0).astype(np.uint16)
