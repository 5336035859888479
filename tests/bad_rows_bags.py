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


BAGS: list[Row] = rows(
    "ROS bags",
    [
        ("no topic of images", only(c_info=info())),
        ("a topic of images without a message", only(c_image=(bags.IMAGE, lambda number: None))),
        ("an encoding that is not read", bag(c_image=image(lambda number: np.zeros(SIZE[::-1], np.uint16), "mono16"))),
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
