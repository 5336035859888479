"""Draw `run.webp`, the moving picture of the README: a run on a real recording, or in a simulated room.

python docs/draw_run.py --clip ../shared/data/corridor-office --every 2     (a few minutes on two cores)
python docs/draw_run.py [--scene office] [--frames 240] [--every 4]         (simulated; ten minutes)

Left: each image with the key points of the last keyframes, drawn where the estimate puts them, with the way that they
took. Right: the map from outside, as far as the keyframes have seen it by then, with the path of the camera.
The poses of the left are those of the moment, the map and the path those of the end, after the last adjustment.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

import vggtgeo as vg
from vggtgeo.figures.plots import view_axes
from vggtgeo.geometry import rigid

WIDTH, BAR = 400, 30
ELEVATION = np.deg2rad(52.0)
PAPER, INK, BLUE, ORANGE = (246, 246, 244), (31, 41, 51), (31, 95, 191), (224, 123, 26)
FADE = 3
"""Frames that a point's way is drawn for."""
LAST_KEYFRAMES = 3
THINNED = 4
"""One of so many key points is drawn."""
MILLISECONDS, LAST_MILLISECONDS = 160, 3000


@dataclass(frozen=True)
class Moment:
    """What is seen after one frame: its image, the key points in it frame by frame, number of keyframes."""

    image: np.ndarray
    ways: np.ndarray
    keyframes: int


class Watcher(vg.Callback):
    """Keeps a `Moment` of each frame."""

    def __init__(self) -> None:
        self.moments: list[Moment] = []
        self.poses: list[np.ndarray] = []

    def on_frame(self, slam, frame) -> None:
        self.poses = [*self.poses, slam.last_pose][-FADE:]
        height, width = frame.image.shape[:2]
        ways = [np.zeros((0, len(self.poses), 2))]
        for keyframe in slam.keyframes[-LAST_KEYFRAMES:]:
            slots = keyframe.points
            known = (
                np.isfinite(slots.inverse_depth)
                & (slots.inverse_depth > 0)
                & (np.arange(len(slots.pixels)) % THINNED == 0)
            )
            points = rigid.unproject(slots.pixels[known], slots.inverse_depth[known], keyframe.pose, slam.intrinsics)
            seen = np.stack([rigid.project(points, pose, slam.intrinsics) for pose in self.poses], 1)
            z = (points @ self.poses[-1][:3, :3].T + self.poses[-1][:3, 3])[:, 2]
            column, row = np.rint(seen[:, -1]).astype(int).clip(0, [width - 1, height - 1]).T
            inside = ((seen[:, -1] >= 0) & (seen[:, -1] < [width, height])).all(1) & (z > 0)
            measured = frame.depth[row, column]
            ways.append(seen[inside & (np.abs(z - measured) < 0.1 * z)])  # the others are hidden by now
        scale = WIDTH / width
        image = cv2.resize(frame.image, (WIDTH, round(scale * height)), interpolation=cv2.INTER_AREA)
        self.moments.append(Moment(image, scale * np.concatenate(ways), len(slam.keyframes)))


def with_points(moment: Moment) -> np.ndarray:
    """The image with its key points and the way that each took."""
    picture = moment.image.copy()
    for way in np.rint(moment.ways * 8).astype(np.int32):
        cv2.polylines(picture, [way], isClosed=False, color=(255, 212, 59), thickness=1, lineType=cv2.LINE_AA, shift=3)
        cv2.circle(picture, way[-1].tolist(), 16, ORANGE, -1, cv2.LINE_AA, shift=3)
    return picture


class Outside:
    """The map from outside and above, without ceiling and without the backs of walls."""

    def __init__(self, result: vg.Result, height: int):
        self.size = np.array([WIDTH, height])
        trajectory, slam = result.trajectory, result.record.slam
        along, across, up = view_axes(trajectory)
        ahead = np.cos(ELEVATION) * across - np.sin(ELEVATION) * up
        self.axes = np.stack([along, -(np.cos(ELEVATION) * up + np.sin(ELEVATION) * across), ahead])
        points, cloud = result.cloud.points, result.cloud
        below = points @ up < (trajectory.positions @ up).max() + 0.25
        shown = below & (cloud.normals @ ahead < 0.1)
        self.first = np.full(len(points), len(slam.keyframes))
        for keyframe in reversed(slam.keyframes):
            self.first[self._sees(keyframe, points, slam.intrinsics)] = keyframe.number
        self.first, colours = self.first[shown], cloud.colours[shown]
        local = points[shown] @ self.axes.T
        path = trajectory.positions @ self.axes.T
        low, high = np.quantile(local[:, :2], 0.002, axis=0), np.quantile(local[:, :2], 0.998, axis=0)
        low, high = np.minimum(low, path[:, :2].min(0)), np.maximum(high, path[:, :2].max(0))
        self.scale = 0.94 * min(self.size / (high - low))
        self.middle = 0.5 * (low + high)
        order = np.argsort(-local[:, 2], kind="stable")  # the nearest last
        self.first, self.colours = self.first[order], colours[order]
        self.place = self._placed(local[order])
        self.path = self._placed(path)

    def _placed(self, local: np.ndarray) -> np.ndarray:
        return self.size / 2 + self.scale * (local[:, :2] - self.middle)

    @staticmethod
    def _sees(keyframe, points: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
        z = (points @ keyframe.pose[:3, :3].T + keyframe.pose[:3, 3])[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = rigid.project(points, keyframe.pose, intrinsics)
        height, width = keyframe.size
        inside = (z > 0.1) & (pixels >= 0).all(1) & (pixels < [width - 1, height - 1]).all(1)
        column, row = np.where(inside[:, None], np.rint(np.nan_to_num(pixels)), 0).astype(int).T
        return inside & (np.abs(keyframe.depth[row, column] - z) < 0.05 * z)

    def drawn(self, keyframes: int, frames: int) -> np.ndarray:
        """As far as the first `keyframes` have seen it, with the path of the first `frames`."""
        width, height = self.size
        picture = np.full((height, width, 3), PAPER, np.uint8)
        known = self.first < keyframes
        corner = np.floor(self.place[known]).astype(int)
        size = max(int(np.ceil(self.scale * 0.022)), 2)
        for down, right in np.ndindex(size, size):
            x, y = corner[:, 0] + right, corner[:, 1] + down
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            picture[y[inside], x[inside]] = self.colours[known][inside]
        line = np.rint(self.path[:frames] * 8).astype(np.int32)
        for colour, thickness in (((255, 255, 255), 5), (BLUE, 2)):
            cv2.polylines(
                picture, [line], isClosed=False, color=colour, thickness=thickness, lineType=cv2.LINE_AA, shift=3
            )
        for radius, colour in ((56, (255, 255, 255)), (40, ORANGE)):
            cv2.circle(picture, line[-1].tolist(), radius, colour, -1, cv2.LINE_AA, shift=3)
        return picture


def page(left: np.ndarray, right: np.ndarray, words: str) -> Image.Image:
    """Both pictures side by side, and a line below."""
    height = left.shape[0]
    whole = Image.new("RGB", (2 * WIDTH + 6, height + BAR), PAPER)
    whole.paste(Image.fromarray(left), (0, 0))
    whole.paste(Image.fromarray(right), (WIDTH + 6, 0))
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 15)
    ImageDraw.Draw(whole).text((8, height + 6), words, INK, font)
    return whole


def pages(result: vg.Result, moments: list[Moment], name: str, error: float, every: int) -> list[Image.Image]:
    """All pictures. error: metres."""
    outside, found = Outside(result, moments[0].image.shape[0]), []
    for number in range(every, len(moments) + 1, every):
        moment = moments[number - 1]
        words = f"{name}: frame {number} of {len(moments)}, {moment.keyframes} keyframes"
        if number + every > len(moments):
            words += f"; ATE RMSE {100 * error:.2f} cm"
        found.append(page(with_points(moment), outside.drawn(moment.keyframes, number), words))
    return found


def save(found: list[Image.Image], path: Path, quality: int) -> None:
    """As an animated WebP; the last picture stays for a while."""
    times = [MILLISECONDS] * (len(found) - 1) + [LAST_MILLISECONDS]
    found[0].save(path, save_all=True, append_images=found[1:], duration=times, loop=0, quality=quality, method=6)
    print(f"{path}: {len(found)} pictures, {path.stat().st_size / 1e6:.2f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clip", type=Path, help="a recording with truth")
    parser.add_argument("--scene", default="office", help="a simulated one, where no clip is given")
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--every", type=int, default=4)
    parser.add_argument("--quality", type=int, default=30)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("run.webp"))
    given = parser.parse_args()
    if given.clip:
        sequence, name = vg.open_sequence(given.clip), f"{given.clip.name}, HoloLens"
    else:
        sequence, name = vg.simulate(given.scene, given.frames, rate=10.0), f"simulated {given.scene}"
    watcher = Watcher()
    result = vg.reconstruct(sequence, callbacks=[watcher])
    error = vg.evaluate(result.trajectory, sequence.ground_truth()).se3.statistics.rmse
    save(pages(result, watcher.moments, name, error, given.every), given.out, given.quality)


if __name__ == "__main__":
    main()
