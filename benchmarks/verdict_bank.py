"""Make the set of simulated runs on which the verdict's thresholds are chosen, and validated.

    .venv/bin/python benchmarks/verdict_bank.py make [--out runs/verdict-bank] [--count 420] [--jobs 1]
    .venv/bin/python benchmarks/verdict_bank.py judge [--out runs/verdict-bank] [--saved] [--judge MODULE]

`make` runs SLAM and keeps the inputs of the verdict; runs that exist are not made again. `judge` computes the verdict
of each run again, in a second or so, and prints how many wrong results it reports (recall) and how many right ones it
doubts (alarms), each with its Wilson interval of 95 %.

Half of the runs are healthy: they have only the errors of real cameras and calibrations (`CameraErrors`). The others
also have one fault of a random severity (`FAULTS`). The outcome is that of `benchmarks/stress.py` by the ground truth:
good, mild or wrong, independent of the fault. The halves "set" and "validate" share no seed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import multiprocessing
import os
import pickle
import shutil
import warnings
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal
from unittest import mock

import numpy as np
from scipy.stats import binomtest
from stress import Outcome, trajectory_errors
from stress import judge as outcome_of
from verdict_faults import FAULTS, HEALTHY, OF_DEPTH, OF_STREAM, WITHOUT_DEPTH, CameraErrors, Given, Walk, rendered

import vggtgeo as vg
from vggtgeo.benchmark.inputs import RenderedWalk
from vggtgeo.compilation.process_settings import in_double_precision, program_settings
from vggtgeo.datasets.views import SequenceView
from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.results import reconstruction
from vggtgeo.simulation import WORLDS
from vggtgeo.simulation.degradations import Recording, without_depth
from vggtgeo.slam.run import frame_trajectory
from vggtgeo.slam.state import Slam

HALVES: dict[str, int] = {"set": 1000, "validate": 5000}
"""First seed of each half; both have fewer than 1000 walks."""
WALKS = 24
"""Walks of a half: four in each of the six worlds. Runs of one walk differ in errors and faults."""
MAPPED_BY_IMAGES = ("office", "hall", "staircase", "building")
"""Worlds of the runs without depth. In the others such small pictures show one wall at a time, or too little to match,
and a run without a map does not test a verdict on maps."""
VERDICT = "vggtgeo.slam.verdict.judge"
"""Module of the function `judge`."""
BASE = 0.01
"""ATE of a base run that excuses nothing, metres (`stress.excused`)."""


@dataclass(frozen=True)
class Case:
    """One run of the bank; `half` and `number` determine everything about it."""

    half: Literal["set", "validate"]
    number: int
    degradation: str
    severity: float
    rgb_only: bool
    walk: Walk

    @property
    def name(self) -> str:
        """Return the name of its folder."""
        return f"{self.half}-{self.number:03d}-{self.degradation}{'-rgb' if self.rgb_only else ''}"

    @property
    def rng(self) -> np.random.Generator:
        """Return the random generator of this run."""
        return np.random.default_rng([HALVES[self.half], self.number, 43])

    def as_dict(self) -> dict[str, Any]:
        """Return the content of `case.json`."""
        walk = asdict(self.walk)
        kept = {key: walk.pop(key) for key in ("world", "seed", "frames", "size")}
        own = {key: value for key, value in asdict(self).items() if key != "walk"}
        return {**own, **kept, "walk": walk, "camera_errors": asdict(CameraErrors.drawn(self.rng))}


def main() -> None:
    """Make the bank, or compute its verdicts."""
    options = _options()
    if options.command == "make":
        make(options)
    else:
        text = table(judged(options.out, options.half, options.saved, options.judge, options.verbose))
        print(text)
        if options.page:
            options.page.write_text(text + "\n")


# ---------------------------------------------------------------------------------------------------------- the cases
def cases(count: int) -> list[Case]:
    """Return `count` cases, alternating between the halves, so that the first ones already contain all kinds."""
    halves = [_cases_of(half) for half in HALVES]
    return [next(halves[number % 2]) for number in range(count)]


def _cases_of(half: str) -> Iterator[Case]:
    worlds = list(WORLDS)
    walks = [Walk.drawn(worlds[k % len(worlds)], HALVES[half] + k) for k in range(WALKS)]
    rng = np.random.default_rng([HALVES[half], 47])
    faults = np.random.default_rng(47).permutation([name for name in FAULTS if name != HEALTHY])
    # The halves begin at opposite ends of the list, so that the first runs of both together have all faults.
    offset = list(HALVES).index(half) * len(faults) // 2
    number = 0
    while True:
        for place in rng.permutation(WALKS):
            images_alone = bool(rng.random() < 0.6) and walks[place].world in MAPPED_BY_IMAGES
            severity = float(rng.uniform())
            degradation = HEALTHY
            if number % 2:
                degradation = str(faults[(number // 2 + offset) % len(faults)])
            rgb_only = degradation in WITHOUT_DEPTH or (degradation not in OF_DEPTH and images_alone)
            yield Case(half, number, degradation, severity, rgb_only, walks[place])
            number += 1


def record(case: Case, render: Callable[[Walk], Recording]) -> Recording:
    """Simulate what the run of a case reads, with the ground truth."""
    rng = case.rng
    errors = CameraErrors.drawn(rng)
    perfect = render(case.walk)
    if case.degradation in WITHOUT_DEPTH:
        moved = errors.of_motion(FAULTS[case.degradation](Given(perfect, case.walk, case.severity, rng, render)))
    else:
        seen = lambda walk: errors.of_motion(render(walk))
        moved = seen(case.walk)
        if case.degradation not in OF_STREAM:
            moved = FAULTS[case.degradation](Given(moved, case.walk, case.severity, rng, seen))
    recording = errors.of_sensors(moved, rng)
    if case.degradation in OF_STREAM:
        recording = FAULTS[case.degradation](Given(recording, case.walk, case.severity, rng, render))
    return without_depth(recording, rng) if case.rgb_only else recording


@dataclass(frozen=True)
class RenderedWalks:
    """Render walks once and keep them in a folder."""

    folder: Path

    def __call__(self, walk: Walk) -> Recording:
        values = json.dumps(asdict(walk), sort_keys=True)
        path = self.folder / f"{walk.world}-{walk.seed}-{zlib.crc32(values.encode()):08x}.pkl"
        if path.is_file():
            return pickle.loads(path.read_bytes())
        recording = rendered(walk)
        self.folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}")
        part.write_bytes(pickle.dumps(recording))
        part.replace(path)
        return recording


# ------------------------------------------------------------------------------------------------------------ the runs
def make(options: argparse.Namespace) -> None:
    """Run the cases that have no result yet."""
    todo = [case for case in cases(options.count) if not (options.out / case.name / "outcome.json").is_file()]
    print(f"{options.count - len(todo)} of {options.count} runs exist", flush=True)
    if options.jobs == 1:
        _run_all(todo, options.out)
        return
    # JAX's threads do not survive a fork.
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
        parts = [pool.submit(_run_all, todo[job :: options.jobs], options.out) for job in range(options.jobs)]
        for part in parts:
            part.result()


def _run_all(todo: list[Case], out: Path) -> None:
    walks = RenderedWalks(out.with_name(out.name + "-walks"))
    for case in todo:
        print(run(case, walks, out), flush=True)


def run(case: Case, render: Callable[[Walk], Recording], out: Path) -> str:
    """Run a case, keep the inputs of its verdict, and return a line about it; its folder appears only when complete."""
    recording = record(case, render)
    part = out / f".{case.name}.{os.getpid()}"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    sequence = SequenceView(RenderedWalk(case.name, recording), recording.camera, not case.rgb_only)
    judged_by: list[tuple[Any, ...]] = []
    judge = reconstruction.judge_or_report

    def noting(*arguments: Any) -> vg.Verdict:
        judged_by.append(arguments)
        return judge(*arguments)

    facts: dict[str, Any] = {}
    with warnings.catch_warnings(), mock.patch.object(reconstruction, "judge_or_report", noting):
        warnings.simplefilter("ignore")
        try:
            result = vg.reconstruct(sequence, options=vg.RunOptions(dense="none"))
            slam, evidence, of_input = judged_by[0]
            for name, value in (("slam", slam), ("evidence", list(evidence)), ("input", of_input)):
                (part / f"{name}.pkl").write_bytes(pickle.dumps(value))
            facts = _facts(result, slam, recording)
        except InputError as error:
            facts = {"outcome": "error", "reasons": [str(error)]}
    errors = facts.pop("errors", np.full(len(recording.frames), np.nan))
    truth = recording.truth
    np.savez(
        part / "truth.npz",
        poses=truth.poses,
        frames=np.array([frame.index for frame in recording.frames]),
        timestamps=truth.timestamps,
        errors=errors,
        intrinsics=render(case.walk).camera.intrinsics,
    )
    given = {"healthy": case.degradation == HEALTHY, "given_frames": len(recording.frames)}
    (part / "case.json").write_text(json.dumps({**case.as_dict(), **given, **facts}, indent=1))
    (part / "outcome.json").write_text(json.dumps(facts, indent=1))
    shutil.rmtree(out / case.name, ignore_errors=True)
    part.replace(out / case.name)
    ate = facts.get("ate", float("nan"))
    return f"{case.name}: {facts['outcome']}, {100 * ate:.1f} cm, {facts.get('level')}: {facts.get('reasons')}"


def _facts(result: vg.Result, slam: Slam, recording: Recording) -> dict[str, Any]:
    estimate = frame_trajectory(slam) if slam.keyframes else Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    outcome = Outcome(
        "bank",
        "run",
        0,
        level="good",  # so that the outcome depends on the ground truth only
        scale=result.summary["scale"],
        given=len(recording.frames),
        written=result.summary["frames"],
        tracked=len(estimate),
        **trajectory_errors(estimate, recording.truth),
    )
    word = outcome_of(outcome, BASE)
    return {
        "outcome": "wrong" if word == "SILENT" else word,
        "ate": outcome.ate,
        "ate_se3": outcome.ate_se3,
        "ate_sim3": outcome.ate_sim3,
        "turn": outcome.turn,
        "scale": outcome.scale,
        "written": outcome.written,
        "tracked": outcome.tracked,
        "level": result.verdict.level,
        "reasons": list(result.verdict.reasons),
        "path": float(np.linalg.norm(np.diff(recording.truth.poses[:, :3, 3], axis=0), axis=1).sum()),
        "errors": _frame_errors(estimate, recording, outcome.scale.startswith("free")),
    }


def _frame_errors(estimate: Trajectory, recording: Recording, with_scale: bool) -> np.ndarray:
    """Return the position error of each frame after the alignment of all, metres; NaN without a pose."""
    rows = {round(frame.timestamp, 6): row for row, frame in enumerate(recording.frames)}
    own = np.array([rows[round(float(time), 6)] for time in estimate.timestamps], int)
    errors = np.full(len(recording.frames), np.nan)
    if len(own) > 2:
        there, true = estimate.poses[:, :3, 3], recording.truth.poses[own, :3, 3]
        errors[own] = np.linalg.norm(umeyama(there, true, with_scale).points(there) - true, axis=1)
    return errors


# --------------------------------------------------------------------------------------------------------- the verdicts
@dataclass(frozen=True)
class Judged:
    """A run and its verdict. outcome: by the ground truth."""

    half: str
    degradation: str
    rgb_only: bool
    outcome: str
    level: str
    reasons: tuple[str, ...]
    name: str


def judged(
    out: Path, half: str | None = None, saved: bool = False, module: str = VERDICT, verbose: bool = False
) -> list[Judged]:
    """Return every run in the bank, with its verdict computed again, or, where `saved`, as the run gave it."""
    judge = in_double_precision(importlib.import_module(module).judge)
    found = []
    for folder in sorted(path.parent for path in out.glob("[!.]*/outcome.json")):
        case, outcome = (json.loads((folder / name).read_text()) for name in ("case.json", "outcome.json"))
        if outcome["outcome"] == "error" or (half and case["half"] != half):
            continue
        # A run without a map is wrong, but nobody takes it for a right one: it does not count for the recall.
        word = outcome["outcome"] if np.isfinite(outcome["ate"]) else NO_MAP
        level, reasons = outcome["level"], outcome["reasons"]
        if not saved:
            slam, evidence, of_input = (read(folder / f"{name}.pkl") for name in ("slam", "evidence", "input"))
            with warnings.catch_warnings(), program_settings():
                warnings.simplefilter("ignore")
                verdict = judge(slam, evidence, of_input)
            level, reasons = verdict.level, verdict.reasons
        one = Judged(
            *(case["half"], case["degradation"], case["rgb_only"], word, level, tuple(reasons)),
            folder.name,
        )
        found.append(one)
        if verbose and (one.level == "good") == (one.outcome in ("wrong", NO_MAP)):
            print(f"{one.name}: {one.outcome}, {one.level}: {'; '.join(one.reasons)[:300]}", flush=True)
    return found


class _Unpickler(pickle.Unpickler):
    """Read banks that were made before a module was renamed."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the class of this name from its present module."""
        return super().find_class(MOVED.get((module, name), module), name)


MOVED = {
    ("vggtgeo.geometry.cameras", "Camera"): "vggtgeo.geometry.camera",
    ("vggtgeo.geometry.cameras", "Pinhole"): "vggtgeo.geometry.camera_models",
    ("vggtgeo.slam.sparse_map.keyframe_images", "CompressedImage"): "vggtgeo.slam.sparse_map.keyframe",
    ("vggtgeo.slam.sparse_map.keyframe_images", "KeyframeImages"): "vggtgeo.slam.sparse_map.keyframe",
}


def read(path: Path) -> Any:
    """Read what `make` kept. Fields that a bank of an older version lacks get their default values."""
    with path.open("rb") as file:
        kept = _Unpickler(file).load()
    for keyframe in kept.keyframes if isinstance(kept, Slam) else ():
        for slots in (keyframe.points, keyframe.samples):
            if not hasattr(slots, "estimate_sigma"):
                object.__setattr__(slots, "estimate_sigma", np.full(slots.inverse_depth.shape, np.nan))
    return kept


def table(runs: list[Judged]) -> str:
    """Return the recall of wrong results, alarms on right ones, and how many mild ones are reported, with intervals."""
    lines = [
        "| half | degradation | runs | wrong, reported | right, doubted | mild, reported | without a map, reported |",
        "|---|---|---|---|---|---|---|",
    ]
    for half in HALVES:
        own = [one for one in runs if one.half == half]
        groups: dict[str, list[Judged]] = {
            "all": own,
            "with depth": [one for one in own if not one.rgb_only],
            "without depth": [one for one in own if one.rgb_only],
        }
        by_degradation = defaultdict(list)
        for one in own:
            by_degradation[one.degradation].append(one)
        for name, group in {
            **groups,
            **{name: by_degradation[name] for name in FAULTS if name in by_degradation},
        }.items():
            cells = (share([one.level != "good" for one in group if one.outcome == word]) for word in OUTCOMES)
            lines.append(f"| {half} | {name} | {len(group)} | {' | '.join(cells)} |")
    return "\n".join(lines)


NO_MAP = "no map"
OUTCOMES = ("wrong", "good", "mild", NO_MAP)


def share(hits: list[bool]) -> str:
    """Return `hits` of all as text, with the Wilson interval of 95 %."""
    if not hits:
        return "-"
    interval = binomtest(sum(hits), len(hits)).proportion_ci(method="wilson")
    mean = 100 * sum(hits) / len(hits)
    return f"{sum(hits)} of {len(hits)}: {mean:.1f} % ({100 * interval.low:.1f} to {100 * interval.high:.1f})"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    making, judging = commands.add_parser("make", help="run SLAM"), commands.add_parser("judge", help="print the table")
    for command in (making, judging):
        command.add_argument("--out", type=Path, default=Path("runs/verdict-bank"))
    making.add_argument("--count", type=int, default=420, help="runs in both halves together")
    making.add_argument("--jobs", type=int, default=1, help="processes; each runs many cases")
    judging.add_argument("--saved", action="store_true", help="use the verdicts that the runs gave")
    judging.add_argument("--judge", default=VERDICT, help="module with the function `judge`")
    judging.add_argument("--half", choices=HALVES, help="only this half")
    judging.add_argument("--verbose", action="store_true", help="print each run whose verdict is not right")
    judging.add_argument("--page", type=Path, help="file to which the table is also written")
    return parser.parse_args()


if __name__ == "__main__":
    main()
