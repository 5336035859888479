"""Rows of the table of bad inputs: invalid calls of the library by a script.

The tests check all annotations while they run, so that these calls would not get far there: called as a program, this
file makes them as a script does, and prints how each of them ended.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bad_files as bad
import jax
import numpy as np
from bad_row import Row, nothing
from bad_rows_solving import SOLVING
from vggtgeo.models.classical import SiftMatcher

import vggtgeo as vg
from vggtgeo import evaluation
from vggtgeo.datasets.in_memory import frame_stream
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.io.errors import InputWarning
from vggtgeo.learning import window_dataset
from vggtgeo.slam.run import in_order

WIDTH, HEIGHT = 160, 120
IMAGES = [bad.picture(row, WIDTH, HEIGHT) for row in range(3)]
DEPTH = np.full((HEIGHT, WIDTH), 2.0, np.float32)
EYE = np.eye(4)
TINY = {name: lambda values: 1e-7 * values for name in ("d_init", "d_prior", "d_sigma")}


def reconstruct(frames: Any = None, **options: Any) -> Callable[[Path], Any]:
    """`vg.reconstruct` of three images, or of something else."""
    return lambda _: vg.reconstruct(IMAGES if frames is None else frames(), **options)


class Forgetful(SiftMatcher):
    """A matcher that returns nothing."""

    def describe(self, image: np.ndarray) -> Any:
        """Of any image."""


class Half:
    """A confidence of half the size."""

    def confidence(self, image: np.ndarray) -> np.ndarray:
        """All the same."""
        return np.ones((image.shape[0] // 2, image.shape[1] // 2), np.float32)


def frame(number: int, **changes: Any) -> vg.data.Frame:
    """A good frame with other fields."""
    fields = {"timestamp": number / 30, "image": IMAGES[number], "depth": None, "name": f"frame {number}"}
    return vg.data.Frame(**{"index": number, **fields, **changes})


def stream(items: Callable[[], Sequence[Any]]) -> Callable[[Path], Any]:
    """The frames of a stream, one after the other, as a run reads them, without tracking them."""

    def call(_: Path) -> None:
        found = frame_stream(items())
        for _ in in_order(found.frames(), found.camera):
            pass

    return call


def trajectory(times: Any, poses: Any) -> Callable[[Path], Any]:
    """A trajectory of these."""
    return lambda _: vg.Trajectory(times, poses)


def evaluated(**options: Any) -> Callable[[Path], Any]:
    """`vg.evaluate` of a trajectory against itself."""
    steps = [np.block([[np.eye(3), np.full((3, 1), row)], [0.0, 0.0, 0.0, 1.0]]) for row in range(5)]
    return lambda _: vg.evaluate(vg.Trajectory(range(5), steps), vg.Trajectory(range(5), steps), **options)


def simulated(*given: Any, **options: Any) -> Callable[[Path], Any]:
    """`vg.simulate`."""
    return lambda _: vg.simulate(*given, **options)


def written(folder: Path, **more: Any) -> None:
    """Three windows."""
    size = vg.PaddedSize(keyframes=3, points=40, lines=0, degree=2)
    with vg.learning.WindowWriter(folder) as writer:
        for seed in range(3):
            writer.add(vg.simulate_window(3, points=8, lines=0, seed=seed).pack(size=size), **more)


def dataset(
    change: Callable[[Path], Any], use: Callable[[Any], Any] = lambda data: list(data.batches(3))
) -> Callable[[Path], Any]:
    """A folder of three windows that was changed, opened and used."""

    def call(folder: Path) -> Any:
        written(folder / "windows", poses=np.zeros(3))
        change(folder / "windows")
        return use(vg.learning.WindowDataset.open(folder / "windows"))

    return call


def index(place: Path, **changes: Any) -> None:
    """Another index."""
    (place / "windows.json").write_text(json.dumps({"version": window_dataset.VERSION, "windows": 3} | changes))


def labels(place: Path, poses: Any) -> None:
    """Other labels of one window."""
    window_dataset.LABELS.write(place / "0000001.labels.npz", {"poses": poses})


def objects(place: Path) -> None:
    """Labels of one window that another program wrote."""
    np.savez_compressed(place / "0000001.labels.npz", poses=np.array([{}], object))


def result() -> vg.Result:
    """Of a run that saw nothing."""
    path = vg.Trajectory([0.0], [EYE])
    return vg.Result(path, path, CLOUD, (50.0, 50.0, 32.0, 24.0), False, vg.Verdict("failed"), {})


def of_one_array() -> Sequence[Any]:
    """Images that a camera writes into one array."""
    image = np.zeros_like(IMAGES[0])

    def items() -> Any:
        for each in IMAGES:
            image[:] = each
            yield image

    return items()  # type: ignore[no-any-return]


def as_they_were(_: Path) -> None:
    """Frames of one array keep their own images."""
    frames = list(frame_stream(of_one_array()).frames())
    assert all((frame.image == image).all() for frame, image in zip(frames, IMAGES, strict=True))


def fixed(count: int = 5) -> vg.Trajectory:
    """A camera that stands still."""
    return vg.Trajectory(range(count), [EYE] * count)


CLOUD = PointCloud(np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
TRIANGLE = np.eye(3), np.array([[0, 1, 2]])

CALLS: tuple[tuple[str, Callable[[Path], Any]], ...] = (
    *SOLVING,
    ("`plot` of a number", lambda _: vg.plot(5)),
    ("`plot`: a truth of another time", lambda _: vg.plot(fixed(), vg.Trajectory([100.0], [EYE]))),
    ("`plot` of a result: a file's name as truth", lambda _: vg.plot(result(), truth="truth.txt")),
    ("`pack_batch` of no windows", lambda _: vg.batches.pack_batch([None])),
    ("frames that are a number", reconstruct(lambda: 5)),
    ("images of numbers from 0 to 1", reconstruct(lambda: [IMAGES[0] / 255.0])),
    ("frames whose image has numbers from 0 to 1", stream(lambda: [frame(0, image=IMAGES[0] / 255)])),
    ("depth in whole millimetres", stream(lambda: [(IMAGES[0], (DEPTH * 1000).astype(np.uint16))])),
    ("depth of another size than its image", stream(lambda: [(IMAGES[0], DEPTH[:60])])),
    ("depth that only later frames have", stream(lambda: [IMAGES[0], (IMAGES[1], DEPTH)])),
    ("two frames of one time", stream(lambda: [frame(0), frame(1, timestamp=0.0), frame(2)])),
    ("settings in a dictionary", reconstruct(settings={"window": 3})),
    ("a preset's name as roles", reconstruct(roles="classical")),
    ("intrinsics as the camera", reconstruct(camera=(100, 100, 80, 60))),
    ("facts that JSON does not have", reconstruct(facts={"when": object()})),
    ("checkpoints every `often`", lambda _: vg.Checkpoints("night.npz", every="often")),
    ("`evaluate`: `delta` that is a text", evaluated(delta="a")),
    ("a camera resized to nothing", lambda _: vg.Camera((50, 50, 32, 24), 64, 48).resized(0, 0)),
    ("`run`: a stride of 0", lambda _: next(vg.run(IMAGES, stride=0))),
    ("a trajectory of transposed poses", trajectory([0], [(EYE + np.eye(4, k=3)).T])),
    ("`evaluate` of two arrays of poses", lambda _: vg.evaluate(EYE[None], EYE[None])),
    ("`open_sequence` of nothing", lambda _: vg.open_sequence(None)),
    ("`open_sequence` at a rate that is a text", lambda folder: vg.open_sequence(bad.frames(folder / "a"), rate="30")),
    ("`load_problem`: lengths in a tenth of a micrometre", lambda made: vg.load_problem(bad.problem(**TINY)(made))),
    ("`load_problem`: terms that are a number", lambda made: vg.load_problem(bad.problem()(made), terms=3)),
    ("a map of nothing", lambda _: vg.load_map(None)),
    ("`simulate`: frames that are a text", simulated("room", "3")),
    ("`simulate`: a size that is a text", simulated("room", 3, size="640x480")),
    ("`cloud_error` of lists", lambda _: evaluation.cloud_error([[0, 0]], [[0, 0, 0]])),
    ("`cloud_error`: a threshold that is a text", lambda _: evaluation.cloud_error(EYE[:, :3], EYE[:, :3], "5 cm")),
    ("`mesh_error` of names of files", lambda _: evaluation.mesh_error("a.ply", "b.ply")),
    ("`depth_error`: a mask of whole numbers", lambda _: evaluation.depth_error(DEPTH, DEPTH, mask=DEPTH.astype(int))),
    ("`nearest_in_time` of times out of order", lambda _: evaluation.nearest_in_time([0.0], [1.0, 0.0], 0.1)),
    ("a `PointCloud` of texts", lambda _: PointCloud("a", "b")),
    ("a `Mesh` whose colours are floats", lambda _: Mesh(EYE[:3, :3], np.zeros((1, 3), int), EYE[:3, :3], EYE[:3, :3])),
    ("a window dataset of another version", dataset(lambda place: index(place, version=9))),
    ("a window whose labels are not there", dataset(lambda place: (place / "0000001.labels.npz").unlink())),
    ("a window whose labels are no archive", dataset(lambda place: (place / "0000001.labels.npz").write_text("x"))),
    ("a window whose labels are Python objects", dataset(objects)),
    ("a window whose labels have another shape", dataset(lambda place: labels(place, np.zeros(2)))),
    ("a window whose labels are 300 MB, packed", dataset(lambda place: labels(place, np.zeros(40_000_000)))),
    ("`batches` of a size that is a text", dataset(lambda place: None, lambda data: data.batches("2"))),
    ("`stack_windows` of no window", lambda _: vg.learning.stack_windows([])),
    ("`WindowWriter` into a folder that holds windows", dataset(written)),
    ("depth in millimetres, in floats", stream(lambda: [(IMAGES[0], DEPTH * 1000), (IMAGES[1], DEPTH * 1000)])),
    ("images in one array, filled anew for each", as_they_were),
    ("`perception`: a provider that is none", lambda _: vg.perception(provider="tpu")),
    ("a number as matcher", lambda _: vg.Roles(points=5)),
    ("a name as depth", lambda _: vg.Roles(depth="moge2-small")),
    ("a confidence of one's own of another size", lambda _: next(vg.run(IMAGES, roles=vg.Roles(confidence=Half())))),
    ("a matcher of one's own that forgets to return", lambda _: next(vg.run(IMAGES, roles=vg.Roles(Forgetful())))),
    ("a result of a trajectory", lambda _: vg.Result.of(fixed())),
    ("a result saved with depth of no such choice", lambda folder: result().save(folder / "r", depth="evry")),
)

PYTHON = [Row("Calls from Python", given, nothing, call=call, slack=3.0) for given, call in CALLS]


def main(names: Sequence[str]) -> None:
    """Print how each row of these names ends, its messages, and seconds of the processor, as JSON."""
    jax.config.update("jax_enable_x64", True)
    results = {}
    for row in (row for row in PYTHON if row.given in names):
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            began, ended, messages = time.process_time(), "used", []
            try:
                row.call(Path(folder))
            except ValueError as error:
                ended, messages = "error", [str(error)]
            seconds = time.process_time() - began
            messages += [str(entry.message) for entry in caught if issubclass(entry.category, InputWarning)]
        results[row.given] = (ended, messages, seconds)
    sys.stdout.write(json.dumps(results))


if __name__ == "__main__":
    main(sys.argv[1:])
