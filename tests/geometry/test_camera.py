"""The camera model and the way to the ideal pinhole image, against OpenCV's projection."""

import math

import cv2
import numpy as np
import pytest
from reported import raises

from vggtgeo.geometry.camera import Camera

WIDTH, HEIGHT = 160, 120
INTRINSICS = (131.0, 129.0, 79.0, 61.0)
DISTORTIONS = {
    "barrel": (-0.2, 0.05, 0.0, 0.0),
    "tangential": (0.02, -0.03, 0.004, -0.003),
    "freiburg1": (0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
}


def _distorted_pixels(camera: Camera) -> np.ndarray:
    """Where each pixel of the ideal image lies in the distorted one, [H, W, 2] as (x, y). Oracle: projectPoints."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ np.linalg.inv(camera.matrix).T
    zero = np.zeros(3)
    pixels, _ = cv2.projectPoints(rays, zero, zero, camera.matrix, np.array(camera.distortion))
    return pixels.reshape(camera.height, camera.width, 2)


def _inside(pixels: np.ndarray, margin: float) -> np.ndarray:
    limits = np.array([WIDTH - 1, HEIGHT - 1])
    return ((pixels >= margin) & (pixels <= limits - margin)).all(axis=-1)


@pytest.mark.parametrize("name", DISTORTIONS)
def test_undistorted_image_shows_what_the_lens_moved(name: str) -> None:
    # Proves that pixel u of the undistorted image has the colour of its place in the distorted image, to bilinear
    # and 8-bit accuracy. Oracle: cv2.projectPoints, and ramps whose colour is the place.
    camera = Camera(INTRINSICS, WIDTH, HEIGHT, DISTORTIONS[name])
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    image = np.stack([x, y, (x + y) // 2], axis=-1).astype(np.uint8)
    expected = _distorted_pixels(camera)
    undistorted = camera.undistorter().image(image)
    error = np.abs(undistorted[..., :2] - expected)[_inside(expected, 1.0)].max()
    assert error < 0.55, f"off by {error:.3f} pixels; rounding to 8 bits allows 0.5, the map's 1/32 pixel the rest"


@pytest.mark.parametrize("name", DISTORTIONS)
def test_undistorted_depth_is_the_nearest_pixels_depth(name: str) -> None:
    # Proves that depth is taken from the nearest pixel (never interpolated), and is NaN outside the image and where
    # the source has none. Oracle: cv2.projectPoints rounded, on a map that numbers its pixels.
    camera = Camera(INTRINSICS, WIDTH, HEIGHT, DISTORTIONS[name])
    depth = 1.0 + np.arange(WIDTH * HEIGHT, dtype=np.float32).reshape(HEIGHT, WIDTH)
    depth[40:60, 50:70] = np.nan
    undistorter = camera.undistorter()
    result = undistorter.depth(depth)
    pixels = _distorted_pixels(camera)
    # Places half-way between two pixels may go either way.
    clear = (np.abs(pixels - np.floor(pixels) - 0.5) > 1e-3).all(axis=-1)
    inside = _inside(np.rint(pixels), 0.0)
    column, row = np.rint(pixels[inside & clear]).astype(int).T
    np.testing.assert_array_equal(result[inside & clear], depth[row, column])
    assert np.isnan(result[~inside & clear]).all()
    valid = np.ones_like(inside) if undistorter.valid is None else undistorter.valid
    np.testing.assert_array_equal(valid[clear], inside[clear])


@pytest.mark.parametrize("distortion", [(), (0.0, 0.0, 0.0, 0.0)])
def test_without_distortion_nothing_is_copied(distortion: tuple[float, ...]) -> None:
    # Proves that an ideal camera costs nothing: the same arrays come back. Oracle: identity.
    undistorter = Camera(INTRINSICS, WIDTH, HEIGHT, distortion).undistorter()
    image, depth = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.zeros((HEIGHT, WIDTH), np.float32)
    assert undistorter.image(image) is image
    assert undistorter.depth(depth) is depth
    assert undistorter.valid is None


def test_pinhole_keeps_the_intrinsics() -> None:
    # Proves that undistorted images belong to the same intrinsics, known or not. Oracle: the definition.
    camera = Camera(INTRINSICS, WIDTH, HEIGHT, DISTORTIONS["barrel"], known=False)
    assert camera.undistorter().camera == Camera(INTRINSICS, WIDTH, HEIGHT, known=False)


@pytest.mark.parametrize(("width", "height"), [(640, 480), (480, 640), (333, 333)])
def test_guess_sees_sixty_degrees_across_the_longer_side(width: int, height: int) -> None:
    # Proves the guess's field of view, centre and mark. Oracle: the angle between the rays of the longer side's ends.
    camera = Camera.guess(width, height)
    focal, _, cx, cy = camera.intrinsics
    angle = 2 * math.degrees(math.atan(0.5 * max(width, height) / focal))
    assert angle == pytest.approx(60.0)
    assert (cx, cy) == ((width - 1) / 2, (height - 1) / 2)
    assert not camera.known


@pytest.mark.parametrize(
    ("intrinsics", "named"),
    [
        ((0.0, 500.0, 320.0, 240.0), 0),
        ((500.0, -1.0, 320.0, 240.0), -1),
        ((math.nan, 500.0, 320.0, 240.0), "nan"),
        ((500.0, 500.0, math.inf, 240.0), "inf"),
    ],
)
def test_impossible_intrinsics_are_refused(intrinsics: tuple[float, float, float, float], named: object) -> None:
    # Proves that no camera is made of impossible intrinsics, and that the error names the argument.
    with raises("intrinsics", named):
        Camera(intrinsics, 640, 480)
