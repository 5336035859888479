"""What is decoded by libraries in C: images of all formats, videos, bags of ROS, networks and their cached answers.

A damaged file may end such a library's process, so `fuzz_decoders.py` reads them in a process of its own, and nothing
else does (the parsers in Python are in `parsers.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import bad_files as bad
import cv2
import numpy as np
import onnx
import tiny_layouts as layouts
import tiny_networks as networks
import tiny_sequences as tiny
from parsers import Kind
from vggtgeo.models.onnx.cache import FolderCache
from vggtgeo.models.onnx.contracts import CONTRACTS
from vggtgeo.models.onnx.session import Session, open_session

from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.image_files import MILLIMETRES, read_depth, read_image
from vggtgeo.io.network_errors import as_input_errors

WIDE = bad.picture(1).astype(np.uint16) << 8
LZW, DEFLATE = 5, 8


def picture(name: str, suffix: str, *options: int, image: np.ndarray | None = None) -> Kind:
    """An image."""
    return Kind(name, f"i{suffix}", lambda _: bad.encoded(suffix, image, *options), read_image)


def depth(name: str, suffix: str, *options: int) -> Kind:
    """A depth image."""
    content = lambda _: bad.encoded(suffix, tiny.depth_codes(1), *options)
    return Kind(name, f"d{suffix}", content, lambda file: read_depth(file, MILLIMETRES))


def _read_sequence(path: Path) -> None:
    sequence = open_sequence(path)
    for _ in islice(sequence.frames(), 20):
        pass
    sequence.ground_truth()


def video(suffix: str, codec: str) -> Kind:
    """A video of small frames."""

    def content(folder: Path) -> bytes:
        file = folder / f"whole{suffix}"
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*codec), 10.0, (64, 48))
        for row in range(6):
            writer.write(bad.picture(row))
        writer.release()
        whole = file.read_bytes()
        file.unlink()
        return whole

    return Kind(f"video {suffix[1:]} {codec}", f"v{suffix}", content, _read_sequence)


def _matroska(folder: Path) -> bytes:
    return layouts.matroska(folder / "whole.mkv", (0, 40, 90, 120)).read_bytes()


def _bag(folder: Path) -> bytes:
    whole = layouts.bag(folder / "whole.bag", ros2=False).read_bytes()
    (folder / "whole.bag").unlink()
    return whole


def _exr(folder: Path) -> bytes:
    return (layouts.record3d_exported(folder / "exr") / "depth/1.exr").read_bytes()


def _record3d(folder: Path) -> bytes:
    whole = layouts.record3d_file(folder / "whole.r3d").read_bytes()
    (folder / "whole.r3d").unlink()
    return whole


def _lzfse(folder: Path) -> bytes:
    return (layouts.record3d(folder / "r") / "rgbd/1.depth").read_bytes()


def bag2(file: str) -> Callable[[Path], bytes]:
    """One file of a bag of ROS 2; the rest of it is there."""
    return lambda folder: (layouts.bag(folder / "bag", ros2=True) / file).read_bytes()


def _network(folder: Path) -> bytes:
    return networks.moge2(folder / "whole.onnx").read_bytes()


def _external(folder: Path) -> bytes:
    """A network whose weights are in a file of their own, which is there."""
    model = onnx.load(networks.moge2(folder / "whole.onnx"))
    outside = {"save_as_external_data": True, "location": "n.onnx.data", "size_threshold": 0}
    onnx.save(model, folder / "n.onnx", **outside)
    return (folder / "n.onnx").read_bytes()


def _open_and_run(file: Path) -> None:
    with as_input_errors():
        session = open_session(file, CONTRACTS["moge2"], provider="cpu", threads=1)
        session.digest  # noqa: B018 - reads the file's external data
        session.warm_up()


def _named() -> Session:
    """As much of a session as a cache asks for."""
    session = object.__new__(Session)
    object.__setattr__(session, "digest", "0" * 64)
    return session


ANSWER = {"depth": np.arange(6.0).reshape(2, 3), "mask": np.ones(4, bool)}
"""What is computed where no answer is kept."""


def _answered(folder: Path) -> dict[str, np.ndarray]:
    image = np.zeros((4, 4, 3), np.uint8)
    return dict(FolderCache(folder).get([_named()], ("setting",), [image], lambda: ANSWER))


def _cached(folder: Path) -> Path:
    _answered(folder)
    return next(folder.glob("*/*.npz"))


def _cache(folder: Path) -> bytes:
    return _cached(folder / "whole").read_bytes()


def _read_cache(file: Path) -> dict[str, np.ndarray]:
    """A damaged answer is computed again, and a whole one is the answer."""
    place = _cached(file.parent / "cache")
    place.write_bytes(file.read_bytes())
    found = _answered(file.parent / "cache")
    assert all(np.array_equal(found[name], value) for name, value in ANSWER.items())
    return found


DECODERS: tuple[Kind, ...] = (
    picture("PNG", ".png"),
    picture("JPEG", ".jpg"),
    picture("progressive JPEG", ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    picture("TIFF", ".tiff"),
    picture("TIFF LZW", ".tiff", cv2.IMWRITE_TIFF_COMPRESSION, LZW),
    picture("TIFF 16 bit", ".tiff", cv2.IMWRITE_TIFF_COMPRESSION, DEFLATE, image=WIDE),
    picture("WebP", ".webp", cv2.IMWRITE_WEBP_QUALITY, 80),
    picture("WebP lossless", ".webp", cv2.IMWRITE_WEBP_QUALITY, 101),
    picture("BMP", ".bmp"),
    picture("PPM", ".ppm"),
    depth("depth PNG", ".png"),
    depth("depth TIFF", ".tiff"),
    Kind("depth EXR", "d.exr", _exr, lambda file: read_depth(file, MILLIMETRES)),
    Kind("Record3D", "room.r3d", _record3d, _read_sequence),
    Kind("depth of Record3D", "r/rgbd/1.depth", _lzfse, lambda file: _read_sequence(file.parent.parent)),
    video(".mp4", "mp4v"),
    video(".avi", "MJPG"),
    Kind("video mkv", "v.mkv", _matroska, _read_sequence),
    Kind("bag", "b.bag", _bag, _read_sequence),
    Kind("bag 2 metadata", "bag/metadata.yaml", bag2("metadata.yaml"), lambda file: _read_sequence(file.parent)),
    Kind("bag 2 database", "bag/bag.db3", bag2("bag.db3"), lambda file: _read_sequence(file.parent)),
    Kind("network", "n.onnx", _network, _open_and_run),
    Kind("network with external data", "n.onnx", _external, _open_and_run),
    Kind("cached answer", "c.npz", _cache, _read_cache),
)
"""Any of them: whole, then damaged."""
ANY: Any = {kind.name: kind for kind in DECODERS}
