"""Rows of the table of bad inputs: bags of ROS, from their topics to single messages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import picture_bytes as bytes_of
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


def swapped(number: int) -> np.ndarray:
    """The same, the bytes in the order of other processors."""
    return wide(number).byteswap()


def squares(number: int) -> np.ndarray:
    """Grey values, and below them a colour for each two by two."""
    return np.full((SIZE[1] * 3 // 2, SIZE[0]), 100 + number, np.uint8)


def binned(
    binning: int, size: tuple[int, int], region: tuple[int, int, int, int] = (0, 0, 0, 0)
) -> Callable[[Path], Path]:
    """Images beside a camera of this sensor."""
    matrix = (100, 0, size[0] / 2, 0, 100, size[1] / 2, 0, 0, 1)
    return bag(c_info=info(size=size, matrix=lambda number: matrix, binning=binning, region=region))


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
        ("grey of 16 bits", bag(c_image=image(lambda number: wide(number)[..., 0], "mono16"))),
        ("colours of 16 bits, the other byte order", bag(c_image=image(swapped, "rgb16", is_bigendian=1))),
        ("four channels of 8 bits", bag(c_image=image(lambda number: wide(number, 4).astype(np.uint8), "8UC4"))),
        ("NV12", bag(c_image=image(squares, "nv12", height=SIZE[1]))),
        ("NV21 that lacks its colours", bag(c_image=image(lambda number: squares(number)[: SIZE[1]], "nv21"))),
        (
            "a video, H.264, as compressed images",
            bag(c_image=packed(lambda number: b"\0\0\0\1\x67" + bytes(90), "h264")),
        ),
        ("images whose bytes are not those of their size", bag(c_image=image(step=7))),
        ("one image that is damaged", bag(c_image=but(image(), 1, b"\1\2\3"))),
        ("a first image that is damaged", bag(c_image=but(image(), 0, b"\1\2\3"))),
        (
            "one JPEG that is cut off",
            bag(c_image=packed(lambda number: bags.jpeg(number)[: 400 if number == 2 else None])),
        ),
        (
            "a TIFF's header of 30000 x 30000 pixels",
            bag(c_image=packed(lambda number: bytes_of.tiff_header(30000, 30000))),
        ),
        ("one image of another size", bag(c_image=image(small))),
        (
            "images in pairs of pixels, of an odd width",
            bag(c_image=image(lambda number: np.zeros((30, 41, 2), np.uint8), "yuv422")),
        ),
        ("a camera of other images", bag(c_info=info(size=(640, 480)))),
        ("a camera that nobody calibrated", camera(*[0] * 9)),
        ("a camera with a NaN", camera(NAN, 0, 20, 0, 50, 15, 0, 0, 1)),
        ("a camera that is no matrix of intrinsics", camera(50, 0, 20, 0, 50, 15, 5, 5, 5)),
        ("cx and cy in each other's place", camera(50, 0, 15, 0, 50, 20, 0, 0, 1)),
        ("a lens of 14 coefficients", bag(c_info=info(distortion=(0.01,) * 14))),
        ("a lens of 12 coefficients, zeros from the second", bag(c_info=info(distortion=(0.01,) + (0.0,) * 11))),
        (
            "a fisheye of four coefficients and a zero",
            bag(c_info=info(distortion=(0.1, 0, 0, 0, 0), lens="equidistant")),
        ),
        ("a camera of other topics alone", only(left_image=image(), right_info=info())),
        ("a camera that zooms", bag(c_info=info(matrix=lambda number: (50 + 20 * number, *bags.MATRIX[1:])))),
        ("a camera whose images have one pixel for two by two", binned(2, (2 * SIZE[0], 2 * SIZE[1]))),
        ("a camera whose images are a part of the sensor", binned(1, (640, 480), (300, 225, SIZE[1], SIZE[0]))),
        ("a camera of one pixel for two by two, and images of all pixels", binned(2, SIZE)),
        ("times of more than a second beside the seconds", bag(c_image=image(time=(50, 2_500_000_000)))),
        ("a folder of several bags of ROS 1", parts),
        ("a ROS 2 bag that lacks one of its files", lambda folder: changed_ros2(folder, Path.unlink)),
        ("a ROS 2 bag with a file that its metadata does not name", lambda folder: changed_ros2(folder, doubled)),
        ("a ROS 2 bag whose metadata counts more images than it has", lambda folder: ros2(folder, 400)),
        ("depth of NaN", depth(NAN)),
        ("depth of 1e30", depth(1e30)),
        ("depth of bytes in the other order", depth(1.5, is_bigendian=1)),
        ("depth of another size", bag(d_image=image(lambda number: np.ones((20, 20), np.float32), "32FC1"))),
        (
            "depth 60 ms later than the images",
            bag(d_image=image(lambda number: np.ones(SIZE[::-1], np.float32), "32FC1", later=0.06)),
        ),
        (
            "depth whose rows are padded",
            bag(d_image=image(lambda number: np.ones((30, 44), np.float32), "32FC1", width=40)),
        ),
        (
            "one depth image that is damaged",
            bag(d_depth=but(packed(bags.depth_png, "16UC1; compressedDepth"), 1, b"\1")),
        ),
        (
            "depth in floats, compressed, without its two numbers",
            bag(d_depth=packed(bags.depth_png, "32FC1; compressedDepth")),
        ),
        ("truth that is damaged in part", bag(gt=but(pose(), 1, b"\1"))),
        ("truth with quaternions of length 7", bag(gt=pose(turn=(0.0, 0.0, 0.0, 7.0)))),
        ("truth of 1e300 metres", bag(gt=pose(lambda number: (1e300, 0.0, 0.0)))),
        ("truth of one time", bag(gt=pose(time=lambda number: 50.0))),
        ("truth out of order", bag(gt=pose(time=lambda number: 53.0 - number))),
    ],
    call=read_frames,
)
