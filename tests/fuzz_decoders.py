"""Fuzzing of what is decoded in C (`decoders.py`): files damaged at random, read in a process that they may end.

    make fuzz-decoders TIME=60                                   60 seconds of each
    .venv/bin/python tests/fuzz_decoders.py TIFF "video mp4 mp4v" --seconds 600 --seed 5

Oracle: the file is read, or `InputError` says why not. Another exception, a signal, more than `SECONDS` or more than
`MEGABYTES` beyond what the libraries take is told once for each place, and the file is kept in
`.cache/fuzz/findings/`. Exit code 1 where there is one. A finding becomes a test (`test_decoder_findings.py`).
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests" / "helpers"))
FINDINGS = ROOT / ".cache" / "fuzz" / "findings"
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None  # where the files lie: not on a disk, which is slower
SECONDS, MEGABYTES = 20, 1500
REPORTED = 20
"""Files between two writings of the counts."""
EXTREMES = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**63 - 1)
"""Values that sizes and offsets in headers are set to."""


def struck(content: bytes, rng: np.random.Generator) -> bytes:
    """One to three extreme numbers of 1 to 8 bytes written over the file, mostly where headers are."""
    changed = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        width = int(rng.choice([1, 2, 4, 8]))
        order = ["little", "big"][int(rng.integers(2))]
        value = EXTREMES[int(rng.integers(len(EXTREMES)))] % 2 ** (8 * width)
        near = len(changed) if rng.random() < 0.5 else min(256, len(changed))
        place = int(rng.integers(0, max(near - width, 1)))
        if rng.random() < 0.25:  # headers of TIFF are at the end
            place = max(len(changed) - width - place, 0)
        changed[place : place + width] = value.to_bytes(width, order)  # type: ignore[arg-type]
    return bytes(changed)


def damaged_files(whole: bytes, seed: int) -> Iterator[bytes]:
    """Without end."""
    from test_mutated_files import damaged

    number = 0
    while True:
        rng = np.random.default_rng([seed, number])
        yield (struck if number % 2 else damaged)(whole, rng)
        number += 1


def child(name: str, seed: int, seconds: float, place: Path, count: int | None = None) -> None:
    """Reads damaged files until the time is over, and writes what was counted; a signal may end it."""
    from decoders import ANY

    from vggtgeo.io.errors import InputError

    kind, file = ANY[name], place / ANY[name].file
    whole = kind.content(place)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(whole)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        kind.read(file)
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEGABYTES * 2**20, resource.RLIM_INFINITY))
    signal.signal(signal.SIGPROF, signal.SIG_DFL)  # of the processor's time: the machine may be busy, or stop us
    told: dict[str, Any] = {"executions": 0, "refused": 0, "findings": {}, "worst": 0.0}
    end = time.monotonic() + seconds
    for number, content in enumerate(damaged_files(whole, seed)):
        if time.monotonic() > end or number == count:
            break
        file.write_bytes(content)
        began = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                kind.read(file)
        except InputError as error:
            told["refused"] += 1
            if str(place) not in str(error) and kind.file not in str(error):
                _keep(told, f"a sentence without the file's name: {error}"[:150], str(error), content, name)
        except Exception as error:  # noqa: BLE001 - whatever it is, it is a finding
            places = [part for part in traceback.extract_tb(error.__traceback__) if "/vggtgeo/" in part.filename]
            places += [part for part in traceback.extract_tb(error.__traceback__) if "/models/" in part.filename]
            where = f"{Path(places[-1].filename).name}:{places[-1].lineno}" if places else "?"
            _keep(told, f"{type(error).__name__} at {where}", str(error), content, name)
        signal.setitimer(signal.ITIMER_PROF, 0)
        told["executions"] += 1
        told["worst"] = max(told["worst"], time.process_time() - began)
        if number % REPORTED == 0:
            (place / "told.json").write_text(json.dumps(told))
    (place / "told.json").write_text(json.dumps(told))


def _keep(told: dict[str, Any], what: str, message: str, content: bytes, name: str) -> None:
    if what not in told["findings"]:
        told["findings"][what] = f"{message[:200]} ({kept(content, name)})"


def kept(content: bytes, name: str) -> str:
    """The name under which a file is kept."""
    import hashlib

    FINDINGS.mkdir(parents=True, exist_ok=True)
    path = FINDINGS / f"{name.replace(' ', '-')}-{hashlib.sha256(content).hexdigest()[:12]}"
    path.write_bytes(content)
    return path.name


def in_processes(name: str, file: str, seed: int, seconds: float, count: int | None = None) -> dict[str, Any]:
    """What was counted, over as many processes as the files end."""
    row: dict[str, Any] = {"executions": 0, "refused": 0, "findings": {}, "worst": 0.0, "ended": 0}
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        place = Path(tempfile.mkdtemp(dir=MEMORY))
        left = end - time.monotonic()
        limit = [] if count is None else ["--count", str(count)]
        command = [sys.executable, __file__, name, "--child", str(place), "--seed", str(seed), "--seconds", str(left)]
        done = subprocess.run([*command, *limit], capture_output=True, text=True, errors="replace", check=False)
        told = place / "told.json"
        if told.is_file():
            part = json.loads(told.read_text())
            row["findings"] |= part["findings"]
            row["worst"] = max(row["worst"], part["worst"])
            for key in ("executions", "refused"):
                row[key] += part[key]
        if done.returncode:
            row["ended"] += 1
            last = " ".join(done.stderr.split())[-300:]
            what = signal.Signals(-done.returncode).name if done.returncode < 0 else f"exit code {done.returncode}"
            content = (place / file).read_bytes() if (place / file).is_file() else b""
            row["findings"].setdefault(f"the process ended: {what}", f"{last} ({kept(content, name)})")
        shutil.rmtree(place)
        seed += 1000
        if count is not None:
            break
    return row


def main() -> int:
    """Fuzzes the decoders that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="of decoders; all without one")
    parser.add_argument("--seconds", type=float, default=60, help="for each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, help="files of each, in place of --seconds")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child is not None:
        child(given.names[0], given.seed, given.seconds, given.child, given.count)
        os._exit(0)  # what the threads of libraries do at their ends is not asked here
    from decoders import ANY

    unknown = [name for name in given.names if name not in ANY]
    if unknown:
        parser.error(f"{unknown[0]!r} is no decoder; there are {', '.join(ANY)}")
    total, found = 0, 0
    print("| decoder | executions | refused | ended its process | slowest, CPU s | findings |\n" + "|---" * 6 + "|")
    for name in given.names or ANY:
        row = in_processes(name, ANY[name].file, given.seed, given.seconds, given.count)
        findings = "; ".join(f"{what}: {where}" for what, where in row["findings"].items()) or "none"
        counts = f"{row['executions']} | {row['refused']} | {row['ended']} | {row['worst']:.1f}"
        print(f"| {name} | {counts} | {findings} |", flush=True)
        total, found = total + row["executions"], found + len(row["findings"])
    print(f"\n{total} executions, {found} findings")
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
