"""Invalid inputs of `tests/test_bad_inputs.py`: for each reader and command one of each kind of fault."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bad_files as bad
import numpy as np
import tiny_bags as bags
import tiny_sequences as tiny
from tiny_state import state

from vggtgeo.datasets import open_sequence
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.io.persistence import DATA, HEADER
from vggtgeo.results.result import Result
from vggtgeo.slam.known_map import save_map

XYZ = "".join(f"property float {name}\n" for name in "xyz")


@dataclass(frozen=True)
class Row:
    """One invalid input.

    Fields:
        kind: "wrong", "truncated", "missing" or "inconsistent".
        given: What the user gives.
        named: What the message must contain: the argument or file, and the offending value.
        make: Makes the input in a folder and returns it.
        argv: The command line of what was made; without it, `call` is called with it.
        warned: The rest of the input is used after a warning.
    """

    kind: str
    given: str
    named: tuple[str, ...]
    make: Callable[[Path], Any]
    argv: Callable[[Any], Sequence[Any]] | None = None
    call: Callable[[Any], Any] | None = None
    warned: bool = False


def read_frames(folder: Any) -> None:
    """Read all frames and the ground truth."""
    sequence = open_sequence(folder)
    for _ in sequence.frames():
        pass
    sequence.ground_truth()


def folder(path: Path) -> Path:
    """Return the empty folder itself."""
    return path


def images(path: Path) -> Path:
    """Make valid images."""
    return bad.frames(path / "frames")


def run_with(*flags: Any) -> Callable[[Path], Sequence[Any]]:
    """Return the command that runs what was made."""
    return lambda made: ["run", made, "-o", made.parent / "out", *flags]


def words(*given: Any) -> Callable[[Any], Sequence[Any]]:
    """Return a command that needs no file."""
    return lambda made: given


def settings_file(path: Path) -> Path:
    """Make images, and a settings file that is not TOML."""
    bad.file("run.toml", "stride: 2")(path)
    return images(path)


def output_that_is_a_file(path: Path) -> Path:
    """Make images, and a file where the output folder would be."""
    bad.file("out", "")(path)
    return images(path)


def garbled_checkpoint(path: Path) -> Path:
    """Make images, and the folder of a killed run whose checkpoint is text."""
    bad.file("out/unfinished/checkpoint.npz", "no state")(path)
    return images(path)


def two_walks(path: Path) -> Path:
    """Make an estimate and its ground truth."""
    for name in ("estimate.txt", "truth.txt"):
        bad.walk(path / name, 0)
    return path


def long_walk(path: Path) -> Path:
    """Make an estimate with 20 GB of zeros behind it, and its ground truth."""
    bad.lengthened(two_walks(path) / "estimate.txt")
    return path


def evaluate(*flags: Any) -> Callable[[Path], Sequence[Any]]:
    """Return the command that compares the two trajectories."""
    return lambda made: ["evaluate", made / "estimate.txt", made / "truth.txt", *flags]


def linked_to_itself(path: Path) -> Path:
    """Make images, one of them a link to itself."""
    images(path)
    (path / "frames/1.png").unlink()
    (path / "frames/1.png").symlink_to("1.png")
    return path / "frames"


def sheared_pose(path: Path) -> Path:
    """Make a 7-Scenes folder with one pose that is not a rotation."""
    tiny.seven_scenes(path / "seq-01")
    (path / "seq-01/frame-000002.pose.txt").write_text("2 " * 12 + "0 0 0 1")
    return path / "seq-01"


def calibrated(content: str) -> Callable[[Path], Path]:
    """Return a maker of images with this `calibration.txt`."""
    return lambda path: bad.frames(path / "frames", calibration=content)


def with_map(change: Callable[[Path], Any]) -> Callable[[Path], Path]:
    """Return a maker of images, and of a map file that `change` has changed."""

    def make(path: Path) -> Path:
        save_map(path / "office.map", state())
        change(path / "office.map")
        return images(path)

    return make


def cut(file: Path) -> None:
    """Keep the first half of a file."""
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def with_header(file: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change the header of a map file in place."""
    with np.load(file) as kept:
        header, data = json.loads(kept[HEADER].tobytes()), kept[DATA]
    change(header)
    with file.open("wb") as stream:
        np.savez(stream, **{HEADER: np.frombuffer(json.dumps(header).encode(), np.uint8), DATA: data})


def newer(file: Path) -> None:
    """Give a map file a later version."""
    with_header(file, lambda header: header.update(version=99))


def with_unknown_field(file: Path) -> None:
    """Add a field that this version does not have."""
    with_header(file, lambda header: header["classes"][1][1].append("weather"))


def smaller(number: int) -> np.ndarray:
    """Return an image of a bag, the second one smaller than the others."""
    pixels = bags.image()[1](number)["data"].reshape(*bags.SIZE[::-1], 3)  # type: ignore[index, call-overload]
    return pixels[: 20 if number == 1 else None]


def bag(**topics: bags.Topic) -> Callable[[Path], Path]:
    """Return a maker of a bag of these topics."""
    return lambda path: bags.write(path / "c.bag", **topics)


def several_bags(path: Path) -> Path:
    """Make a recording in two files."""
    for number in range(2):
        bags.write(path / f"c_{number}.bag", c_image=bags.image())
    return path


RUN = [
    Row("missing", "no path", ("'path'",), folder, words("run")),
    Row("wrong", "`--stride 0`", ("--stride",), images, run_with("--stride", "0")),
    Row("inconsistent", "`--start` behind the last frame", ("start", "100"), images, run_with("--start", "100")),
    Row("missing", "settings file that does not exist", ("--settings",), images, run_with("--settings", "no.toml")),
    Row("wrong", "endless settings file", ("--settings", "/dev/zero"), images, run_with("--settings", "/dev/zero")),
    Row(
        "wrong",
        "settings file that is not TOML",
        ("run.toml", "'='"),
        settings_file,
        lambda made: run_with("--settings", made.parent / "run.toml")(made),
    ),
    Row("inconsistent", "output that is a file", ("out",), output_that_is_a_file, run_with()),
    Row("truncated", "checkpoint that is text", ("checkpoint.npz",), garbled_checkpoint, run_with("--resume")),
]
COMMANDS = [
    Row("wrong", "unknown command", ("'solv'", "'solve'"), folder, words("solv")),
    Row("missing", "trajectory that does not exist", ("no.txt",), folder, words("evaluate", "no.txt", "no.txt")),
    Row("wrong", "`--delta 0`", ("delta", "0.0"), two_walks, evaluate("--delta", "0")),
    Row("truncated", "20 GB of zeros", ("estimate.txt", "20000000000"), long_walk, evaluate()),
]
VERIFY: dict[str, Any] = {"argv": lambda made: ["models", "verify", made]}
NETWORKS = [
    Row("missing", "network that does not exist", ("net.onnx",), lambda path: path / "net.onnx", **VERIFY),
    Row("truncated", "empty network", ("net.onnx",), bad.file("net.onnx", ""), **VERIFY),
    Row("wrong", "PyTorch checkpoint", ("net.onnx",), bad.file("net.onnx", b"PK\x03\x04" + b"\0" * 99), **VERIFY),
]
LOAD: dict[str, Any] = {"call": lambda made: Result.load(made.parent)}
RESULTS = [
    Row("missing", "run without a summary", ("summary.json",), lambda path: path / "summary.json", **LOAD),
    Row("truncated", "summary that is not JSON", ("1", "2"), bad.file("summary.json", "{"), **LOAD),
]
READ: dict[str, Any] = {"call": read_frames}
IMAGES = [
    Row("truncated", "empty image", ("1.png",), bad.with_image(lambda: b""), warned=True, **READ),
    Row("missing", "link to itself", ("frames", "1"), linked_to_itself, warned=True, **READ),
    Row(
        "wrong",
        "depth in metres as 16 bits",
        ("10.004000.png", "0.0004"),
        bad.every_depth(lambda: np.full((tiny.HEIGHT, tiny.WIDTH), 2, np.uint16)),
        warned=True,
        **READ,
    ),
]
TEXTS = [
    Row("missing", "list without a line", ("rgb.txt",), bad.rgbd(bad.write("rgb.txt", "# nothing\n")), **READ),
    Row("wrong", "time that is a word", ("rgb.txt", "1"), bad.rgbd(bad.write("rgb.txt", "now rgb/1.png\n")), **READ),
    Row("inconsistent", "pose that is not a rotation", ("rotation",), sheared_pose, warned=True, **READ),
    Row("wrong", "calibration of words", ("calibration.txt", "'fx fy cx cy'"), calibrated("fx fy cx cy"), **READ),
    Row("missing", "empty calibration", ("calibration.txt", "0"), calibrated(""), **READ),
    Row(
        "inconsistent",
        "focal length of 0.001",
        ("calibration.txt", "0.001"),
        calibrated("0.001 0.001 31.5 23.5"),
        **READ,
    ),
]
VIDEOS = [
    Row(
        "wrong",
        "text as a video",
        ("clip.mp4",),
        bad.file("clip.mp4", "ffconcat version 1.0\nfile /etc/passwd\n"),
        **READ,
    ),
    Row("truncated", "empty video", ("clip.mp4",), bad.file("clip.mp4", ""), **READ),
]
WITH_MAP: dict[str, Any] = {
    "argv": lambda made: ["run", made, "-o", made.parent / "out", "--map", made.parent / "office.map"]
}
MAPS = [
    Row("missing", "map that does not exist", ("office.map",), images, **WITH_MAP),
    Row("truncated", "half a map", ("office.map",), with_map(cut), **WITH_MAP),
    Row("wrong", "map of a newer version", ("office.map", "99"), with_map(newer), **WITH_MAP),
    Row("inconsistent", "map with an unknown field", ("office.map",), with_map(with_unknown_field), **WITH_MAP),
]
BAGS = [
    Row("missing", "bag without images", ("c.bag",), bag(c_info=bags.info()), **READ),
    Row(
        "inconsistent",
        "image of another size in a bag",
        ("image, 1", "40"),
        bag(c_image=bags.image(smaller), c_info=bags.info()),
        warned=True,
        **READ,
    ),
    Row("wrong", "several bags", ("2", "1"), several_bags, **READ),
]
CLOUD: dict[str, Any] = {"call": PointCloud.load_ply}
CLOUDS = [
    Row("wrong", "text as a cloud", ("map.ply", "1"), bad.file("map.ply", "no cloud"), **CLOUD),
    Row(
        "truncated",
        "cloud that declares 10^15 points",
        ("map.ply", "vertex"),
        bad.ply(f"format binary_little_endian 1.0\nelement vertex 1000000000000000\n{XYZ}", bytes(999)),
        **CLOUD,
    ),
    Row("missing", "cloud that does not exist", ("map.ply",), lambda path: path / "map.ply", **CLOUD),
]
SOLVE: dict[str, Any] = {"argv": lambda made: ["solve", made, "-o", made.parent / "solution.npz"]}
PROBLEMS = [
    Row("missing", "problem that does not exist", ("no.npz",), lambda path: path / "no.npz", **SOLVE),
    Row("truncated", "empty problem", ("problem.npz",), bad.file("problem.npz", ""), **SOLVE),
    Row("inconsistent", "array of another shape", ("T_init", "3"), bad.problem(T_init=np.zeros((3, 4))), **SOLVE),
    Row("wrong", "array of words", ("d_prior",), bad.problem(d_prior=lambda old: old.astype(str)), **SOLVE),
]
ROWS: tuple[Row, ...] = (
    *RUN,
    *COMMANDS,
    *NETWORKS,
    *RESULTS,
    *IMAGES,
    *TEXTS,
    *VIDEOS,
    *MAPS,
    *BAGS,
    *CLOUDS,
    *PROBLEMS,
)
