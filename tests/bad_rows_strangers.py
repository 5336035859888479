"""Rows of the table of bad inputs: what is in folders that others made, from rare kinds of images to pipes in lists."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_files as bad
import cv2
import numpy as np
import picture_bytes as bytes_of
import tiny_layouts as layouts
import tiny_sequences as tiny
from bad_row import Row, read_frames, rows
from bad_rows_files import OPENED

from vggtgeo.datasets import open_sequence

SIZE = (bad.WIDTH, bad.HEIGHT)
PICTURE = bad.picture(1)
NUL = b"\0"


def image(content: bytes, suffix: str = ".png") -> Callable[[Path], Path]:
    """Good images, of which the second is this file."""
    return bad.with_image(lambda: content, suffix)


def beside(change: Callable[[Path], Any]) -> Callable[[Path], Path]:
    """Good images, and something that `change` does in their folder."""

    def make(folder: Path) -> Path:
        change(bad.frames(folder / "frames"))
        return folder / "frames"

    return make


def renamed(name: str | bytes, content: bytes | None = None) -> Callable[[Path], Path]:
    """Good images, of which one has another name; and other content."""

    def change(folder: Path) -> None:
        old, new = os.fsencode(folder / "1.png"), os.fsencode(folder) + b"/" + os.fsencode(name)
        os.rename(old, new)
        if content is not None:
            Path(os.fsdecode(new)).write_bytes(content)

    return beside(change)


def other_kinds(folder: Path) -> None:
    """The second image is grey, the third has 16 bits."""
    cv2.imwrite(str(folder / "1.png"), PICTURE[..., 0])
    cv2.imwrite(str(folder / "2.png"), PICTURE.astype(np.uint16) << 8)


def depths(suffix: str, content: np.ndarray | bytes) -> Callable[[Path], Path]:
    """A TUM folder with depth of another kind of file, written here or as bytes."""

    def change(folder: Path) -> None:
        for file in sorted((folder / "depth").iterdir()):
            file.unlink()
            if isinstance(content, bytes):
                file.with_suffix(suffix).write_bytes(content)
            else:
                cv2.imwrite(str(file.with_suffix(suffix)), content)
        listed = folder / "depth.txt"
        listed.write_text(listed.read_text().replace(".png", suffix))

    return bad.rgbd(change)


def other_depth(folder: Path) -> Path:
    """Folders of colour and depth, the depth in files of a recorder's own."""
    layouts.rgbd(folder / "room", "rgb/{}.png", "other/{}.png")
    bad.file("room/depth/0.raw", NUL)(folder)
    return folder / "room"


def zipped(folder: Path) -> Path:
    """Good images in an archive, not packed: FFmpeg finds the first."""
    images = bad.frames(folder / "frames")
    with zipfile.ZipFile(folder / "frames.zip", "w") as archive:
        for file in sorted(images.iterdir()):
            archive.write(file, file.name)
    return folder / "frames.zip"


def two_in_one(folder: Path) -> Path:
    """Two recordings in a folder of a folder."""
    for name in ("left", "right"):
        bad.frames(folder / "download" / "stereo" / name)
    return folder / "download"


def as_jpeg(folder: Path, count: int = 3) -> None:
    """The first pictures once more, as JPEG."""
    for row in range(count):
        cv2.imwrite(str(folder / f"{row}.jpg"), cv2.imread(str(folder / f"{row}.png")))


def masks(folder: Path) -> None:
    """Of each picture a black square on white."""
    for row in range(3):
        mask = np.full((bad.HEIGHT, bad.WIDTH), 255, np.uint8)
        mask[10:20, 10:20] = 0
        cv2.imwrite(str(folder / f"{row}.bmp"), mask)


def frame_names(folder: Path) -> None:
    """All frames, each file once, as many as there are pictures: of two formats of the same ones only the PNG."""
    names = [frame.name for frame in open_sequence(folder).frames()]
    formats = {Path(name).suffix for name in names}
    whole = [path for path in folder.iterdir() if path.suffix in formats]
    assert len(names) == len(set(names)) == len(whole)
    assert formats == {".png"} if len(names) == 3 else len(formats) == 2


def recorded(make: Callable[[Path], Path], change: Callable[[Path], Any]) -> Callable[[Path], Path]:
    """A recording in the layout of a benchmark or an app, in which `change` has changed something."""

    def both(folder: Path) -> Path:
        place = make(folder / "scan")
        change(place)
        return place

    return both


def other_numbers(name: str, **values: Any) -> Callable[[Path], None]:
    """A file of JSON, beside the recording or in it, whose objects have other values under these names."""

    def change(folder: Path) -> None:
        file = next(place for place in (folder / name, folder.parent / name) if place.is_file())
        content = json.loads(file.read_text())
        content.get("camera", content).update(values)
        file.write_text(json.dumps(content))

    return change


def backwards(name: str, head: int = 0) -> Callable[[Path], None]:
    """A list from its last line to its first, the latter twice; head: lines that stay the first."""

    def change(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        turned = lines[:head] + lines[: head - 1 if head else None : -1] + lines[head : head + 1]
        (folder / name).write_text("\n".join(turned) + "\n")

    return change


def one_gone(pattern: str) -> Callable[[Path], None]:
    """The second file of this kind is not there."""
    return lambda folder: sorted(folder.glob(pattern))[1].unlink()


def small_confidence(folder: Path) -> None:
    """Confidence of another size than its depth."""
    for file in (folder / "confidence").iterdir():
        cv2.imwrite(str(file), np.full((10, 10), 2, np.uint8))


def only(*files: tuple[str, bytes]) -> Callable[[Path], Path]:
    """A folder of nothing but these."""

    def make(folder: Path) -> Path:
        for name, content in files:
            bad.file(f"pictures/{name}", content)(folder)
        return folder / "pictures"

    return make


def without_half(folder: Path) -> None:
    """Half of the depth images are empty."""
    for file in sorted((folder / "depth").iterdir())[:2]:
        cv2.imwrite(str(file), np.zeros((tiny.HEIGHT, tiny.WIDTH), np.uint16))


def listed(change: Callable[[str], str], file: str = "rgb.txt") -> Callable[[Path], Path]:
    """A TUM folder with a changed list."""
    return bad.rgbd(lambda folder: (folder / file).write_text(change((folder / file).read_text())))


def pipe_in_list(folder: Path) -> None:
    """The list names a pipe that nobody writes into."""
    os.mkfifo(folder / "pipe.png")
    (folder / "rgb.txt").write_text("9.0 pipe.png\n" + (folder / "rgb.txt").read_text())


def depth_for_images(folder: Path) -> None:
    """The list of images names the depth."""
    (folder / "rgb.txt").write_text((folder / "depth.txt").read_text())


def pipe_for(name: str) -> Callable[[Path], None]:
    """A pipe in the place of a file."""

    def change(folder: Path) -> None:
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return change


def calibrated(content: str | bytes) -> Callable[[Path], Path]:
    """Good images with this `calibration.txt`."""
    return lambda folder: bad.frames(folder / "frames", calibration=content)


METRES = np.full((tiny.HEIGHT, tiny.WIDTH), 1.5, np.float32)
NEGATIVE = np.full((tiny.HEIGHT, tiny.WIDTH), -5, np.int16)


def two_cameras(folder: Path) -> None:
    """Images of two cameras, by their names."""
    for number in range(3):
        (folder / f"{number}.png").rename(folder / f"left_{number}.png")
        shutil.copy(folder / f"left_{number}.png", folder / f"right_{number}.png")


def deep_jpeg() -> bytes:
    """A JPEG whose header says 12 bits."""
    whole = bytearray(bad.encoded(".jpg"))
    whole[whole.index(b"\xff\xc0") + 4] = 12
    return bytes(whole)


IMAGES = rows(
    "Images",
    [
        ("images of two cameras, `left_0.png` and `right_0.png`", beside(two_cameras)),
        ("a JPEG of 12 bits", image(deep_jpeg(), ".jpg")),
        ("a JPEG-LS that is called .jpg", image(b"\xff\xd8\xff\xf7" + bytes(99), ".jpg")),
        ("a QOI that is called .png", image(b"qoif" + bytes(99))),
        ("interlaced PNG", image(bytes_of.interlaced_png(PICTURE))),
        ("palette PNG with transparency", image(bytes_of.palette_png(SIZE))),
        ("PNG of one bit a pixel", image(bytes_of.two_colours_png(SIZE))),
        ("16-bit PNG with transparency", image(bytes_of.deep_png(PICTURE))),
        ("CMYK JPEG", image(bytes_of.cmyk_jpeg(SIZE), ".jpg")),
        ("TIFF of several pages: the first", image(cv2.imencodemulti(".tiff", [PICTURE] * 2)[1].tobytes(), ".tiff")),
        ("a PNG that asks to be turned (EXIF)", image(bytes_of.turned_png(bad.encoded(".png")))),
        ("a WebP that asks to be turned (EXIF)", image(bytes_of.turned_webp(bad.encoded(".webp"), SIZE), ".webp")),
        ("a TIFF that asks to be turned", image(bytes_of.turned_tiff(bad.encoded(".tiff")), ".tiff")),
        ("a BigTIFF's header of 30000 x 30000 pixels", image(bytes_of.big_tiff_header(30000, 30000), ".tiff")),
        ("a JPEG 2000 that is called .png", image(bad.encoded(".jp2"))),
        ("a HEIC that is called .jpg", image(b"\0\0\0\x18ftypheic" + b"\0" * 500, ".jpg")),
        ("a JPEG XL that is called .png", image(b"\xff\x0a" + b"\0" * 99)),
        ("a Git LFS pointer", image(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")),
        ("a folder of HEIC", only(*((f"{row}.HEIC", b"\0\0\0\x18ftypheic") for row in range(3)))),
        ("a GIF that is called .png", image(b"GIF89a" + b"\0" * 500)),
        ("a PNG whose check sum is wrong", image(bad.encoded(".png")[:29] + b"\0" + bad.encoded(".png")[30:])),
        ("a file behind the PNG's end", image(bad.encoded(".png") + b"x" * 9999)),
        ("two JPEGs in one file: the first", image(bad.encoded(".jpg") * 2, ".jpg")),
        ("a PPM of 16 bits", image(b"P6 64 48 65535\n" + (PICTURE.astype(">u2") * 257).tobytes(), ".ppm")),
        ("a PPM whose white is 100", image(b"P6 64 48 100\n" + (PICTURE // 3).tobytes(), ".ppm")),
        ("one pixel", image(bad.encoded(".png", PICTURE[:1, :1]))),
        ("a JPEG that is called .png", image(bad.encoded(".jpg"))),
        ("colour, grey and 16 bits mixed", beside(other_kinds)),
        ("what macOS puts beside an image (`._1.png`)", beside(lambda folder: (folder / "._1.png").write_bytes(b"\0"))),
        ("a pipe that is called 3.png", beside(lambda folder: os.mkfifo(folder / "3.png"))),
        ("a folder that is called 3.png", beside(lambda folder: (folder / "3.png").mkdir())),
        ("a link to /dev/zero", beside(lambda folder: (folder / "3.png").symlink_to("/dev/zero"))),
        ("a name with a superscript (`1²2.png`)", renamed("1²2.png")),
        ("a name that is no UTF-8", renamed(b"1\xff\xfe.png")),
        ("a damaged one whose name is no UTF-8", renamed(b"1\xff\xfe.png", b"no")),
        ("a damaged one whose name has a line break", renamed("1\n.png", b"no")),
        ("a TIFF's header of 30000 x 30000 pixels", image(bytes_of.tiff_header(30000, 30000), ".tiff")),
        ("a WebP's header of 16000 x 16000 pixels", image(bytes_of.webp_header(16000, 16000), ".webp")),
        ("a BMP's header of 30000 x 30000 pixels", image(bytes_of.bmp_header(30000, 30000), ".bmp")),
        ("a PPM's header of 30000 x 30000 pixels", image(b"P6 30000 30000 255\n" + b"\0" * 99, ".ppm")),
        ("a file of 20 GB", beside(lambda folder: bad.lengthened(folder / "1.png"))),
        ("half a TIFF", image(bad.encoded(".tiff")[:3000], ".tiff")),
        ("half a WebP", image(bad.encoded(".webp")[:300], ".webp")),
        ("half a BMP", image(bad.encoded(".bmp")[:3000], ".bmp")),
        ("half a PNG, filled up with zeros", image(bad.encoded(".png")[:3000] + b"\0" * 5000)),
        ("a zip archive of images", zipped),
        ("a tar archive", bad.file("frames.tar", NUL * 200 + b"\0" * 57 + b"ustar\0" + NUL)),
        ("a gzip archive", bad.file("frames.tgz", b"\x1f\x8b\x08" + NUL)),
        ("recordings in folders below", two_in_one),
        (
            "colour and depth in one folder",
            lambda folder: layouts.rgbd(folder / "room", "color_{}.png", "depth_{}.png"),
        ),
    ],
    call=read_frames,
)
DEPTH = rows(
    "Depth images",
    [
        ("floating-point TIFF", depths(".tiff", METRES)),
        ("TIFF of negative numbers", depths(".tiff", NEGATIVE)),
        ("`.npy` of floats", depths(".npy", bytes_of.npy(METRES))),
        ("`.npy` of Python objects", depths(".npy", bytes_of.npy(np.array([[{}]], object)))),
        ("`.npy` of three numbers a pixel", depths(".npy", bytes_of.npy(np.stack([METRES] * 3, -1)))),
        ("half an `.npy`", depths(".npy", bytes_of.npy(METRES)[:1000])),
        ("an `.npy` that declares 70 TiB", depths(".npy", bytes_of.npy_header((10**7, 10**6)))),
        ("floats of 1e10, which renderers write where there is nothing", depths(".tiff", 1e10 * METRES)),
        ("a folder `depth` of other files", other_depth),
        ("half of them all zero", bad.rgbd(without_half)),
        ("of Replica, one that is not there", recorded(layouts.replica, one_gone("results/depth*"))),
        ("of ScanNet, one that is not there", recorded(layouts.scannet, one_gone("depth/*"))),
        ("of ARKitScenes, one that is not there", recorded(layouts.arkit, one_gone("lowres_depth/*"))),
        ("of Stray Scanner, no confidence", recorded(layouts.stray, lambda made: shutil.rmtree(made / "confidence"))),
        ("of Stray Scanner, confidence of another size", recorded(layouts.stray, small_confidence)),
    ],
    call=read_frames,
)


DOUBLES = rows(
    "Images",
    [
        ("each picture as PNG and as JPEG", beside(as_jpeg)),
        ("some pictures as PNG and as JPEG", beside(lambda folder: as_jpeg(folder, 2))),
        ("a mask of each picture under its name", beside(masks)),
    ],
    call=frame_names,
)
HUGE_POSE = {
    "file_path": "images/frame_8.png",
    "transform_matrix": [[1, 0, 0, 10**400], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
}
LISTS = rows(
    "Lists and poses",
    [
        ("tabs", listed(lambda text: text.replace(" rgb/", "\trgb/"))),
        ("commas", listed(lambda text: text.replace(" rgb/", ", rgb/"))),
        ("a pipe that nobody writes into", bad.rgbd(pipe_in_list)),
        ("/dev/zero", listed(lambda text: "9.0 /dev/zero\n" + text)),
        ("a name with a NUL", listed(lambda text: "9.0 a\0b.png\n" + text)),
        ("names with backslashes", listed(lambda text: text.replace("rgb/", "rgb\\"))),
        ("a time of 1e300", listed(lambda text: text + "1e300 rgb/10.000000.png\n")),
        ("times in nanoseconds", listed(lambda text: "1403636579763555584 rgb/10.000000.png\n")),
        ("the depth's list in the place of the images'", bad.rgbd(depth_for_images)),
        ("truth of 1e300 metres", listed(lambda text: "1 1e300 0 0 0 0 0 1\n", "groundtruth.txt"), OPENED),
        ("`rgb.txt` of 20 GB", bad.rgbd(lambda folder: bad.lengthened(folder / "rgb.txt"))),
        ("truth of 20 GB", bad.rgbd(lambda folder: bad.lengthened(folder / "groundtruth.txt")), OPENED),
        ("truth that is a pipe", bad.rgbd(pipe_for("groundtruth.txt")), OPENED),
        ("poses of ARKitScenes out of order", recorded(layouts.arkit, backwards("lowres_wide.traj")), OPENED),
        ("poses of Stray Scanner out of order", recorded(layouts.stray, backwards("odometry.csv", 1)), OPENED),
        (
            "an alignment of Tanks and Temples that shears",
            recorded(layouts.tanks, bad.write("scan_trans.txt", "1 5 0 0 0 1 0 0 0 0 1 0 0 0 0 1")),
            OPENED,
        ),
        (
            "a pose of 400 digits in `transforms.json`",
            recorded(layouts.nerfstudio, other_numbers("transforms.json", frames=[HUGE_POSE])),
        ),
    ],
    call=read_frames,
)
CALIBRATION = rows(
    "Calibration",
    [
        ("focal lengths of 55 and 5500", calibrated("55 5500 31.5 23.5")),
        ("cx and cy in each other's place", calibrated("55 55 23.5 31.5")),
        ("a principal point left of the image", calibrated("55 55 -300 23.5")),
        ("an infinite focal length", calibrated("inf 55 31.5 23.5")),
        ("a focal length of 1e300", calibrated("1e300 1e300 31.5 23.5")),
        ("distortion with a NaN", calibrated("55 55 31.5 23.5 nan 0 0 0")),
        ("distortion of 1e300", calibrated("55 55 31.5 23.5 1e300 0 0 0")),
        ("semicolons", calibrated("55; 55; 31.5; 23.5")),
        ("names before the numbers", calibrated("fx: 55\nfy: 55\ncx: 31.5\ncy: 23.5")),
        ("five million numbers", calibrated("5 " * 5_000_000)),
        ("a pipe", beside(pipe_for("calibration.txt"))),
        ("Replica's, of other images", recorded(layouts.replica, other_numbers("cam_params.json", w=1200, h=680))),
        (
            "Replica's, a scale of 400 digits",
            recorded(layouts.replica, other_numbers("cam_params.json", scale=10**400)),
        ),
        (
            "Record3D's, numbers of 400 digits",
            recorded(layouts.record3d, other_numbers("metadata", perFrameIntrinsicCoeffs=[[10**400] * 4] * 3)),
        ),
        ("Record3D's, whose size is in texts", recorded(layouts.record3d, other_numbers("metadata", w="40", h="30.0"))),
    ],
    call=read_frames,
)


def named(name: str | bytes, make: Callable[[Path], Any]) -> Callable[[Path], Path]:
    """Something under this name."""

    def both(folder: Path) -> Path:
        make(folder / "clip.mp4")
        place = Path(os.fsdecode(os.fsencode(folder) + b"/" + os.fsencode(name)))
        (folder / "clip.mp4").rename(place)
        return place

    return both


def calibrated(path: Path) -> Path:
    """The same, beside its camera."""
    (path.parent / "calibration.txt").write_text("55 55 31.5 23.5")
    return path


def still_video(path: Path, moving: int = 0) -> Path:
    """A video of one picture, after so many others."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (bad.WIDTH, bad.HEIGHT))
    for number in range(24):
        writer.write(bad.picture(min(number, moving)))
    writer.release()
    return calibrated(path)


def jpegs(path: Path) -> Path:
    """A stream that tells nothing of its times."""
    path.write_bytes(b"".join(bad.encoded(".jpg", bad.picture(number)) for number in range(12)))
    return calibrated(path)


def resized_jpegs(path: Path, size: tuple[int, int]) -> Path:
    """A stream whose second half has another size."""
    pictures = [bad.picture(number) for number in range(12)]
    later = [cv2.resize(picture, size) for picture in pictures[6:]]
    path.write_bytes(b"".join(bad.encoded(".jpg", picture) for picture in [*pictures[:6], *later]))
    return calibrated(path)


def joined_video(path: Path) -> Path:
    """Two streams, each of which begins at its time 0."""
    path.write_bytes(2 * bad.video(path, 20).read_bytes())
    return calibrated(path)


VIDEOS = rows(
    "Videos",
    [
        ("a name that is no UTF-8", named(b"clip\xff.mp4", bad.video)),
        ("no frame", named("c.mp4", lambda path: bad.video(path, 0))),
        ("a pipe", named("c.mp4", os.mkfifo)),
        ("a bag of ROS that is a pipe", named("c.bag", os.mkfifo)),
        ("a bag of ROS of 20 GB of zeros", lambda folder: bad.lengthened(folder / "c.bag")),
        ("a video that is called .png", named("c.png", bad.video)),
        ("a GIF that is called .mp4", bad.file("clip.mp4", bad.encoded(".gif"))),
        ("a PNG that is called .mp4", bad.file("clip.mp4", bad.encoded(".png"))),
        ("a JPEG that is called .mov", bad.file("clip.mov", bad.encoded(".jpg"))),
        (
            "one picture again and again, as of an interlaced one",
            lambda folder: still_video(folder / "still.mp4"),
        ),
        ("one picture again and again from its tenth on", lambda folder: still_video(folder / "still.mp4", 9)),
        ("JPEGs one behind the other, without a container", lambda folder: jpegs(folder / "clip.mjpg")),
        ("pictures of other proportions in its second half", lambda folder: resized_jpegs(folder / "c.mjpg", (48, 48))),
        ("pictures of half the size in its second half", lambda folder: resized_jpegs(folder / "c.mjpg", (32, 24))),
        ("two recordings that were joined (.ts)", lambda folder: joined_video(folder / "clip.ts")),
        ("a picture of a phone (.heic)", bad.file("a.heic", b"\0\0\0\x18ftypheic" + bytes(40))),
        ("a zip archive", bad.file("clip.mp4", b"PK\x03\x04" + b"\0" * 999)),
    ],
    call=read_frames,
)
STRANGERS: list[Row] = [*IMAGES, *DEPTH, *DOUBLES, *LISTS, *CALIBRATION, *VIDEOS]
