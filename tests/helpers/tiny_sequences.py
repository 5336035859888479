"""Tiny sequences on disk, in each layout that the readers know, with contents that tell frame and pixel."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 40, 30
INTRINSICS = (35.0, 36.0, 19.5, 14.5)


def image(number: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """RGB, uint8 [H, W, 3]: red is the frame's number, green the column, blue the row."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([np.full_like(x, number), x, y], axis=-1).astype(np.uint8)


def depth_codes(number: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """uint16 [H, W]: 1000 + 10 number + column; the first two pixels are 0 and 65535."""
    codes = np.tile(1000 + 10 * number + np.arange(width), (height, 1)).astype(np.uint16)
    codes[0, :2] = 0, 65535
    return codes


def write_image(path: Path, pixels: np.ndarray) -> Path:
    """Writes RGB or depth codes in the format of the suffix, lossless for PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels[..., ::-1] if pixels.ndim == 3 else pixels)
    return path


def video(path: Path, pictures: Iterable[np.ndarray], codec: str = "MJPG") -> Path:
    """A video of pictures of one size, ten a second, in OpenCV's order of colours."""
    first, *rest = pictures
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10.0, first.shape[1::-1])
    assert writer.isOpened()
    for picture in (first, *rest):
        writer.write(picture)
    writer.release()
    return path


def pose(number: int) -> np.ndarray:
    """Camera -> world: `number` metres along x."""
    matrix = np.eye(4)
    matrix[0, 3] = number
    return matrix


def tum_line(time: float, number: int) -> str:
    """The same pose as a line of a trajectory file."""
    return f"{time:.6f} {number} 0 0 0 0 0 1\n"


def seven_scenes(folder: Path, numbers: tuple[int, ...] = (0, 2, 4)) -> Path:
    """A 7-Scenes folder with images, depth and poses of the frames `numbers`."""
    for number in numbers:
        stem = folder / f"frame-{number:06d}"
        write_image(stem.with_suffix(".color.png"), image(number))
        write_image(stem.with_suffix(".depth.png"), depth_codes(number))
        np.savetxt(stem.with_suffix(".pose.txt"), pose(number))
    fx, fy, cx, cy = INTRINSICS
    np.savetxt(folder / "camera-intrinsics.txt", [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return folder


def tum(folder: Path, count: int = 3) -> Path:
    """A TUM RGB-D folder: images every 0.1 s, depth 4 ms later, truth every 0.05 s."""
    rgb, depth, truth = ["# color images\n"], ["# depth maps\n"], ["# ground truth\n"]
    for number in range(count):
        time = 10.0 + 0.1 * number
        write_image(folder / f"rgb/{time:.6f}.png", image(number))
        write_image(folder / f"depth/{time + 0.004:.6f}.png", depth_codes(number))
        rgb.append(f"{time:.6f} rgb/{time:.6f}.png\n")
        depth.append(f"{time + 0.004:.6f} depth/{time + 0.004:.6f}.png\n")
        truth += [tum_line(time, number), tum_line(time + 0.05, number)]
    for name, lines in (("rgb", rgb), ("depth", depth), ("groundtruth", truth)):
        (folder / f"{name}.txt").write_text("".join(lines))
    write_calibration(folder, INTRINSICS)
    return folder


def images(folder: Path, names: tuple[str, ...] = ("a1.png", "a2.png", "a10.png"), calibration: bool = True) -> Path:
    """A folder of images; the frame's number is its position in `names`."""
    for number, name in enumerate(names):
        write_image(folder / name, image(number))
    if calibration:
        write_calibration(folder, INTRINSICS)
    return folder


def write_calibration(folder: Path, numbers: tuple[float, ...]) -> None:
    """Writes `calibration.txt`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "calibration.txt").write_text(" ".join(str(number) for number in numbers) + "\n")
