"""A fisheye that was calibrated is read as one, and taken out of images. Oracle: the solver's own model of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_bags as bags
import tiny_layouts as tiny
import tiny_sequences
from distorted_sequence import Bent
from reported import raises
from tiny_sequences import INTRINSICS

import vggtgeo as vg
from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.views import SequenceView
from vggtgeo.geometry.camera import Camera

COEFFICIENTS = (0.03, -0.012, 0.004, -0.0007)
FISHEYE = Camera((90.0, 92.0, 79.0, 61.0), 160, 120, COEFFICIENTS, fisheye=True)


def drawn(camera: Camera, rays: np.ndarray) -> np.ndarray:
    """Where the fisheye draws viewing rays [n, 3], pixels [n, 2]."""
    lens = vg.cameras.KannalaBrandt(jnp.asarray([*camera.intrinsics, *camera.distortion]))
    return np.asarray(jax.vmap(lens.project)(jnp.asarray(rays)))


def test_images_and_pixels_of_a_fisheye_become_those_of_a_pinhole() -> None:
    # Proves that each pixel of the undistorted image has the colour of its place in the fisheye's, depth that of the
    # nearest pixel, and that pixels move alike; 100 degrees are in view.
    x, y = np.meshgrid(np.arange(160), np.arange(120))
    image = np.stack([x, y, y], -1).astype(np.uint8)
    ideal = np.stack([x, y], -1).reshape(-1, 2).astype(float)
    rays = np.column_stack([(ideal - FISHEYE.intrinsics[2:]) / FISHEYE.intrinsics[:2], np.ones(len(ideal))])
    pixels = drawn(FISHEYE, rays)
    undistorter = FISHEYE.undistorter()
    assert undistorter.valid is None  # a fisheye has more in its image than a pinhole of its focal length
    assert undistorter.camera == Camera(FISHEYE.intrinsics, 160, 120)
    seen = undistorter.image(image).reshape(-1, 3)[:, :2]
    assert np.abs(seen - pixels).max() < 0.55
    depth = undistorter.depth((100.0 * y + x).astype(np.float32)).ravel()
    clear = (np.abs(pixels - np.floor(pixels) - 0.5) > 1e-2).all(1)
    column, row = np.rint(pixels).T
    np.testing.assert_array_equal(depth[clear], (100 * row + column)[clear])
    np.testing.assert_allclose(FISHEYE.undistorted(pixels), ideal, atol=1e-3)


def test_an_ideal_fisheye_is_no_pinhole() -> None:
    # Proves that coefficients of zero are still a lens, that reduced images keep it, and that four are needed.
    ideal = Camera((90.0, 90.0, 79.5, 59.5), 160, 120, (0.0,) * 4, fisheye=True)
    assert ideal.distorts
    assert not ideal.pinhole.distorts
    assert ideal.resized(80, 60).fisheye
    at_60_degrees = [[79.5 + 90.0 * np.radians(60), 59.5]]
    np.testing.assert_allclose(ideal.undistorted(np.array(at_60_degrees)), [[79.5 + 90.0 * 3**0.5, 59.5]], atol=1e-3)
    with raises("distortion", "0"):
        Camera((90.0, 90.0, 79.5, 59.5), 160, 120, fisheye=True)


def of_folder(folder: Path) -> Path:
    tiny_sequences.images(folder)
    (folder / "calibration.txt").write_text(" ".join(map(str, (*INTRINSICS, *COEFFICIENTS))) + " fisheye\n")
    return folder


def of_euroc(folder: Path) -> Path:
    sensor = tiny.euroc(folder) / "mav0/cam0/sensor.yaml"
    text = sensor.read_text().replace("radial-tangential", "equidistant").replace("-0.28, 0.07, 0.0002, 1.8e-05", "{}")
    sensor.write_text(text.format(", ".join(map(str, COEFFICIENTS))) + "resolution: [40, 30]\n")
    return folder


def of_nerfstudio(folder: Path) -> Path:
    file = tiny.nerfstudio(folder) / "transforms.json"
    lens = dict(zip(("k1", "k2", "k3", "k4"), COEFFICIENTS, strict=True))
    file.write_text(json.dumps({**json.loads(file.read_text()), "camera_model": "OPENCV_FISHEYE", **lens}))
    return folder


@pytest.mark.parametrize("write", [of_folder, of_euroc, of_nerfstudio])
def test_what_files_call_a_fisheye_is_one(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    # Proves that its four coefficients are not taken for k1, k2, p1, p2, in the layouts that say what they are.
    camera = tiny.quietly_opened(write(tmp_path / "scene")).camera
    assert camera.fisheye
    assert camera.distortion == COEFFICIENTS
    assert camera.intrinsics == pytest.approx(INTRINSICS)


def test_a_bag_of_a_fisheye(tmp_path: Path) -> None:
    # Proves the same of a `CameraInfo`, and that a lens of neither kind is an error that names it.
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    paths = {lens: tmp_path / f"{lens}.bag" for lens in ("equidistant", "ftheta")}
    for lens, path in paths.items():
        bags.write(path, c_image=bags.image(), c_info=bags.info(lens=lens, distortion=COEFFICIENTS))
    assert open_sequence(paths["equidistant"]).camera.fisheye
    with raises("ftheta.bag", ": "):
        open_sequence(paths["ftheta"])


@pytest.mark.slow  # a minute: a run, its last adjustment
def test_a_video_of_a_calibrated_fisheye() -> None:
    # Proves that a fisheye's images give the path when its calibration is given, and nothing is told against it.
    # Oracle: the rendered room, drawn by that lens.
    source = vg.simulate("office", 40, size=(320, 240), rate=10.0)
    lens = Camera(source.camera.intrinsics, 320, 240, COEFFICIENTS, fisheye=True)
    frames = Bent(source, lens)
    result = vg.reconstruct(SequenceView(frames, lens, has_depth=False), options=vg.RunOptions(dense="none"))
    assert result.summary["truth"]["ate_sim3_m"]["rmse"] < 0.02
    assert result.verdict.level == "good", result.verdict
