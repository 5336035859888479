"""Rows of the table of bad inputs: what is in folders of images that others made, from rare kinds of them to pipes."""

from __future__ import annotations

import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import bad_files as bad
import cv2
import numpy as np
import picture_bytes as bytes_of
import tiny_layouts as layouts
import tiny_sequences as tiny
from bad_files import beside
from bad_row import Row, good, read_frames, rows

from vggtgeo.datasets import open_sequence

SIZE = (bad.WIDTH, bad.HEIGHT)
PICTURE = bad.picture(1)
NUL = b"\0"


def image(content: bytes, suffix: str = ".png") -> Callable[[Path], Path]:
    """Good images, of which the second is this file."""
    return bad.with_image(lambda: content, suffix)


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


def named_images(*names: str) -> Callable[[Path], Path]:
    """Images in the order of these names."""
    return lambda folder: tiny.images(folder / "frames", names)


def in_order(folder: Path) -> None:
    """Frames come as their images were made."""
    numbers = [int(frame.image[0, 0, 0]) for frame in open_sequence(folder).frames()]
    assert numbers == sorted(numbers)


def of_rig(folder: Path) -> Path:
    """Images of two cameras, which have numbers."""
    return tiny.images(folder / "frames", tuple(f"cam{camera}_{row}.png" for camera in (0, 1) for row in range(3)))


def frame_names(folder: Path) -> None:
    """All frames, each file once, as many as there are pictures: of two formats of the same ones only the PNG."""
    names = [frame.name for frame in open_sequence(folder).frames()]
    formats = {Path(name).suffix for name in names}
    whole = [path for path in folder.iterdir() if path.suffix in formats]
    assert len(names) == len(set(names)) == len(whole)
    assert formats == {".png"} if len(names) == 3 else len(formats) == 2


def only(*files: tuple[str, bytes]) -> Callable[[Path], Path]:
    """A folder of nothing but these."""

    def make(folder: Path) -> Path:
        for name, content in files:
            bad.file(f"pictures/{name}", content)(folder)
        return folder / "pictures"

    return make


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


def read_while_it_grows(folder: Path) -> None:
    """Two images more once the first is read, and what is none of them."""
    frames = open_sequence(folder).frames()
    next(frames)
    for name in ("3.png", "4.png", "preview.jpg"):
        shutil.copy(folder / "0.png", folder / name)
    assert len(list(frames)) == 2


def large_jpeg() -> bytes:
    """A JPEG of some hundred bytes whose header says 32586 x 2634 pixels."""
    whole = bytearray(bad.encoded(".jpg"))
    place = whole.index(b"\xff\xc0") + 5
    whole[place : place + 4] = (32586).to_bytes(2) + (2634).to_bytes(2)
    return bytes(whole)


IMAGES = rows(
    "Images",
    [
        ("a small JPEG that declares 86 million pixels", image(large_jpeg(), ".jpg")),
        ("images of two cameras, `left_0.png` and `right_0.png`", beside(two_cameras)),
        ("images of two cameras, `cam0_1.png` and `cam1_1.png`", of_rig),
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
DOUBLES = rows(
    "Images",
    [
        ("each picture as PNG and as JPEG", beside(as_jpeg)),
        ("some pictures as PNG and as JPEG", beside(lambda folder: as_jpeg(folder, 2))),
        ("a mask of each picture under its name", beside(masks)),
    ],
    call=frame_names,
)
GROWING = rows("Images", [("images that come in while the folder is read", good)], call=read_while_it_grows)
ORDERED = rows(
    "Images",
    [
        ("names below zero: `-2.png` comes before `-1.png`", named_images("-10.png", "-2.png", "-1.png", "0.png")),
        ("a picture and its copies: `img.png` before `img (1).png`", named_images("img.png", "img (1).png")),
        (
            "names that count behind a point: `1.9.png` before `1.10.png`",
            named_images("1.8.png", "1.9.png", "1.10.png"),
        ),
        ("Arabic digits", named_images("٢.png", "٩.png", "١٠.png")),
    ],
    call=in_order,
)
ALL_IMAGES: list[Row] = [*IMAGES, *DOUBLES, *GROWING, *ORDERED]
