"""Which topics of a bag are read, and what their messages hold. Oracle: what the messages were made of."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import tiny_sequences
from reported import raises

from vggtgeo.datasets.bag_cameras import camera_of
from vggtgeo.datasets.bag_images import Chosen, chosen_topics, image_of, metres_of

PLACE = Path("a.bag, /c, 0")

COMPRESSED = "16UC1; compressedDepth png"


def raw(encoding: str, pixels: np.ndarray | None = None) -> Any:
    """A message of `sensor_msgs/Image`."""
    pixels = np.zeros((4, 6), np.uint8) if pixels is None else pixels
    data = np.frombuffer(pixels.tobytes(), np.uint8)
    height, width = pixels.shape[:2]
    shape = {"height": height, "width": width, "step": len(data) // height}
    return SimpleNamespace(encoding=encoding, data=data, is_bigendian=0, **shape)


def packed(kind: str, data: bytes = b"") -> Any:
    """A message of `sensor_msgs/CompressedImage`."""
    return SimpleNamespace(format=kind, data=np.frombuffer(data, np.uint8))


@pytest.mark.parametrize(
    ("topics", "colour", "depth"),
    [
        (
            {"/c/depth/image_raw": "16UC1", "/c/depth_registered/image_raw": "16UC1", "/c/rgb/image_color": "rgb8"},
            "/c/rgb/image_color",
            "/c/depth_registered/image_raw",
        ),
        ({"/camera/ir/image": "mono8", "/camera/rgb/image_color": "rgb8"}, "/camera/rgb/image_color", ""),
        ({"/camera/ir/image": "16UC1", "/camera/rgb/image_color": "rgb8"}, "/camera/rgb/image_color", ""),
        ({"/camera/infra1/image_rect_raw": "mono8", "/camera/left/image": "mono8"}, "/camera/left/image", ""),
        ({"/camera/infra1/image": "mono8", "/camera/infra2/image": "mono8"}, "/camera/infra1/image", ""),
        ({"/cam0/image_raw": "mono8", "/cam1/image_raw": "mono8"}, "/cam0/image_raw", ""),
        ({"/cam/grey": "mono8", "/cam/raw": "bayer_rggb8"}, "/cam/raw", ""),
        (
            {"/camera/depth/image": "mono16", "/camera/thermal/image": "mono16"},
            "/camera/thermal/image",
            "/camera/depth/image",
        ),
        ({"/depth/false_colours": "rgb8", "/front/image": "mono8"}, "/front/image", ""),
    ],
)
def test_the_best_topics_are_chosen(topics: dict[str, str], colour: str, depth: str) -> None:
    # Proves colour before grey, infrared last, and never as depth, and registered depth before any other.
    chosen = chosen_topics(PLACE, {name: raw(encoding) for name, encoding in topics.items()})
    assert (chosen.colour, chosen.depth) == (colour, depth)
    assert set(chosen.others) == set(topics) - {colour, depth}


def test_compressed_topics() -> None:
    # Proves that depth is known by its format, or by the name of its topic.
    colour = packed("bgr8; jpeg compressed bgr8")
    for name, kind in (("/d/image_raw/compressedDepth", COMPRESSED), ("/d/compressed", "16UC1; png compressed ")):
        assert chosen_topics(PLACE, {name: packed(kind), "/c/compressed": colour}) == Chosen("/c/compressed", name, ())


@pytest.mark.parametrize("encoding", ["bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"])
def test_images_behind_a_mosaic(encoding: str) -> None:
    # Proves which pixel has which colour. Oracle: a wall of one colour, seen through the filter that the name says.
    colour = {"r": 200, "g": 120, "b": 40}
    pattern = np.array([colour[letter] for letter in encoding.removeprefix("bayer_")[:4]], np.uint8).reshape(2, 2)
    image = image_of(raw(encoding, np.tile(pattern, (8, 10))), PLACE).image
    np.testing.assert_array_equal(image[4:-4, 4:-4].reshape(-1, 3), np.tile([200, 120, 40], (96, 1)))


@pytest.mark.parametrize(("encoding", "places"), [("yuv422", "uyvy"), ("yuv422_yuy2", "yuyv")])
def test_images_in_brightness_and_colour(encoding: str, places: str) -> None:
    # Proves the order of the bytes. Oracle: grey of brightness 126 (16 to 235), which has no colour, is 128.
    values = {"y": 126, "u": 128, "v": 128}
    pixels = np.tile(np.array([values[letter] for letter in places], np.uint8).reshape(2, 2), (4, 3, 1))
    np.testing.assert_allclose(image_of(raw(encoding, pixels), PLACE).image, 128, atol=1)


def test_compressed_depth() -> None:
    # Proves millimetres with and without the head, and floats by their inverse. Oracle: the depths that were coded.
    codes = tiny_sequences.depth_codes(1)
    png = cv2.imencode(".png", codes)[1].tobytes()
    for kind, content in ((COMPRESSED, bytes(12) + png), ("16UC1; png compressed ", png)):
        depth = metres_of(packed(kind, content), PLACE)
        assert np.isnan(depth[0, 0])
        np.testing.assert_allclose(depth[1:], codes[1:] / 1000, rtol=1e-6)
    a, b = np.float32(1000.0), np.float32(-3.5)
    inverse = np.array([[0, 200, 1000]], np.uint16)
    head = bytes(4) + np.array([a, b], "<f4").tobytes()
    floats = packed("32FC1; compressedDepth png", head + cv2.imencode(".png", inverse)[1].tobytes())
    np.testing.assert_allclose(metres_of(floats, PLACE), [[np.nan, 1000 / 203.5, 1000 / 1003.5]], rtol=1e-6)
    for rest in (bytes(60), bytes(12), b""):
        with raises("a.bag, /c, 0"):
            metres_of(packed("16UC1; compressedDepth rvl", rest), PLACE)
    with raises("a.bag, /c, 0"):
        image_of(packed("bgr8; jpeg compressed bgr8"), PLACE)


@pytest.mark.parametrize(
    ("encoding", "channels", "order"),
    [("mono16", 1, "<"), ("rgb16", 3, ">"), ("bgr16", 3, "<"), ("bgra16", 4, "<"), ("16UC3", 3, ">")],
)
def test_images_of_16_bits(encoding: str, channels: int, order: str) -> None:
    # Proves that 12 bits are scaled as those of a file are, by the bits that the values need, in either byte order.
    codes = np.arange(4 * 6 * channels).reshape(4, 6, channels) * 25 + 1200  # up to 3575
    message = raw(encoding, codes.astype(np.dtype(np.uint16).newbyteorder(order)))
    message.is_bigendian = int(order == ">")
    read = image_of(message, PLACE)
    colours = np.broadcast_to(codes, (4, 6, 3)) if channels == 1 else codes[..., :3]
    expected = (colours if encoding.startswith(("rgb", "mono")) else colours[..., ::-1]) >> 4
    np.testing.assert_array_equal(read.image, expected)
    assert read.bits == 12
    assert (image_of(message, PLACE, 16).image == expected >> 4).all()


def test_the_camera_of_a_part_of_the_sensor_with_pixels_put_together() -> None:
    # Oracle: the definition of the message, on a sensor of 640 x 480 of which 400 x 200 pixels are read, two as one.
    region = SimpleNamespace(x_offset=120, y_offset=200, width=400, height=200)
    info = SimpleNamespace(width=640, height=480, binning_x=2, binning_y=2, roi=region, distortion_model="plumb_bob")
    info.k, info.d = np.array([500.0, 0, 320, 0, 510, 300, 0, 0, 1]), np.zeros(5)
    found = camera_of(Path("a.bag"), {"/c/info": info}, "/c/image", (200, 100))
    assert found is not None
    np.testing.assert_allclose(found.intrinsics, (250.0, 255.0, 100.0, 50.0))
