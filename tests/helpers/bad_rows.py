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


def settings_file(path: Path) -> Path:
    """Make images, and a settings file that is not TOML."""
    bad.file("run.toml", "stride: 2")(path)
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


def empty_image(path: Path) -> Path:
    """Make images, one of them an empty file."""
    images(path)
    (path / "frames/1.png").write_bytes(b"")
    return path / "frames"


def half_a_summary(path: Path) -> Path:
    """Make a run folder whose summary is not JSON."""
    bad.file("summary.json", "{")(path)
    return path


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


def smaller(number: int) -> np.ndarray:
    """Return an image of a bag, the second one smaller than the others."""
    pixels = bags.image()[1](number)["data"].reshape(*bags.SIZE[::-1], 3)  # type: ignore[index, call-overload]
    return pixels[: 20 if number == 1 else None]


def bag(**topics: bags.Topic) -> Callable[[Path], Path]:
    """Return a maker of a bag of these topics."""
    return lambda path: bags.write(path / "c.bag", **topics)


smaller_image = bag(c_image=bags.image(smaller), c_info=bags.info())


def several_bags(path: Path) -> Path:
    """Make a recording in two files."""
    for number in range(2):
        bags.write(path / f"c_{number}.bag", c_image=bags.image())
    return path


def command(kind: str, given: str, named: tuple[str, ...], make: Callable[[Path], Any], *argv: Any) -> Row:
    """Return a row whose input the command line gets: functions in it are called with what was made."""
    return Row(kind, given, named, make, lambda made: [word(made) if callable(word) else word for word in argv])


def itself(made: Any) -> Any:
    """Return what was made."""
    return made


def beside(name: str) -> Callable[[Path], Path]:
    """Return the way from what was made to a file beside it."""
    return lambda made: made.parent / name


def runs(kind: str, given: str, named: tuple[str, ...], make: Callable[[Path], Any], *flags: Any) -> Row:
    """Return a row whose input is run with these flags."""
    return command(kind, given, named, make, "run", itself, "-o", beside("out"), *flags)


def reads(kind: str, given: str, named: tuple[str, ...], make: Callable[[Path], Any], warned: bool = False) -> Row:
    """Return a row whose input is read as a sequence."""
    return Row(kind, given, named, make, call=read_frames, warned=warned)


def evaluates(kind: str, given: str, named: tuple[str, ...], make: Callable[[Path], Any], *flags: Any) -> Row:
    """Return a row whose two trajectories are compared."""
    files = (lambda made: made / "estimate.txt", lambda made: made / "truth.txt")
    return command(kind, given, named, make, "evaluate", *files, *flags)


WITH_MAP = ("--map", beside("office.map"))
VERIFY = ("models", "verify", itself)
SOLVE = ("solve", itself, "-o", beside("solution.npz"))
FFCONCAT = "ffconcat version 1.0\nfile /etc/passwd\n"
MANY_POINTS = f"format binary_little_endian 1.0\nelement vertex 1000000000000000\n{XYZ}"
ROWS = (
    # Runs and other commands.
    command("missing", "no path", ("'path'",), folder, "run"),
    runs("wrong", "`--stride 0`", ("--stride",), images, "--stride", "0"),
    runs("inconsistent", "`--start` behind the last frame", ("start", "100"), images, "--start", "100"),
    runs("missing", "settings file that does not exist", ("--settings",), images, "--settings", "no.toml"),
    runs("wrong", "endless settings file", ("--settings", "/dev/zero"), images, "--settings", "/dev/zero"),
    runs("wrong", "settings that are not TOML", ("run.toml", "'='"), settings_file, "--settings", beside("run.toml")),
    runs("truncated", "checkpoint that is text", ("checkpoint.npz",), garbled_checkpoint, "--resume"),
    command("wrong", "unknown command", ("'solv'", "'solve'"), folder, "solv"),
    command("missing", "trajectory that does not exist", ("no.txt",), folder, "evaluate", "no.txt", "no.txt"),
    evaluates("wrong", "`--delta 0`", ("delta", "0.0"), two_walks, "--delta", "0"),
    # Networks.
    command("missing", "network that does not exist", ("net.onnx",), lambda path: path / "net.onnx", *VERIFY),
    command("truncated", "empty network", ("net.onnx",), bad.file("net.onnx", ""), *VERIFY),
    command("wrong", "PyTorch checkpoint", ("net.onnx",), bad.file("net.onnx", b"PK\x03\x04" + b"\0" * 99), *VERIFY),
    # Results.
    Row("missing", "run without a summary", ("summary.json",), folder, call=Result.load),
    Row("truncated", "summary that is not JSON", ("1", "2"), half_a_summary, call=Result.load),
    # Images.
    reads("truncated", "empty image", ("1.png",), empty_image, warned=True),
    # Lists, poses and cameras.
    reads("missing", "list without a line", ("rgb.txt",), bad.rgbd("# nothing\n")),
    reads("wrong", "time that is a word", ("rgb.txt", "1"), bad.rgbd("now rgb/1.png\n")),
    reads("inconsistent", "pose that is not a rotation", ("rotation",), sheared_pose, warned=True),
    reads("wrong", "calibration of words", ("calibration.txt", "'fx fy cx cy'"), calibrated("fx fy cx cy")),
    reads("missing", "empty calibration", ("calibration.txt", "0"), calibrated("")),
    reads("inconsistent", "focal length of 0.001", ("calibration.txt", "0.001"), calibrated("0.001 0.001 31.5 23.5")),
    # Videos and bags.
    reads("wrong", "text as a video", ("clip.mp4",), bad.file("clip.mp4", FFCONCAT)),
    reads("truncated", "empty video", ("clip.mp4",), bad.file("clip.mp4", "")),
    reads("missing", "bag without images", ("c.bag",), bag(c_info=bags.info())),
    reads("inconsistent", "image of another size", ("image, 1", "40"), smaller_image, warned=True),
    reads("wrong", "several bags", ("2", "1"), several_bags),
    # Maps.
    runs("missing", "map that does not exist", ("office.map",), images, *WITH_MAP),
    runs("truncated", "half a map", ("office.map",), with_map(cut), *WITH_MAP),
    runs("wrong", "map of a newer version", ("office.map", "99"), with_map(newer), *WITH_MAP),
    # Clouds.
    Row("wrong", "text as a cloud", ("map.ply", "1"), bad.file("map.ply", "no cloud"), call=PointCloud.load_ply),
    Row("truncated", "10^15 points", ("map.ply", "vertex"), bad.ply(MANY_POINTS, bytes(999)), call=PointCloud.load_ply),
    Row("missing", "no cloud", ("map.ply",), lambda path: path / "map.ply", call=PointCloud.load_ply),
    # Problems.
    command("missing", "problem that does not exist", ("no.npz",), lambda path: path / "no.npz", *SOLVE),
    command("truncated", "empty problem", ("problem.npz",), bad.file("problem.npz", ""), *SOLVE),
    command("inconsistent", "array of another shape", ("T_init", "3"), bad.problem(T_init=np.zeros((3, 4))), *SOLVE),
    command("wrong", "array of words", ("d_prior",), bad.problem(d_prior=np.full(27, "far")), *SOLVE),
)
