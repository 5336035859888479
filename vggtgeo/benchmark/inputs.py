"""What a run looks at: the recording or the rendered walk, and the roles that perceive it."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.datasets import Sequence, SequenceView, open_sequence, without_depth
from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open
from vggtgeo.models.classical import ConstantVelocity, PnpGeometry
from vggtgeo.models.roles import InitialGeometry
from vggtgeo.models.stubs import SimulatedDino, SimulatedLetr, SimulatedMast3r, SimulatedMoge, SimulatedVggt
from vggtgeo.models.window_locator import WindowLocator
from vggtgeo.simulation import SimulatedOracle, simulate
from vggtgeo.slam.presets import Perception, classical_roles, perception
from vggtgeo.slam.settings import Roles

DATA_VARIABLE = "VGGTGEO_DATA"
_LEVELS = ("", "*", "*/*")
"""Folders between a data folder and a sequence in it: a benchmark's own, and a scene's."""


def data_folders(given: Iterable[str | os.PathLike[str]] | None) -> tuple[Path, ...]:
    """The folders that hold recordings: those given, else those of `$VGGTGEO_DATA` (with `:`), else `data`."""
    if given is not None:
        folders = tuple(Path(path).expanduser() for path in given)
        for folder in folders:
            if not folder.is_dir():
                raise InputError(f"`data` is `{folder}`, which is no folder")
        return folders
    named = os.environ.get(DATA_VARIABLE, "data").split(os.pathsep)
    return tuple(Path(name).expanduser() for name in named if name and Path(name).expanduser().is_dir())


def find_sequence(path: str, folders: Iterable[Path]) -> Path | None:
    """The first of `folder / path` that is there, also with one or two folders in between; None where none is."""
    wanted = Path(path).expanduser()
    if wanted.is_absolute():
        return wanted if wanted.exists() else None
    for folder in folders:
        for level in _LEVELS:
            parents = [folder] if not level else sorted(folder.glob(level))
            for parent in parents:
                if (parent / wanted).exists():
                    return (parent / wanted).resolve()
    return None


@dataclass(frozen=True, eq=False)
class Input:
    """sequence: what the run reads. perception: who looks at it. oracle: the exact truth of a rendered walk."""

    sequence: Sequence
    perception: Perception
    oracle: SimulatedOracle | None = None

    @property
    def truth(self) -> Trajectory | None:
        """The true poses, where they are known."""
        return self.sequence.ground_truth()


def open_input(spec: Mapping[str, Any], seed: int, scratch: Path | None = None) -> Input:
    """The input of a job (`Job.spec`). InputError where it cannot be read, or a network's file is missing.

    scratch: a folder of this user alone, where a walk that is rendered is kept for the next run on it.
    """
    if not spec["simulate"]:
        sequence = _without(open_sequence(spec["path"], spec["kind"]), spec)
        return Input(sequence, _perceived(spec, sequence.has_depth))
    rendered = _rendered(spec["simulate"], seed, scratch)
    if spec["perception"] == "simulated":
        return Input(rendered, Perception(simulated_roles(rendered.oracle, spec, seed), {}), rendered.oracle)
    sequence = _without(rendered, spec)
    return Input(sequence, _perceived(spec, sequence.has_depth), rendered.oracle)


def walk_name(simulate: Mapping[str, Any], seed: int) -> str:
    """The name of a rendered walk's file in the scratch folder."""
    return hashlib.sha256(json.dumps([dict(simulate), seed], sort_keys=True).encode()).hexdigest()[:16] + ".walk"


def _rendered(table: Mapping[str, Any], seed: int, scratch: Path | None) -> RenderedWalk:
    """The walk of a suite's table `simulate`; a quarter of a second a frame where it is not in the scratch folder."""
    kept = None if scratch is None else scratch / walk_name(table, seed)
    if kept is not None and kept.is_file():
        with kept.open("rb") as stream:
            walk: RenderedWalk = pickle.load(stream)  # written below, in a folder that no other user may write to
        return walk
    options = {**table}
    scene, frames = options.pop("scene", "office"), options.pop("frames", 60)
    size = tuple(options.pop("size", (640, 480)))
    try:
        oracle = SimulatedOracle(simulate(scene, frames, seed, size, **options), kept=frames)
    except TypeError as error:
        raise InputError(f"`simulate` in the suite: {error}") from None
    walk = RenderedWalk(oracle, tuple(oracle.frames()))
    if kept is not None:
        with atomic_open(kept, "wb") as stream:
            pickle.dump(walk, stream, pickle.HIGHEST_PROTOCOL)
    return walk


@dataclass(frozen=True, eq=False)
class RenderedWalk:
    """A `Sequence` whose frames lie ready, so that rendering is no part of the run. 3 MB a frame of 320 x 240."""

    oracle: SimulatedOracle
    rendered: tuple[Frame, ...]

    @property
    def name(self) -> str:
        return self.oracle.name

    @property
    def camera(self) -> Camera:
        return self.oracle.camera

    @property
    def has_depth(self) -> bool:
        return self.oracle.has_depth

    def __len__(self) -> int:
        return len(self.rendered)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """The frames at positions start, start + stride, ... below end."""
        check_selection(self.name, len(self), start, end, stride)
        yield from self.rendered[start:end:stride]

    def ground_truth(self) -> Trajectory:
        return self.oracle.ground_truth()


def simulated_roles(oracle: SimulatedOracle, spec: Mapping[str, Any], seed: int) -> Roles:
    """The five stubs with their standard error models; the depth's errors times what the setting says."""
    moge, factor = SimulatedMoge(oracle, seed), spec["depth_errors"]
    return Roles(
        points=SimulatedMast3r(oracle, seed, count=spec["key_points"]),
        lines=SimulatedLetr(oracle, seed),
        depth=replace(moge, error=factor * moge.error, wobble=factor * moge.wobble),
        confidence=SimulatedDino(oracle, seed),
        geometry=_start(spec["start_of_pose"], SimulatedVggt(oracle, seed)),
        alignment=None,  # the paper has none, and the ablation of its start would be none beside one
    )


def _start(name: str, vggt: SimulatedVggt) -> InitialGeometry:
    if name == "constant-velocity":
        return ConstantVelocity()
    return PnpGeometry() if name == "pnp" else WindowLocator(vggt, PnpGeometry())


def _without(sequence: Sequence, spec: Mapping[str, Any]) -> Sequence:
    """The sequence without what the spec hides."""
    if spec["rgb_only"]:
        sequence = without_depth(sequence)
    if not spec["calibrated"]:
        camera = Camera.guess(sequence.camera.width, sequence.camera.height)
        sequence = SequenceView(sequence, camera, sequence.has_depth)
    return sequence


def _perceived(spec: Mapping[str, Any], has_depth: bool) -> Perception:
    start = spec["start_of_pose"]
    if spec["perception"] == "simulated":
        raise InputError("`perception` is 'simulated', which needs a rendered walk: a sequence with `simulate`")
    return perception(spec["perception"], classical_roles(has_depth, start, spec["features"]))


def exact_cloud(oracle: SimulatedOracle, most: int = 30, step: int = 4) -> np.ndarray:
    """World points of the surfaces that the walk saw, float64 [n, 3]: every `step`-th pixel of `most` frames."""
    fx, fy, cx, cy = oracle.camera.intrinsics
    count = len(oracle.sequence)
    clouds = []
    for index in np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)):
        depth = oracle.depth(int(index))[::step, ::step]
        v, u = np.nonzero(np.isfinite(depth))
        z = depth[v, u]
        local = np.column_stack([(step * u - cx) / fx * z, (step * v - cy) / fy * z, z])
        pose = np.linalg.inv(oracle.pose(int(index)))
        clouds.append(local @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(clouds)
