"""What stays in its place in the image while the rest moves is found before the first frame, and left out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_sequences as tiny
from changed import changed
from vggtgeo.models.classical import OrbMatcher, SiftMatcher
from vggtgeo.models.roles import Segments

import vggtgeo as vg
from vggtgeo.results.source import StaticOverlaySearch, open_source
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.perception.static_overlay import StaticOverlay, find_static_overlay
from vggtgeo.slam.pipeline import begin
from vggtgeo.slam.run import run_frames
from vggtgeo.slam.verdict.corner_recorder import CornerRecorder
from vggtgeo.slam.verdict.judge import check_static_overlay

WIDTH, HEIGHT = 320, 240
CAMERA = vg.Camera((300.0, 300.0, 159.5, 119.5), WIDTH, HEIGHT)


def moving(count: int = 12, step: tuple[int, int] = (17, 11), noise: float = 4.0) -> list[np.ndarray]:
    """Pictures of a camera that passes over a texture, uint8 [H, W, 3], with noise."""
    rng = np.random.default_rng(0)
    world = cv2.resize(rng.integers(0, 255, (80, 100, 3)).astype(np.uint8), (800, 640), interpolation=cv2.INTER_CUBIC)
    found = []
    for row in range(count):
        x, y = row * step[0], row * step[1]
        seen = world[y : y + HEIGHT, x : x + WIDTH].astype(float)
        found.append(np.clip(seen + rng.normal(0, noise, seen.shape), 0, 255).astype(np.uint8))
    return found


def bars(image: np.ndarray) -> None:
    image[:20] = image[-20:] = 0


def text(image: np.ndarray) -> None:
    cv2.putText(image, "REC 12:03", (20, 60), cv2.FONT_HERSHEY_SIMPLEX, 1.0, (255, 255, 255), 2)


def display(image: np.ndarray) -> None:
    """As bright as what passes behind it: its edges are those of something brighter now, of something darker then."""
    cv2.putText(image, "ALT 1.2", (20, 200), cv2.FONT_HERSHEY_SIMPLEX, 1.0, (60, 190, 60), 3)


def specks(image: np.ndarray) -> None:
    for x, y in ((60, 60), (220, 90), (150, 180)):
        cv2.circle(image, (x, y), 6, (10, 10, 10), -1)


def board(image: np.ndarray) -> None:
    image[190:] = cv2.resize(np.random.default_rng(5).integers(0, 255, (8, 40, 3)).astype(np.uint8), (WIDTH, 50))


def painted(images: list[np.ndarray], paint: Callable[[np.ndarray], None]) -> tuple[list[np.ndarray], np.ndarray]:
    """The images with something that moves with the camera, and where it has edges or is a bar, bool [H, W]."""
    found, plain = [image.copy() for image in images], np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    for image in found:
        paint(image)
    paint(plain)
    edge = cv2.morphologyEx(plain[..., 0], cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 40
    return found, edge | (plain[..., 0] == 0)


@pytest.mark.parametrize("paint", [bars, text, display, specks, board])
def test_what_the_camera_carries_is_found(paint: Callable[[np.ndarray], None]) -> None:
    """Its edges, nearly all of them, and little of the rest. Oracle: where it was painted."""
    images, edges = painted(moving(), paint)
    found = find_static_overlay(images)
    assert found.sure
    mask = found.mask
    assert mask[edges].mean() > 0.95
    around = cv2.dilate(edges.astype(np.uint8), np.ones((25, 25), np.uint8)) > 0
    assert mask[~around].mean() < 0.01


@pytest.mark.parametrize(
    "images",
    [
        moving(),
        moving(step=(0, 0)),
        painted(moving(step=(0, 0)), text)[0],
        painted(moving(count=11), text)[0],
        [],
    ],
    ids=["nothing there", "camera stands", "camera stands, with text", "too few", "none"],
)
def test_where_nothing_is_sure_nothing_is_left_out(images: list[np.ndarray]) -> None:
    """Of a camera that stands nobody can say what belongs to it. Oracle: None."""
    assert find_static_overlay(images) is None


@pytest.mark.parametrize(("width", "step", "count"), [(140, 15, 12), (80, 20, 12), (200, 8, 16), (120, 25, 14)])
def test_a_walker_before_a_camera_that_stands_is_not_the_world(width: int, step: int, count: int) -> None:
    """A patterned figure crosses the image; the room behind it stays where it is, and is the world."""
    room, figure = moving(count, (0, 0)), moving(1)[0][:200, :width]
    for row, image in enumerate(room):
        left = step * row % (WIDTH - width)
        image[20:220, left : left + width] = figure
    assert find_static_overlay(room) is None


def board_from(row: int) -> list[np.ndarray]:
    """A board that covers all below a row of the image."""
    images, pattern = moving(), moving(1)[0]
    for image in images:
        image[row:] = pattern[row:]
    return images


@pytest.mark.parametrize(("row", "separable"), [(90, True), (30, False)])
def test_what_covers_most_of_the_picture_is_told(row: int, separable: bool) -> None:
    """Of more than a third nobody is sure; where nothing else is left, it is not left out. Oracle: the board, and what
    the verdict says.
    """
    found = find_static_overlay(board_from(row))
    assert not found.sure
    assert found.separable == separable
    assert found.share == pytest.approx(1 - row / HEIGHT, abs=0.06)
    (finding,) = check_static_overlay(found, left_out=separable)
    assert finding.level == "degraded"
    assert ("(masked)" if separable else "(not masked)") in finding.text


@pytest.mark.parametrize(("count", "every"), [(11, 1), (30, 1), (50, 1), (50, 13), (90, 1)])
def test_of_a_stream_it_is_told(count: int, every: int) -> None:
    """Frames that come once cannot be looked at before the first is tracked; at the end the verdict knows. Oracle: text
    that was painted into every image, or into one in thirteen, which nobody can take for a part of the camera.
    """
    search, images, slam = StaticOverlaySearch(), moving(19, (25, 20)), begin(CAMERA, vg.Roles())
    for row in range(count):
        image = images[row % 19].copy()
        if row % every == 0:
            text(image)
        search.on_frame(slam, vg.data.Frame(row, row / 30, image, None, str(row)))
    assert len(search._images) <= 40
    found = [finding.text for finding in search.findings()]
    assert search.found is None
    assert len(found) == int(count > 11 and every == 1)


@pytest.mark.parametrize("matcher", [SiftMatcher(), OrbMatcher()])
def test_nothing_is_looked_for_there(matcher: SiftMatcher | OrbMatcher) -> None:
    """No key point, segment, depth or corner of the verdict's tracks lies there; all others stay. Oracle: the same
    without a mask.
    """
    image = moving()[0]
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[60:120, 100:220] = True
    parts = StaticOverlay(mask)
    before = matcher.describe(image)
    after = parts.without_points(before)
    inside = mask[tuple(np.rint(before.pixels).astype(int).T[::-1])]
    assert 0 < inside.sum() < len(before)
    np.testing.assert_array_equal(after.pixels, before.pixels[~inside])
    assert len(matcher.match(after, after)) > 50
    segments = Segments(np.array([[[10.0, 10], [90, 10]], [[80.0, 90], [240, 90]]]), np.ones(2))
    assert parts.without_segments(segments).endpoints[:, 0, 1].tolist() == [10.0]
    depth = parts.without_depth(np.ones((HEIGHT, WIDTH), np.float32))
    np.testing.assert_array_equal(np.isnan(depth), mask)
    recorder = CornerRecorder(CAMERA)
    recorder.leave_out(mask)
    for row, image in enumerate(moving(3, (3, 2))):
        recorder.add(vg.data.Frame(row, row / 15, image, None, str(row)))
    assert all(len(frame.ids) > 20 for frame in recorder.frames)
    for frame in recorder.frames:
        assert not mask[tuple(np.rint(frame.pixels).astype(int).T[::-1])].any()


def test_the_mask_is_undistorted_with_the_images() -> None:
    """Oracle: OpenCV's own undistortion of the mask's middle."""
    lens = vg.Camera(CAMERA.intrinsics, WIDTH, HEIGHT, (-0.3, 0.05, 0.0, 0.0))
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[20:31, 20:31] = True
    row, column = np.argwhere(StaticOverlay(mask).undistorted(lens).mask).mean(axis=0)
    expected = cv2.undistortPoints(np.array([[[25.0, 25.0]]]), lens.matrix, np.array(lens.distortion), P=lens.matrix)
    np.testing.assert_allclose([column, row], expected[0, 0], atol=0.7)


def test_a_lens_that_was_found_undistorts_the_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames of a run whose self-calibration found a lens are undistorted by that; so must be what is left out of them.
    Oracle: the mask that the lens itself undistorts.
    """
    lens = vg.Camera(CAMERA.intrinsics, WIDTH, HEIGHT, (-0.3, 0.05, 0.0, 0.0))
    parts = StaticOverlay(np.tile(np.arange(HEIGHT)[:, None] < 30, (1, WIDTH)))
    settings, given = vg.SlamSettings(), {}
    known = begin(CAMERA, vg.Roles())
    known = changed(known, "camera", lens=lens)
    described = lambda frames, camera, roles, clock, waiting: given.update(camera=camera, roles=roles) or iter(())
    monkeypatch.setattr("vggtgeo.slam.run._described", described)
    assert not list(run_frames(iter(()), CAMERA, vg.Roles(static_overlay=parts), settings, Clock(), known))
    assert given["camera"] == lens
    np.testing.assert_array_equal(given["roles"].static_overlay.mask, parts.undistorted(lens).mask)
    assert (parts.undistorted(lens).mask != parts.mask).any()


def test_which_frames_are_looked_at(tmp_path: Path) -> None:
    """Frames of a folder, some apart; none of a stream, whose frames come once, and none of a simulation."""
    folder = tmp_path / "frames"
    for row in range(10):
        tiny.write_image(folder / f"{row}.png", np.full((48, 64, 3), 10 * row, np.uint8))
    (folder / "calibration.txt").write_text("55 55 31.5 23.5\n")
    seen = open_source(folder, None, vg.SlamSettings()).sample_images(1, 10, 2, 3, 12)
    assert [int(image[0, 0, 0]) for image in seen] == [10, 30, 50]
    seen = open_source(folder, None, vg.SlamSettings()).sample_images(0, None, 1, 3, 2)
    assert [int(image[0, 0, 0]) for image in seen] == [0, 20, 40]
    assert open_source(folder, None, vg.SlamSettings()).repeatable((0, None, 1))
    assert not open_source(vg.simulate("room", 9, size=(64, 48)), None, vg.SlamSettings()).repeatable((0, 9, 1))
    assert not open_source(iter(moving(9)), CAMERA, vg.SlamSettings()).repeatable((0, 9, 1))
