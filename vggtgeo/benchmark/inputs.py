"""Open the input of a benchmark run: a recording or a rendered walk, its exact depth, and the perception roles."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock

from vggtgeo.benchmark.suite import WalkTable
from vggtgeo.datasets import Sequence, SequenceView, open_sequence, without_depth
from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.datasets.image_files import path_exists
from vggtgeo.datasets.tanks import TanksAndTemples
from vggtgeo.evaluation import nearest_in_time
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open
from vggtgeo.models.classical import ConstantVelocity, PnpGeometry
from vggtgeo.models.roles import InitialGeometry
from vggtgeo.models.window_locator import WindowLocator
from vggtgeo.report.map_scene import evenly_spaced
from vggtgeo.simulation import SimulatedOracle, simulate
from vggtgeo.simulation.degradations import DEGRADATIONS, Recording
from vggtgeo.simulation.stubs import SimulatedDino, SimulatedLetr, SimulatedMast3r, SimulatedMoge, SimulatedVggt
from vggtgeo.slam.run import default_roles
from vggtgeo.slam.settings.presets import Perception, perception
from vggtgeo.slam.settings.slam_settings import Roles

DATA_VARIABLE = "VGGTGEO_DATA"


def data_folders(given: Iterable[str | os.PathLike[str]] | None) -> tuple[Path, ...]:
    """Return the folders of recordings: `given`, else those in `$VGGTGEO_DATA` (separated by `:`), else `data`."""
    if given is not None:
        folders = tuple(Path(path).expanduser() for path in given)
        if files := [folder for folder in folders if not folder.is_dir()]:
            raise InputError(f"`data` must be a folder, got `{files[0]}`")
        return folders
    named = os.environ.get(DATA_VARIABLE, "data").split(os.pathsep)
    return tuple(Path(name).expanduser() for name in named if name and Path(name).expanduser().is_dir())


def find_sequences(path: str, folders: Iterable[Path]) -> list[Path]:
    """Return all existing `folder / path`, the preferred one first.

    Up to two levels of folders may be in between: one of the benchmark, one of the scene.
    """
    wanted = Path(path).expanduser()
    if wanted.is_absolute():
        return [wanted.resolve()] if path_exists(wanted) else []
    parents = [one for folder in folders for one in (folder, *sorted(folder.glob("*")), *sorted(folder.glob("*/*")))]
    return list(dict.fromkeys((parent / wanted).resolve() for parent in parents if path_exists(parent / wanted)))


@dataclass(frozen=True, eq=False)
class Input:
    """The input of a run.

    Fields: sequence; perception; exact, true depth and poses of an undegraded rendered walk or a recording with exact
    depth; scan, of a scanned scene; simulated, whether the sequence is rendered; references, other ground truths by
    name.
    """

    sequence: Sequence
    perception: Perception
    exact: SimulatedOracle | RecordedFrames | None = None
    scan: TanksAndTemples | None = None
    simulated: bool = False
    references: Mapping[str, Trajectory] = field(default_factory=dict)

    @property
    def truth(self) -> Trajectory | None:
        """The ground truth; None if unknown."""
        return self.sequence.ground_truth()


def open_input(spec: Mapping[str, Any], seed: int, scratch: Path | None = None) -> Input:
    """Open the input of a job (`Job.spec`); raise InputError if it is invalid, or a network's file is missing.

    scratch: private folder that keeps rendered walks for other runs.
    """
    if not spec["simulate"]:
        with_depth = spec["exact_depth"] or not spec["rgb_only"]
        recorded = open_sequence(spec["path"], spec["kind"], depth=with_depth)
        sequence = _with_hidden_inputs(recorded, spec)
        exact = RecordedFrames.of(recorded) if spec["exact_depth"] else None
        scan = recorded if isinstance(recorded, TanksAndTemples) else None
        # Read scan and references before the run, which may take hours, so that errors are found early.
        if scan is not None:
            scan.scanned_points()
        references = {name: Trajectory.load_tum(Path(spec["path"]) / file) for name, file in spec["references"].items()}
        return Input(sequence, _perception_of(spec, sequence.has_depth), exact, scan, references=references)
    (rendered, oracle), is_plain = _rendered(spec["simulate"], seed, scratch), spec["degrade"] == "base"
    if spec["perception"] == "simulated":
        if not is_plain:
            raise InputError(
                f"`degrade` must be 'base' for simulated roles, which use the undegraded images, got "
                f"{spec['degrade']!r}: leave it out, or use other roles"
            )
        return Input(rendered, Perception(simulated_roles(oracle, spec, seed), {}), oracle, simulated=True)
    sequence = _with_hidden_inputs(rendered if is_plain else degraded(rendered, spec["degrade"], seed), spec)
    return Input(sequence, _perception_of(spec, sequence.has_depth), oracle if is_plain else None, simulated=True)


def walk_name(simulate: Mapping[str, Any], seed: int) -> str:
    """Return the file name of a rendered walk in the scratch folder."""
    return hashlib.sha256(json.dumps([dict(simulate), seed], sort_keys=True).encode()).hexdigest()[:16] + ".walk"


def _rendered(table: Mapping[str, Any], seed: int, scratch: Path | None) -> tuple[RenderedWalk, SimulatedOracle]:
    """Return the walk of a suite's table `simulate`, from the scratch folder or rendered (0.25 s a frame)."""
    if scratch is None:
        return _render(table, seed)
    kept = scratch / walk_name(table, seed)
    with FileLock(kept.with_suffix(".lock")):  # several runs may need the same walk: one renders it
        if not kept.is_file():
            with atomic_open(kept, "wb") as stream:
                pickle.dump(_render(table, seed), stream, pickle.HIGHEST_PROTOCOL)
    with kept.open("rb") as stream:
        walk: tuple[RenderedWalk, SimulatedOracle] = pickle.load(stream)  # safe: written above, in a private folder
    return walk


def _render(table: Mapping[str, Any], seed: int) -> tuple[RenderedWalk, SimulatedOracle]:
    walk = WalkTable(**table)
    size = walk.size[0], walk.size[1]
    rendered = simulate(walk.scene, walk.frames, seed, size, rate=walk.rate, speed=walk.speed)
    oracle = SimulatedOracle(rendered, kept=walk.frames)
    recording = Recording(list(oracle.frames()), oracle.camera, oracle.ground_truth())
    return RenderedWalk(oracle.name, recording), oracle


@dataclass(frozen=True, eq=False)
class RenderedWalk:
    """A rendered walk in memory, so that a run's time excludes rendering: 3 MB per frame of 320 x 240.

    Of a degraded walk the camera is what a user would believe: it does not know of the degradation.
    """

    name: str
    recording: Recording

    @property
    def camera(self) -> Camera:
        return self.recording.camera

    @property
    def has_depth(self) -> bool:
        return self.recording.frames[0].depth is not None

    def __len__(self) -> int:
        return len(self.recording.frames)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """Yield the frames at positions start, start + stride, ... below end."""
        check_selection(self.name, len(self), start, end, stride)
        yield from self.recording.frames[start:end:stride]

    def ground_truth(self) -> Trajectory:
        return self.recording.truth


def degraded(walk: RenderedWalk, name: str, seed: int) -> RenderedWalk:
    """Apply the degradation `name` to a walk, with noise of the given seed."""
    changed = DEGRADATIONS[name](walk.recording, np.random.default_rng([seed, 23]))
    return RenderedWalk(f"{walk.name}, {name}", changed)


def simulated_roles(oracle: SimulatedOracle, spec: Mapping[str, Any], seed: int) -> Roles:
    """Return stubs of the five roles with their standard error models; the setting scales the depth errors."""
    moge, factor = SimulatedMoge(oracle, seed), spec["depth_errors"]
    starts: dict[str, InitialGeometry] = {
        "constant-velocity": ConstantVelocity(),
        "pnp": PnpGeometry(),
        "window": WindowLocator(SimulatedVggt(oracle, seed), PnpGeometry()),
    }
    return Roles(
        points=SimulatedMast3r(oracle, seed, count=spec["key_points"]),
        lines=SimulatedLetr(oracle, seed),
        depth=replace(moge, error=factor * moge.error, wobble=factor * moge.wobble),
        confidence=SimulatedDino(oracle, seed),
        geometry=starts[spec["start_of_pose"]],
        alignment=None,  # not in the paper, and it would hide the effect of the initial pose in the ablation
    )


def _with_hidden_inputs(sequence: Sequence, spec: Mapping[str, Any]) -> Sequence:
    """Return the sequence without the depth or the calibration that the spec hides."""
    if spec["rgb_only"]:
        sequence = without_depth(sequence)
    if not spec["calibrated"]:
        camera = Camera.guess(sequence.camera.width, sequence.camera.height)
        sequence = SequenceView(sequence, camera, sequence.has_depth)
    return sequence


def _perception_of(spec: Mapping[str, Any], has_depth: bool) -> Perception:
    if spec["perception"] == "simulated":
        raise InputError("`perception` must not be 'simulated' for a recording: it needs a sequence with `simulate`")
    names = {"points": spec["features"], "geometry": spec["start_of_pose"]}
    mixed = {role: name for role, name in names.items() if name not in ("sift", "pnp")}
    return perception(spec["perception"], default_roles(has_depth), mixed=mixed)


_DELAY = 0.005
"""Maximum time between a frame and its true pose, seconds; those of rendered sequences are simultaneous."""


@dataclass(frozen=True, eq=False)
class RecordedFrames:
    """Exact frames of a recording whose depth files are exact; `SimulatedOracle` has the same methods."""

    sequence: Sequence
    truth: Trajectory

    @classmethod
    def of(cls, sequence: Sequence) -> RecordedFrames | None:
        """Return the frames; None without depth or ground truth.

        Raises InputError for a distorted camera, since depth is compared in undistorted images.
        """
        truth = sequence.ground_truth()
        if truth is None or not sequence.has_depth:
            return None
        if sequence.camera.distorts:
            raise InputError(f"`exact_depth` must be false for `{sequence.name}`, whose camera has a distortion")
        return cls(sequence, truth)

    @property
    def camera(self) -> Camera:
        return self.sequence.camera

    def __len__(self) -> int:
        return len(self.sequence)

    def depth(self, index: int) -> np.ndarray:
        """Return the depth of the file; all NaN if it cannot be read."""
        frame = next(self.sequence.frames(index, index + 1), None)
        if frame is None or frame.depth is None:
            return np.full((self.camera.height, self.camera.width), np.nan)
        return frame.depth.astype(np.float64)

    def pose(self, index: int) -> np.ndarray:
        """Return the ground truth at the time of the frame."""
        frame = next(self.sequence.frames(index, index + 1), None)
        times = np.array([] if frame is None else [frame.timestamp])
        _, rows = nearest_in_time(times, self.truth.timestamps, _DELAY)
        return rigid.invert(self.truth.poses[rows])[0] if len(rows) else np.full((4, 4), np.nan)


ExactFrames = SimulatedOracle | RecordedFrames
"""Exact depth and poses by the frame's index in the sequence."""


def exact_cloud(frames: ExactFrames) -> np.ndarray:
    """Return world points of the visible surfaces, float64 [n, 3]: every fourth pixel of at most 30 frames."""
    step = 4
    fx, fy, cx, cy = frames.camera.intrinsics
    clouds = []
    for index in evenly_spaced(len(frames), 30):
        depth, pose = frames.depth(int(index))[::step, ::step], frames.pose(int(index))
        v, u = np.nonzero(np.isfinite(depth) & np.isfinite(pose).all())
        z = depth[v, u]
        local = np.column_stack([(step * u - cx) / fx * z, (step * v - cy) / fy * z, z])
        clouds.append((local - pose[:3, 3]) @ pose[:3, :3])
    return np.concatenate(clouds)
