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
import tiny_sequences
from bad_row import Row, nothing
from bad_rows_solving import SOLVING
from vggtgeo.models.classical import SiftMatcher

import vggtgeo as vg
from vggtgeo import evaluation
from vggtgeo.datasets import open_sequence, with_depth_scale
from vggtgeo.datasets.in_memory import frame_stream
from vggtgeo.export import export
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.io.errors import InputWarning
from vggtgeo.learning import window_dataset
from vggtgeo.results.source import open_source
from vggtgeo.simulation import Sensor
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


def save_cloud(folder: Path, size: float) -> None:
    """A cloud of one point, written."""
    PointCloud(np.full((1, 3), size), np.zeros((1, 3), np.uint8)).save_ply(folder / "cloud.ply")


def same_place(count: int, truth: Any) -> Any:
    """Points at one place, against themselves and then against others."""
    evaluation.cloud_error(np.zeros((count, 3)), np.zeros((count, 3)))
    return evaluation.cloud_error(np.zeros((count, 3)), truth)


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


class OneArray:
    """A sequence of one's own that fills one array anew for each frame."""

    name = "own"
    camera = vg.Camera.guess(*IMAGES[0].shape[1::-1])
    has_depth = False

    def __len__(self) -> int:
        return len(IMAGES)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Any:
        """All of them."""
        return (frame(index, image=image) for index, image in enumerate(of_one_array()))

    def ground_truth(self) -> None:
        """None."""


def as_they_are_in_a_run(_: Path) -> None:
    """Frames of such a sequence keep their own images."""
    frames = list(open_source(OneArray(), None, vg.SlamSettings()).frames.frames())
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
    ("`frame_trajectory` of nothing", lambda _: vg.frame_trajectory(None)),
    ("`SurfaceFusion.update` of nothing", lambda _: vg.callbacks.SurfaceFusion([50.0, 50.0, 32.0, 24.0]).update(None)),
    ("`SurfaceFusion`: three intrinsics", lambda _: vg.callbacks.SurfaceFusion([50.0, 50.0, 32.0])),
    ("`SurfaceFusion`: a focal length of 0", lambda _: vg.callbacks.SurfaceFusion([0.0, 50.0, 32.0, 24.0])),
    (
        "`with_depth_scale` of a text",
        lambda made: with_depth_scale(open_sequence(tiny_sequences.tum(made)), "5000"),
    ),
    ("`pack_batch` of no windows", lambda _: vg.batches.pack_batch([None])),
    ("frames that are a number", reconstruct(lambda: 5)),
    ("frames that are names of files", reconstruct(lambda: ["0.png", "1.png"])),
    ("images of numbers from 0 to 1", reconstruct(lambda: [IMAGES[0] / 255.0])),
    ("frames whose image is none", stream(lambda: [frame(0, image=None)])),
    ("frames whose image has numbers from 0 to 1", stream(lambda: [frame(0, image=IMAGES[0] / 255)])),
    ("depth in whole millimetres", stream(lambda: [(IMAGES[0], (DEPTH * 1000).astype(np.uint16))])),
    ("depth of complex numbers", stream(lambda: [(IMAGES[0], DEPTH.astype(complex))])),
    ("depth with a mask", stream(lambda: [(IMAGES[0], np.ma.masked_less(DEPTH, 3))])),
    ("depth of another size than its image", stream(lambda: [(IMAGES[0], DEPTH[:60])])),
    ("a frame whose depth is whole numbers", stream(lambda: [frame(0, depth=DEPTH.astype(int))])),
    ("depth that only later frames have", stream(lambda: [IMAGES[0], (IMAGES[1], DEPTH)])),
    ("two frames of one time", stream(lambda: [frame(0), frame(1, timestamp=0.0), frame(2)])),
    ("a time that is a text", stream(lambda: [frame(0, timestamp="0.0")])),
    ("two frames of one index", stream(lambda: [frame(0), frame(1, index=0)])),
    ("settings in a dictionary", reconstruct(settings={"window": 3})),
    ("a preset's name as roles", reconstruct(roles="classical")),
    ("intrinsics as the camera", reconstruct(camera=(100, 100, 80, 60))),
    ("a folder as checkpoints", reconstruct(checkpoints="out")),
    ("a function as a callback", reconstruct(callbacks=[print])),
    ("facts that JSON does not have", reconstruct(facts={"when": object()})),
    ("a fact whose name is a number", reconstruct(facts={1: 2})),
    ("a fact that every summary has", reconstruct(facts={"verdict": "good"})),
    ("warnings that are one text", reconstruct(warned="dark")),
    ("warnings that are a number", reconstruct(warned=5)),
    ("an image of 3.6 billion pixels", reconstruct(lambda: [np.broadcast_to(np.uint8(3), (60000, 60000, 3))])),
    ("checkpoints every `often`", lambda _: vg.Checkpoints("night.npz", every="often")),
    ("`evaluate`: `delta` that is a text", evaluated(delta="a")),
    ("`evaluate`: a word for `all_pairs`", evaluated(all_pairs="no")),
    ("`evaluate`: a letter for `vertical`", evaluated(vertical="z")),
    ("a camera resized to nothing", lambda _: vg.Camera((50, 50, 32, 24), 64, 48).resized(0, 0)),
    ("a seed that is none", reconstruct(seed=None)),
    ("a stride of one and a half", reconstruct(stride=1.5)),
    ("`run`: a stride of 0", lambda _: next(vg.run(IMAGES, stride=0))),
    ("`finish` of nothing", lambda _: vg.finish(None)),
    ("a trajectory whose times are dates", trajectory(np.array(["2024"], "M8[ns]"), [EYE])),
    ("a trajectory of complex numbers", trajectory([0], [EYE * (1 + 1j)])),
    ("a trajectory of transposed poses", trajectory([0], [(EYE + np.eye(4, k=3)).T])),
    ("a trajectory of nothing", trajectory(None, None)),
    ("`evaluate` of two arrays of poses", lambda _: vg.evaluate(EYE[None], EYE[None])),
    ("a camera of half a pixel", lambda _: vg.Camera((50, 50, 32, 24), 64.5, 48)),
    ("a cloud that float32 cannot hold", lambda folder: save_cloud(folder, 1e300)),
    ("`open_sequence` of nothing", lambda _: vg.open_sequence(None)),
    ("`read` of bytes", lambda _: vg.read(b"clip")),
    ("`open_sequence` at a rate that is a text", lambda folder: vg.open_sequence(bad.frames(folder / "a"), rate="30")),
    ("`load_problem`: lengths in a tenth of a micrometre", lambda made: vg.load_problem(bad.problem(**TINY)(made))),
    ("`load_problem`: terms that are a number", lambda made: vg.load_problem(bad.problem()(made), terms=3)),
    ("`read` of a name of 5,000 letters", lambda _: vg.read("a" * 5000)),
    ("`read` of half a letter of UTF-16", lambda _: vg.read("\ud800")),
    ("`evaluate` of a name with a zero byte", lambda _: vg.evaluate("a\0b", trajectory([0.0], [EYE])(_))),
    ("a window dataset of nothing", lambda _: vg.learning.WindowDataset.open(None)),
    ("a cloud of nothing", lambda _: PointCloud.load_ply(None)),
    ("a trajectory saved to nothing", lambda _: trajectory([0.0], [EYE])(_).save_tum(None)),
    ("checkpoints of nothing", lambda _: vg.Checkpoints(None)),
    ("a map of nothing", lambda _: vg.load_map(None)),
    ("a batch of nothing", lambda _: vg.bench(None, "runs/none")),
    ("a batch of one sequence, its name in no list", lambda _: vg.bench("quick", "runs/none", sequences="office")),
    ("a batch to nowhere", lambda _: vg.bench("quick", "")),
    ("`simulate`: frames that are a text", simulated("room", "3")),
    ("`simulate`: half a frame", simulated("room", 2.5)),
    ("`simulate`: a seed that is none", simulated("room", 3, None)),
    ("`simulate`: a size that is a text", simulated("room", 3, size="640x480")),
    ("`simulate`: a size of half pixels", simulated("room", 3, size=(160.5, 120))),
    ("`simulate`: a sensor's name", simulated("room", 3, sensor="kinect")),
    ("`cloud_error` of lists", lambda _: evaluation.cloud_error([[0, 0]], [[0, 0, 0]])),
    ("`cloud_error` of 200,000 equal points and none", lambda _: same_place(200_000, np.zeros((0, 3)))),
    ("`cloud_error` of points at 1e200", lambda _: evaluation.cloud_error(np.full((1, 3), 1e200), np.zeros((1, 3)))),
    ("`cloud_error` of complex numbers", lambda _: evaluation.cloud_error(np.ones((1, 3)) * 1j, np.zeros((1, 3)))),
    ("`cloud_error` of a `PointCloud`", lambda _: evaluation.cloud_error(CLOUD, CLOUD.points)),
    ("`cloud_error`: a threshold that is a text", lambda _: evaluation.cloud_error(EYE[:, :3], EYE[:, :3], "5 cm")),
    ("`mesh_error` of names of files", lambda _: evaluation.mesh_error("a.ply", "b.ply")),
    ("`mesh_error`: a threshold of a micrometre", lambda _: evaluation.mesh_error(TRIANGLE, TRIANGLE, 1e-6)),
    ("`surface_points` of faces in floats", lambda _: evaluation.surface_points((EYE[:, :3], np.zeros((1, 3))), 0.1)),
    ("`depth_error`: a mask of whole numbers", lambda _: evaluation.depth_error(DEPTH, DEPTH, mask=DEPTH.astype(int))),
    ("`depth_error` of nothing", lambda _: evaluation.depth_error(None, DEPTH)),
    ("`depth_of_cloud` of a camera's numbers", lambda _: evaluation.depth_of_cloud(EYE[:, :3], EYE, (50, 50, 32, 24))),
    ("`focal_error` of two numbers", lambda _: evaluation.focal_error((50, 50), (50, 50, 32, 24))),
    ("`scale_error` of a text", lambda _: evaluation.scale_error("1")),
    ("`umeyama` of points at 1e200", lambda _: evaluation.umeyama(np.full((4, 3), 1e200), np.zeros((4, 3)))),
    ("`associate` of nothing", lambda _: evaluation.associate(None, None)),
    ("`nearest_in_time` of times out of order", lambda _: evaluation.nearest_in_time([0.0], [1.0, 0.0], 0.1)),
    ("`consistency` of a number", lambda _: evaluation.consistency(1.0, 1.0)),
    ("rows of a trajectory that are not there", lambda _: trajectory([0.0], [EYE])(_).select([3])),
    ("a `PointCloud` of texts", lambda _: PointCloud("a", "b")),
    ("a `Mesh` whose colours are floats", lambda _: Mesh(EYE[:3, :3], np.zeros((1, 3), int), EYE[:3, :3], EYE[:3, :3])),
    ("a window dataset whose index counts -1", dataset(lambda place: index(place, windows=-1))),
    ("a window dataset whose index counts fewer", dataset(lambda place: index(place, windows=1))),
    ("a window dataset whose index counts more", dataset(lambda place: index(place, windows=5))),
    ("a window dataset of another version", dataset(lambda place: index(place, version=9))),
    ("a window whose labels are not there", dataset(lambda place: (place / "0000001.labels.npz").unlink())),
    ("a window whose labels are no archive", dataset(lambda place: (place / "0000001.labels.npz").write_text("x"))),
    ("a window whose labels are Python objects", dataset(objects)),
    ("a window whose labels have another shape", dataset(lambda place: labels(place, np.zeros(2)))),
    ("a window whose labels are 300 MB, packed", dataset(lambda place: labels(place, np.zeros(40_000_000)))),
    ("`batches` of a size that is a text", dataset(lambda place: None, lambda data: data.batches("2"))),
    ("`batches`: one number as a share", dataset(lambda place: None, lambda data: data.batches(1, share=1))),
    ("`batches`: -1 epochs", dataset(lambda place: None, lambda data: data.batches(1, epochs=-1))),
    ("a window of number `a`", dataset(lambda place: None, lambda data: data["a"])),
    ("`stack_windows` of no window", lambda _: vg.learning.stack_windows([])),
    ("`WindowWriter` into a folder that holds windows", dataset(written)),
    ("`WindowWriter`: a label that is an object", lambda folder: written(folder, poses=object())),
    ("depth in millimetres, in floats", stream(lambda: [(IMAGES[0], DEPTH * 1000), (IMAGES[1], DEPTH * 1000)])),
    ("depth that is infinite", stream(lambda: [(IMAGES[0], DEPTH * np.inf)])),
    ("an index that is a text", stream(lambda: [frame(0), frame(1, index="1")])),
    ("an index of 10^30", stream(lambda: [frame(0), frame(1, index=10**30)])),
    ("a time of 1e300", stream(lambda: [frame(0), frame(1, timestamp=1e300)])),
    ("images in one array, filled anew for each", as_they_were),
    ("a `Sequence` of one's own that fills one array anew", as_they_are_in_a_run),
    ("a name as alignment", lambda _: vg.Roles(alignment="icp")),
    ("`perception`: a number as folder", lambda _: vg.perception(folder=5)),
    ("`perception`: a name as mixture", lambda _: vg.perception(mixed="mlsd")),
    ("`perception`: a provider that is none", lambda _: vg.perception(provider="tpu")),
    ("`Sensor`: noise that is a text", lambda _: Sensor(noise="2")),
    ("`Sensor`: half a sample", lambda _: Sensor(blur_samples=2.5)),
    ("a `PointCloud` of nothing", lambda _: PointCloud(None, None)),
    ("a setting of 10^400", lambda _: vg.settings.WeightSettings(confidence_gain=10**400)),
    ("a number as matcher", lambda _: vg.Roles(points=5)),
    ("a name as depth", lambda _: vg.Roles(depth="moge2-small")),
    ("a confidence of one's own of another size", lambda _: next(vg.run(IMAGES, roles=vg.Roles(confidence=Half())))),
    ("a matcher of one's own that forgets to return", lambda _: next(vg.run(IMAGES, roles=vg.Roles(Forgetful())))),
    ("a result saved to nothing", lambda _: result().save(None)),
    ("a result of a trajectory", lambda _: vg.Result.of(fixed())),
    ("a result saved with depth of no such choice", lambda folder: result().save(folder / "r", depth="evry")),
    ("a result saved with a folder's name as frames", lambda folder: result().save(folder / "r", frames="clip")),
    ("a result saved with a setting that is an object", lambda made: result().save(made / "r", settings={"a": object})),
    ("a result saved to an empty name", lambda _: result().save("")),
    ("`export` to a list", lambda folder: export(folder, ["ply"])),
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
