"""Check a recording before a run: times, images, depth and ground truth of a sample of its frames."""

import itertools
import os
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.frame import Frame, Sequence
from vggtgeo.datasets.kitti import Kitti
from vggtgeo.datasets.opening import open_sequence
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning, NoteWarning

SAMPLES = 20
"""Number of frames that are decoded."""
PLAUSIBLE_MEDIAN_DEPTH = (0.5, 6.5)
"""Metres, indoors; a wrong unit is mostly outside. The verdict uses it, too."""
_MIN_DEPTH_SHARE = 0.2
"""Share of pixels; depth cameras give 0.5 to 0.9 indoors."""
_DARK = 8.0
"""Mean grey level."""
_GAP = 5.0
"""Times the median step between two frames."""
_FAST, _FAST_CAR = 5.0, 60.0
"""Metres a second between two poses of the ground truth: faster than a hand or small drone, and than a car."""


@dataclass(frozen=True)
class Inspection:
    """Fields: facts, lines that describe the recording. problems, what is wrong or doubtful; empty for none."""

    facts: tuple[str, ...]
    problems: tuple[str, ...]


def inspect(path: str | os.PathLike[str], kind: str | None = None) -> Inspection:
    """Inspect a recording by a sample of its frames; problems are returned, not raised."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        try:
            sequence = open_sequence(path, kind)
            missing, readable = _without_missing(sequence)
            count = len(readable)
            # A live camera has no length: its first frames are taken.
            frames = list(readable.frames(0, None if count else SAMPLES, max(count // SAMPLES, 1)))
            truth = sequence.ground_truth()
        except InputError as error:
            return Inspection((), (*_problem_texts(caught), str(error)))
    notes = tuple(str(one.message) for one in caught if issubclass(one.category, NoteWarning))
    problems = [
        *_problem_texts(caught),
        *missing,
        *_image_problems(frames),
        *_time_problems(frames, len(sequence)),
        *_depth_problems(sequence, frames),
    ]
    problems += _truth_problems(truth, frames, _FAST_CAR if isinstance(sequence, Kitti) else _FAST)
    if not sequence.camera.known and not any("intrinsics" in text for text in problems):
        problems.append("the intrinsics are a guess; pass --intrinsics, or write them into calibration.txt")
    return Inspection((*_facts(sequence, frames, truth), *dict.fromkeys(notes)), tuple(dict.fromkeys(problems)))


def _without_missing(sequence: Sequence) -> tuple[list[str], Sequence]:
    """Return messages about listed files that are missing, and the sequence without them."""
    if not isinstance(sequence, FolderSequence):
        return [], sequence
    listed = (path for file in sequence.files for path in (file.image, file.depth) if path is not None)
    gone = {path for path in listed if not sequence.holds(path)}
    files = tuple(
        replace(file, depth=None if file.depth in gone else file.depth)
        for file in sequence.files
        if file.image not in gone
    )
    messages = [f"{len(gone)} listed files do not exist, first `{min(gone)}`"] if gone else []
    return messages, replace(sequence, files=files)


def _problem_texts(caught: Iterable[warnings.WarningMessage]) -> list[str]:
    """Return the texts of the warnings, without notes: these report no problem."""
    problems = (one for one in caught if issubclass(one.category, InputWarning))
    return [str(one.message) for one in problems if not issubclass(one.category, NoteWarning)]


def _facts(sequence: Sequence, frames: list[Frame], truth: Trajectory | None) -> tuple[str, ...]:
    camera = sequence.camera
    focal = f"f = {camera.intrinsics[0]:.1f}, {camera.intrinsics[1]:.1f}"
    coefficients = ", ".join(f"{value:g}" for value in camera.distortion)
    kind = "a fisheye of" if camera.fisheye else "distorted by"
    lens = f"{kind} {coefficients}" if camera.distorts else "no distortion"
    facts = [
        f"reader: {type(sequence).__name__}",
        f"{len(sequence)} frames of {camera.width} x {camera.height}",
        f"camera: {focal}, centre {camera.intrinsics[2]:.1f}, {camera.intrinsics[3]:.1f}, {lens}",
    ]
    if len(frames) > 1 and frames[-1].index > frames[0].index:
        seconds = frames[-1].timestamp - frames[0].timestamp
        rate = (frames[-1].index - frames[0].index) / seconds if seconds > 0 else np.nan
        facts.append(f"{rate:.1f} frames a second")
    depths = [frame.depth[np.isfinite(frame.depth)] for frame in frames if frame.depth is not None]
    known = np.concatenate(depths) if depths else np.zeros(0)
    if len(known):
        low, middle, high = np.quantile(known, (0.02, 0.5, 0.98))
        facts.append(f"depth {low:.2f} to {high:.2f} m, half of it below {middle:.2f} m")
    else:
        facts.append("no depth: the scale is unknown")
    facts.append("no ground truth" if truth is None else f"ground truth: {len(truth)} poses, path {truth.length:.2f} m")
    return tuple(facts)


def _image_problems(frames: list[Frame]) -> list[str]:
    if not frames:
        return ["no frame can be read"]
    dark = sum(float(frame.image.mean()) < _DARK for frame in frames)
    problems = [f"{dark} of {len(frames)} sampled images are black"] if dark else []
    return [*problems, *_repeat_problems([frame.image for frame in frames], "images")]


def _repeat_problems(images: list[np.ndarray], what: str) -> list[str]:
    same = sum(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in itertools.pairwise(images))
    return [f"{same} of {len(images)} sampled {what} equal the previous one: was the recorder frozen?"] if same else []


def _time_problems(frames: list[Frame], count: int) -> list[str]:
    times = np.array([frame.timestamp for frame in frames])
    if not np.isfinite(times).all():
        return [f"frame {frames[int(np.argmin(np.isfinite(times)))].index} has no time (a NaN or an infinity)"]
    steps = np.diff(times)
    if not len(steps):
        return []
    if (steps <= 0).any():
        return ["times do not increase from frame to frame"]
    steps = steps / np.diff([frame.index for frame in frames])
    middle = float(np.median(steps))
    problems = []
    if steps.max() > _GAP * middle:
        row = int(steps.argmax())
        where = f"between frames {frames[row].index} and {frames[row + 1].index}"
        problems.append(f"{where} the time step is {steps.max() / middle:.0f} times the median: frames are missing")
    if middle > 1.0 and count > 2:
        problems.append(f"frames are {middle:.1f} s apart: too far to be tracked, or the times have a wrong unit")
    return problems


def _depth_problems(sequence: Sequence, frames: list[Frame]) -> list[str]:
    if not sequence.has_depth:
        return []
    depths = [frame.depth for frame in frames if frame.depth is not None and np.isfinite(frame.depth).any()]
    if not depths:
        return ["none of the sampled depth images has a valid pixel"]
    problems = []
    share = float(np.mean([np.isfinite(depth).mean() for depth in depths]))
    if share < _MIN_DEPTH_SHARE:
        problems.append(f"only {100 * share:.0f} % of the pixels have depth")
    middle = float(np.median(np.concatenate([depth[np.isfinite(depth)][::7] for depth in depths])))
    if not PLAUSIBLE_MEDIAN_DEPTH[0] <= middle <= PLAUSIBLE_MEDIAN_DEPTH[1]:
        problems.append(f"the median depth is {middle:.3g} m: is the unit of the depth files wrong?")
    return [*problems, *_repeat_problems(depths, "depth images")]


def _truth_problems(truth: Trajectory | None, frames: list[Frame], fast: float) -> list[str]:
    if truth is None or not frames or len(truth) < 2:
        return []
    times = np.array([frame.timestamp for frame in frames])
    within = (times >= truth.timestamps[0] - 0.05) & (times <= truth.timestamps[-1] + 0.05)
    if not within.any():
        return ["no frame lies within the times of the ground truth: the clocks differ"]
    problems = []
    if within.mean() < 0.9:
        share = 100 * (1 - within.mean())
        problems.append(f"{share:.0f} % of the sampled frames lie outside the times of the ground truth")
    speed = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1) / np.diff(truth.timestamps)
    if speed.max() > fast:
        row = int(speed.argmax())
        when = f"{truth.timestamps[row]:.2f} s"
        problems.append(f"the ground truth moves at {speed.max():.0f} m/s at {when}: a jump, or a wrong unit")
    return problems
