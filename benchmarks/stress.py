"""Degrade clips, run them with the default settings, and count right results, reported failures and unreported wrong
results.

    .venv/bin/python benchmarks/stress.py [--clips corridor-office building-walk] [--scenes office] [--frames 60]
        [--groups a b] [--variants overlay30 ...] [--jobs 1] [--timeout 240] [--out runs/stress] [--page FILE.md]

Clips are degraded by `../shared/stress/make_variants.py` and are skipped where that file is missing; simulated scenes
by `vggtgeo/simulation/degradations.py`. Each run is one `vggtgeo run` in a separate process, which cannot see the
ground truth. Results that exist in `--out` are not computed again; `--fresh` runs all.

- good: ATE at most twice that of the undisturbed clip, or 4 cm; 90 % of the frames in `trajectory.txt`; verdict good.
- alarm: the same, but the verdict is degraded or failed.
- told: not so, and the verdict is degraded or failed. error: refused with a message.
- mild: between good and wrong, and the verdict is good. SILENT: wrong (three times, or 8 cm), and the verdict is good.
- crash, hang: the program crashed, or did not end in time.

The ATE is after SE(3) where the scale is metric, or doubtful; after Sim(3) where it is unknown.

The last column of the first table counts the good results of those variants that contain the information for a good
result (`WITHOUT_INFORMATION` lists the others).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from recordings import record, write

from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.simulation.degradations import DEGRADATIONS

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"
ORDER = ("good", "alarm", "mild", "told", "SILENT", "error", "crash", "hang")
MAX_TURN = 2.5
"""RMS rotation error from frame to frame, degrees, above which poses are wrong for any ATE."""


WITHOUT_INFORMATION = {
    "more than a tenth of the frames show nothing of the place, or another one": (
        *("black5", "black_first5", "black20", "black20_depth", "rgb_black20", "mirror", "rgb_mirror"),
        *("same_stamps", "kidnap_other"),
    ),
    "calibration, lens or depth are of another recording": (
        *("K_x2", "K_cx40", "rgb_K+20", "crop75_untold", "portrait_untold", "rgb_portrait_untold", "distorted"),
        *("rgb_distorted", "depth_1m", "depth_frozen", "depth_late3", "depth_x0.2", "depth_x5"),
    ),
    "nothing tells how far anything is": ("rotation_rgb", "rgb_still100"),
    "as much of the picture moves on its own, or with the camera, as stays": (
        *("occluder", "occluder_slow_big", "rgb_occluder", "overlay50"),
    ),
}
"""Variants for which no good result is possible, by the reason."""


@dataclass(frozen=True)
class Case:
    """A degraded recording: `make` writes it into a folder and returns this folder and the file of the ground truth."""

    source: str
    name: str
    make: Callable[[Path], tuple[Path, Path]]


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run. ATE in metres; given, written, tracked: numbers of frames, tracked those in
    `trajectory.txt`, which holds one part of a map with several parts.
    """

    source: str
    name: str
    code: int | None
    level: str = ""
    scale: str = ""
    ate_se3: float = float("nan")
    ate_sim3: float = float("nan")
    turn: float = float("nan")
    given: int = 0
    written: int = 0
    tracked: int = 0
    seconds: float = 0.0
    reasons: tuple[str, ...] = ()

    @property
    def ate(self) -> float:
        """Return the ATE that counts."""
        return self.ate_sim3 if self.scale.startswith("free") else self.ate_se3


def main() -> None:
    """Run the cases, and write the table."""
    options = _options()
    cases = [*_clip_cases(options), *_scene_cases(options)]
    if not cases:
        raise SystemExit("`--scenes` must name a scene where `../shared/stress` is missing, got none")
    options.out.mkdir(parents=True, exist_ok=True)
    done: list[Outcome] = []
    with ThreadPoolExecutor(options.jobs) as pool:
        for outcome in pool.map(lambda case: run_case(case, options), cases):
            done.append(outcome)
            print(row(outcome, judge(outcome, _base(done, outcome.source))), flush=True)
    text = _page(done)
    (options.out / "stress.md").write_text(text)
    if options.page:
        options.page.write_text(text)


def judge(outcome: Outcome, base: float) -> str:
    """Return the word for an outcome; base: ATE of the undisturbed recording, metres."""
    if outcome.code is None:
        return "hang"
    if outcome.code not in (0, 3):
        return "error" if outcome.code == 2 else "crash"
    told = outcome.level != "good"
    complete = outcome.written >= 0.98 * outcome.given and outcome.tracked >= 0.9 * outcome.written
    complete = complete and not outcome.turn > MAX_TURN
    if outcome.ate <= max(2 * base, 0.04) and complete:
        return "alarm" if told else "good"
    if told:
        return "told"
    return "mild" if complete and outcome.ate <= max(3 * base, 0.08) else "SILENT"


def run_case(case: Case, options: argparse.Namespace) -> Outcome:
    """Return the outcome of a case, which is kept in `options.out` and read there if it exists."""
    kept = options.out / f"{case.source}.{case.name}.json"
    if kept.is_file() and not options.fresh:
        return Outcome(**json.loads(kept.read_text()))
    work = options.out / f"{case.source}.{case.name}"
    shutil.rmtree(work, ignore_errors=True)
    folder, truth = case.make(work)
    began, said = time.perf_counter(), ""
    try:
        ended = subprocess.run(
            [options.program, "run", str(folder), "-o", str(work / "run"), "--dense", options.dense, "--quiet"],
            capture_output=True,
            text=True,
            timeout=options.timeout,
            check=False,
        )
        code: int | None = ended.returncode
        said = ended.stdout + ended.stderr
        (work / "log.txt").write_text(said)
    except subprocess.TimeoutExpired:
        code = None
    outcome = _measured(case, folder, truth, work / "run", code, time.perf_counter() - began)
    if outcome.code not in (0, 3) and said.strip():  # keep the last line of an error or a crash
        outcome = replace(outcome, reasons=(said.strip().splitlines()[-1],))
    kept.write_text(json.dumps(asdict(outcome)))
    if not options.keep:
        shutil.rmtree(work)
    return outcome


def _measured(case: Case, folder: Path, truth: Path, run: Path, code: int | None, seconds: float) -> Outcome:
    given = sum(1 for line in (folder / "rgb.txt").read_text().splitlines() if line.strip() and line[0] != "#")
    facts: dict[str, Any] = {"given": given, "seconds": seconds}
    if code in (0, 3) and (run / "summary.json").is_file():
        summary = json.loads((run / "summary.json").read_text())
        estimate, true = Trajectory.load_tum(run / "trajectory.txt"), Trajectory.load_tum(truth)
        facts |= trajectory_errors(estimate, true)
        facts |= {
            "level": summary["verdict"]["level"],
            "reasons": tuple(summary["verdict"]["reasons"]),
            "scale": summary["scale"],
            "written": summary["frames"],
            "tracked": len(estimate),
        }
    return Outcome(case.source, case.name, code, **facts)


def trajectory_errors(estimate: Trajectory, true: Trajectory) -> dict[str, float]:
    """Return the ATE after SE(3) and Sim(3), metres, and the turn; empty where too few frames have a pose."""
    try:
        report = evaluate_trajectory(estimate, true)
    except InputError:
        return {}
    return {
        "ate_se3": report.se3.statistics.rmse,
        "ate_sim3": report.sim3.statistics.rmse,
        "turn": float(np.degrees(report.relative.rotation_statistics.rmse)),
    }


def _clip_cases(options: argparse.Namespace) -> Iterator[Case]:
    script = SHARED / "stress" / "make_variants.py"
    if not script.is_file():
        print("clips are skipped: `../shared/stress/make_variants.py` is missing")
        return
    spec = importlib.util.spec_from_file_location("make_variants", script)
    assert spec is not None
    assert spec.loader is not None
    variants = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = variants
    spec.loader.exec_module(variants)
    for clip in options.clips:
        for name, (group, _, _) in variants.VARIANTS.items():
            chosen = name in options.variants if options.variants else not options.groups or group in options.groups
            if name == "base" or chosen:
                source = SHARED / "data" / clip
                make = lambda work, name=name, source=source: variants.make(
                    source, work, name, options.frames, options.start, options.seed
                )
                yield Case(clip, name, make)


def _scene_cases(options: argparse.Namespace) -> Iterator[Case]:
    for scene in options.scenes:
        for name, change in DEGRADATIONS.items():
            if options.variants and name != "base" and name not in options.variants:
                continue

            def make(work: Path, scene: str = scene, change: Any = change) -> tuple[Path, Path]:
                changed = change(record(scene, options.frames, options.seed), np.random.default_rng(options.seed))
                write(changed, work / "frames", work / "truth.txt")
                return work / "frames", work / "truth.txt"

            yield Case(f"simulated {scene}", name, make)


def _base(outcomes: list[Outcome], source: str) -> float:
    found = [outcome for outcome in outcomes if (outcome.source, outcome.name) == (source, "base")]
    return excused(found[0] if found else None)


def excused(base: Outcome | None) -> float:
    """Return the ATE of the undisturbed recording, metres; 1 cm where that run was wrong: it excuses nothing."""
    return base.ate if base is not None and base.level == "good" and base.ate < 0.1 else 0.01


def row(outcome: Outcome, word: str) -> str:
    """Return a row of the table."""
    reasons = "; ".join(outcome.reasons)
    reasons = reasons if len(reasons) < 160 else reasons[:157] + "..."
    name = f"**{word}**" if word in ("SILENT", "crash", "hang") else word
    return (
        f"| {outcome.source} | {outcome.name} | {name} | {outcome.level or '-'} | {100 * outcome.ate_se3:.1f} | "
        f"{100 * outcome.ate_sim3:.1f} | {outcome.tracked}/{outcome.given} | {reasons.replace('|', '/')} |"
    )


def _page(outcomes: list[Outcome]) -> str:
    words = [judge(outcome, _base(outcomes, outcome.source)) for outcome in outcomes]
    lines = [
        "# Degraded clips",
        "",
        "Written by `" + " ".join(["benchmarks/stress.py", *sys.argv[1:]]) + "`; the words are explained there.",
        "",
        "| source | cases | " + " | ".join(ORDER) + " | good where a good result is possible |",
        "|---" * (len(ORDER) + 3) + "|",
    ]
    for source in [*dict.fromkeys(outcome.source for outcome in outcomes), "all"]:
        own = [(o.name, w) for o, w in zip(outcomes, words, strict=True) if source in (o.source, "all")]
        count = Counter(word for _, word in own)
        there = [word for name, word in own if not any(name in names for names in WITHOUT_INFORMATION.values())]
        share = f"{there.count('good')} of {len(there)} ({there.count('good') / max(len(there), 1):.0%})"
        lines.append(f"| {source} | {len(own)} | " + " | ".join(str(count[w]) for w in ORDER) + f" | {share} |")
    lines += [
        "",
        "| source | variant | outcome | verdict | SE(3) cm | Sim(3) cm | tracked | reasons |",
        "|---" * 8 + "|",
    ]
    lines += [row(outcome, word) for outcome, word in zip(outcomes, words, strict=True)]
    return "\n".join(lines) + "\n"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", nargs="*", default=["corridor-office", "building-walk"])
    parser.add_argument("--scenes", nargs="*", default=["office"])
    parser.add_argument("--variants", nargs="*", default=[])
    parser.add_argument("--groups", nargs="*", default=[])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    add_run_options(parser, out="runs/stress", timeout=240.0, dense="auto")
    parser.add_argument("--page", type=Path, help="file to which the table is also written")
    return parser.parse_args()


def add_run_options(parser: argparse.ArgumentParser, out: str, timeout: float, dense: str) -> None:
    """Add the options that `run_case` reads."""
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--dense", default=dense, help="as for `vggtgeo run`; the verdict does not use the dense map")
    parser.add_argument("--timeout", type=float, default=timeout, help="seconds a run may take")
    parser.add_argument("--program", default=str(Path(sys.executable).parent / "vggtgeo"))
    parser.add_argument("--out", type=Path, default=Path(out))
    parser.add_argument("--keep", action="store_true", help="keep recordings and runs")
    parser.add_argument("--fresh", action="store_true", help="run cases again that have a result")


if __name__ == "__main__":
    main()
