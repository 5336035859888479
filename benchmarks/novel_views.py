"""Render frames that were set aside, from the depth of other frames, by the poses of a run and by those of COLMAP.

    D=../shared/data/redkitchen
    .venv/bin/vggtgeo run $D -o runs/redkitchen
    .venv/bin/python benchmarks/novel_views.py $D runs/redkitchen/trajectory.txt $D/reference-colmap.txt \
        --pictures runs/views

Every `--apart`-th frame is set aside. Of the others every `--every`-th gives coloured points by its pixels and the
sensor's depth, by either set of poses (the first is aligned to the second by Sim(3), as the scale of either may be
unknown). The points of the whole clip are rendered into each frame that was set aside: in each pixel the nearest
surface, the mean of its points' colours. Pose errors anywhere in the clip blur these images. The PSNR against the frame
is over the pixels that both sets cover. Nothing is trained: only the poses differ.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from skimage.metrics import peak_signal_noise_ratio

import vggtgeo as vg
from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.evaluation.association import associate
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory

HALF = 2
"""Images have half the size, which fits the density of a depth camera's points."""
SURFACE = 0.02
"""Largest relative distance behind the nearest point of a pixel that counts as the same surface."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A frame at half size: colour float32 [h, w, 3], depth [h, w] in metres, NaN = none."""

    timestamp: float
    colour: np.ndarray
    depth: np.ndarray


def main() -> None:
    """Print the PSNR by either set of poses."""
    options = _options()
    clip = vg.read(options.clip)
    pictures = [_halved(frame) for frame in clip.frames()]
    intrinsics = np.array(clip.camera.intrinsics) / HALF
    intrinsics[2:] -= 0.25  # centres of pixels are whole numbers
    own, reference = associate(Trajectory.load_tum(options.poses), Trajectory.load_tum(options.reference))
    brought = umeyama(own.positions, reference.positions, with_scale=True).trajectory(own).poses
    rows = _rows([picture.timestamp for picture in pictures], own.timestamps)
    aside = np.arange(len(rows)) % options.apart == options.apart // 2
    sources = np.nonzero(~aside)[0][:: options.every]
    clouds = [_cloud(pictures, rows, sources, poses, intrinsics) for poses in (brought, reference.poses)]
    found = []
    for row in np.nonzero(aside)[0]:
        truth = pictures[rows[row]].colour
        drawn = [
            _drawn(cloud, poses[row], intrinsics, truth.shape[:2])
            for cloud, poses in zip(clouds, (brought, reference.poses), strict=True)
        ]
        both = np.isfinite(drawn[0]).all(2) & np.isfinite(drawn[1]).all(2)
        psnr = [peak_signal_noise_ratio(truth[both], picture[both], data_range=255.0) for picture in drawn]
        found.append([*psnr, 100 * both.mean()])
        if options.pictures:
            _save(options.pictures / f"{pictures[rows[row]].timestamp:.3f}.jpg", [truth, *drawn])
    first, second, covered = np.mean(found, axis=0)
    lower = np.subtract(*np.transpose(found)[:2])
    print(
        "| views | covered, % | PSNR, these poses | PSNR, the reference's | difference | worst |\n" + "|---" * 6 + "|"
    )
    cells = (str(len(found)), f"{covered:.0f}", f"{first:.2f}", f"{second:.2f}", f"{first - second:+.2f}")
    print(f"| {' | '.join(cells)} | {lower.min():+.2f} |")


def _rows(times: list[float], wanted: np.ndarray) -> np.ndarray:
    """Return the picture of each pose."""
    return np.abs(np.subtract.outer(wanted, np.array(times))).argmin(1)


def _halved(frame: vg.data.Frame) -> Picture:
    height, width = frame.image.shape[0] // HALF, frame.image.shape[1] // HALF
    colour = cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    assert frame.depth is not None, "the clip needs depth"
    return Picture(frame.timestamp, colour, frame.depth[::HALF, ::HALF][:height, :width])


def _cloud(
    pictures: list[Picture], rows: np.ndarray, sources: np.ndarray, poses: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return world points float32 [n, 3] and their colours [n, 3]."""
    points, colours = [], []
    for row in sources:
        picture = pictures[rows[row]]
        y, x = np.nonzero(np.isfinite(picture.depth) & (picture.depth > 0))
        # The depth of a pixel of the halved picture is that of its upper left corner.
        pixels = np.column_stack([x, y]) - 0.25
        world = rigid.unproject(pixels, 1 / picture.depth[y, x], rigid.invert(poses[row]), intrinsics)
        points.append(world.astype(np.float32))
        colours.append(picture.colour[y, x])
    return np.concatenate(points), np.concatenate(colours)


def _drawn(
    cloud: tuple[np.ndarray, np.ndarray], pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Render the points from `pose` (camera -> world), float64 [h, w, 3]; NaN where no point is."""
    points, colours = cloud
    world_to_camera = rigid.invert(pose)
    local = points @ world_to_camera[:3, :3].T.astype(np.float32) + world_to_camera[:3, 3].astype(np.float32)
    fx, fy, cx, cy = intrinsics
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = np.rint(fx * local[:, 0] / local[:, 2] + cx), np.rint(fy * local[:, 1] / local[:, 2] + cy)
    height, width = size
    inside = (local[:, 2] > 0.1) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    cell = (y[inside] * width + x[inside]).astype(int)
    z = local[inside, 2]
    nearest = np.full(height * width, np.inf, np.float32)
    np.minimum.at(nearest, cell, z)
    front = z < nearest[cell] * (1 + SURFACE)
    count = np.bincount(cell[front], minlength=height * width)
    sums = [np.bincount(cell[front], own[front], height * width) for own in colours[inside].T]
    with np.errstate(invalid="ignore"):
        return np.stack([total / np.where(count, count, np.nan) for total in sums], 1).reshape(height, width, 3)


def _save(path: Path, pictures: list[np.ndarray]) -> None:
    """Write the frame, the view by these poses and the view by the reference's side by side."""
    path.parent.mkdir(parents=True, exist_ok=True)
    row = np.concatenate([np.nan_to_num(picture) for picture in pictures], axis=1)
    cv2.imwrite(str(path), cv2.cvtColor(row.astype(np.uint8), cv2.COLOR_RGB2BGR))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path, help="a sequence with depth")
    parser.add_argument("poses", type=Path, help="a run's trajectory (TUM format)")
    parser.add_argument("reference", type=Path, help="the poses to compare with (TUM format)")
    parser.add_argument("--apart", type=int, default=10, help="set aside every n-th frame")
    parser.add_argument("--every", type=int, default=3, help="take the points of every n-th of the others")
    parser.add_argument("--pictures", type=Path, help="folder for the frames beside their rendered views")
    return parser.parse_args()


if __name__ == "__main__":
    main()
