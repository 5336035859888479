"""Rows of the table of bad inputs: bags of ROS, from their topics to single messages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import tiny_bags as bags
from bad_row import Row, read_frames, rows
from tiny_bags import SIZE, Topic, but, image, info, packed, pose

NAN = float("nan")


def bag(**topics: Topic) -> Callable[[Path], Path]:
    """Images and their camera, and what is given in their place or beside them."""
    return lambda folder: bags.write(folder / "c.bag", **({"c_image": image(), "c_info": info()} | topics))


def only(**topics: Topic) -> Callable[[Path], Path]:
    """These topics alone."""
    return lambda folder: bags.write(folder / "c.bag", **topics)


def camera(*matrix: float, **other: object) -> Callable[[Path], Path]:
    """Images beside a camera of this matrix."""
    return bag(c_info=info(matrix=lambda number: matrix, **other))  # type: ignore[arg-type]


def depth(value: float, **other: float) -> Callable[[Path], Path]:
    """Images and depth, in floats, all of this value."""
    pixels = lambda number: np.full(SIZE[::-1], value, np.float32)
    return bag(d_image=image(pixels, "32FC1", later=0.005, **other))


def small(number: int) -> np.ndarray:
    """One image smaller than the others."""
    pixels = image()[1](number)["data"].reshape(*SIZE[::-1], 3)  # type: ignore[index, call-overload]
    return pixels[: 20 if number == 1 else None]


def wide(number: int, channels: int = 3) -> np.ndarray:
    """An image of 12 bits."""
    return np.full((*SIZE[::-1], channels), 1000 + 500 * number, np.uint16)


def squares(number: int) -> np.ndarray:
    """Grey values, and below them a colour for each two by two."""
    return np.full((SIZE[1] * 3 // 2, SIZE[0]), 100 + number, np.uint8)


def parts(folder: Path) -> Path:
    """A recording in two files."""
    for number in range(2):
        bags.write(folder / f"c_{number}.bag", c_image=image())
    return folder


def ros2(folder: Path, declared: int = bags.COUNT) -> Path:
    """A bag beside the camera of its images."""
    made = bags.write_ros2(folder / "c", declared)
    (made / "calibration.txt").write_text("50 50 20 15")
    return made


def changed_ros2(folder: Path, change: Callable[[Path], object]) -> Path:
    """A bag whose file of messages was changed."""
    made = ros2(folder)
    change(next(made.glob("*.db3")))
    return made


def doubled(file: Path) -> None:
    """A second file of messages."""
    file.with_name("c_1.db3").write_bytes(file.read_bytes())


BAGS: list[Row] = rows(
    "ROS bags",
    [
        ("no topic of images", only(c_info=info())),
        ("a topic of images without a message", only(c_image=(bags.IMAGE, lambda number: None))),
        ("an encoding that is not read", bag(c_image=image(lambda number: np.zeros(SIZE[::-1], np.int32), "32SC1"))),
        ("NV12", bag(c_image=image(squares, "nv12", height=SIZE[1]))),
        (
            "a video, H.264, as compressed images",
            bag(c_image=packed(lambda number: b"\0\0\0\1\x67" + bytes(90), "h264")),
        ),
        ("one image that is damaged", bag(c_image=but(image(), 1, b"\1\2\3"))),
        ("one image of another size", bag(c_image=image(small))),
        ("a camera of other images", bag(c_info=info(size=(640, 480)))),
        ("a camera that nobody calibrated", camera(*[0] * 9)),
        ("a camera with a NaN", camera(NAN, 0, 20, 0, 50, 15, 0, 0, 1)),
        ("a lens of 12 coefficients, zeros from the second", bag(c_info=info(distortion=(0.01,) + (0.0,) * 11))),
        ("a camera that zooms", bag(c_info=info(matrix=lambda number: (50 + 20 * number, *bags.MATRIX[1:])))),
        ("a folder of several bags of ROS 1", parts),
        ("a ROS 2 bag that lacks one of its files", lambda folder: changed_ros2(folder, Path.unlink)),
        ("depth of NaN", depth(NAN)),
        ("depth of another size", bag(d_image=image(lambda number: np.ones((20, 20), np.float32), "32FC1"))),
        (
            "depth 60 ms later than the images",
            bag(d_image=image(lambda number: np.ones(SIZE[::-1], np.float32), "32FC1", later=0.06)),
        ),
        ("truth that is damaged in part", bag(gt=but(pose(), 1, b"\1"))),
    ],
    call=read_frames,
)
