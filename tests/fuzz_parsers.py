"""Fuzzing of every parser of `parsers.py`, guided by the branches that an input takes (Atheris, which is libFuzzer).

    make fuzz-parsers TIME=60                                   60 seconds of the processor for each
    .venv/bin/python tests/fuzz_parsers.py "EuRoC camera" problem --seconds 600

Needs `atheris` (Linux; `make fuzz-parsers` installs it). What was interesting is kept in `.cache/fuzz/NAME/`, and the
next call goes on from there.

Oracle: the file is read, or `InputError` says why not; nothing else comes out, and it takes no more than a second of
the processor and 500 MB. What else happens is told once for each place in the code, and the file that shows it is kept
in `.cache/fuzz/findings/`. Exit code 1 where there is one. A finding becomes a row of `bad_inputs.csv` or a test.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import random
import resource
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from pathlib import Path
from typing import Any

import atheris

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests" / "helpers"))
PLACE = ROOT / ".cache" / "fuzz"
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None
"""Where the files lie: written to a disk, they took three quarters of the time."""
SECONDS, MEGABYTES = 1.0, 500
PARSING = ["vggtgeo", "plyfile", "zipfile", "tomllib", "json", "numpy.lib"]
"""What is instrumented: our own branches, and those of the parsers below us that are written in Python."""

with contextlib.redirect_stderr(io.StringIO()), atheris.instrument_imports(include=PARSING):
    import jax
    from parsers import KINDS, Kind
    from test_mutated_files import WORDS

    from vggtgeo.io.errors import InputError


class Watch:
    """Counts, and what must not happen."""

    def __init__(self, kind: Kind, folder: Path, seconds: float):
        self.kind, self.file = kind, folder / kind.file
        self.end = time.process_time() + seconds
        self.name = kind.name.replace(" ", "-")
        self.executions = self.refused = 0
        self.findings: dict[str, str] = {}

    def one(self, data: bytes) -> None:
        """Reads one file."""
        self.file.write_bytes(data)
        began, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self.kind.read(self.file)
        except InputError:
            self.refused += 1
        except Exception as error:  # noqa: BLE001 - whatever it is, it is a finding
            places = [frame for frame in traceback.extract_tb(error.__traceback__) if "/vggtgeo/" in frame.filename]
            where = f"{Path(places[-1].filename).name}:{places[-1].lineno}" if places else "?"
            self._found(f"{type(error).__name__} at {where}", str(error), data)
        seconds = time.process_time() - began
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) / 2**10
        self.executions += 1
        if seconds > SECONDS and self.executions > 1:  # the first one imports and compiles
            self._found("too slow", f"{seconds:.1f} s", data)
        if grown > MEGABYTES:
            self._found("too much memory", f"{grown:.0f} MB", data)
        if time.process_time() > self.end:
            self.write()
            os._exit(0)  # what libraries do at their ends, with threads that a fork does not have, may not work

    def _found(self, what: str, message: str, data: bytes) -> None:
        if what in self.findings:
            return
        folder = PLACE / "findings"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name}-{hashlib.sha256(data).hexdigest()[:12]}"
        path.write_bytes(data)
        self.findings[what] = f"{message[:200]} ({path.name})"

    def write(self) -> None:
        """The counts."""
        told = {"executions": self.executions, "refused": self.refused, "cpu": time.process_time()}
        (PLACE / f"{self.name}.json").write_text(json.dumps({**told, "findings": self.findings}))


def mutated_archive(data: bytes, size: int, seed: int) -> bytes:
    """An `.npz` with one array's bytes changed, its checksums right: else nothing behind them is ever reached."""
    chance = random.Random(seed)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        if chance.random() < 0.1 or not members:
            raise ValueError
        name = chance.choice(sorted(members))
        if chance.random() < 0.05:
            del members[name]
        else:
            members[name] = bytes(atheris.Mutate(members[name], len(members[name]) + 64))
        whole = io.BytesIO()
        with zipfile.ZipFile(whole, "w") as archive:
            for name, content in members.items():
                archive.writestr(name, content)
        return whole.getvalue()[:size]
    except Exception:  # noqa: BLE001 - what is no archive any more is changed as any other file is
        return bytes(atheris.Mutate(data, size))


def fuzz_one(kind: Kind, folder: Path, seconds: int) -> None:
    """Fuzzes one parser, which reads from `folder`, in this process, which ends with it."""
    whole = kind.content(folder)
    watch = Watch(kind, folder, seconds)
    corpus, words = PLACE / watch.name, PLACE / "words"
    corpus.mkdir(parents=True, exist_ok=True)
    (corpus / "whole").write_bytes(whole)
    escaped = ("".join(f"\\x{byte:02x}" for byte in word) for word in WORDS)
    words.write_text("".join(f'"{word}"\n' for word in escaped))
    watch.one(whole)
    options: dict[str, Any] = {"custom_mutator": mutated_archive} if kind.file.endswith(".npz") else {}
    limits = ["-timeout=600", "-rss_limit_mb=8192", f"-max_len={4 * len(whole) + 256}", "-verbosity=0"]
    names = [f"-dict={words}", f"-artifact_prefix={PLACE}/{watch.name}-"]
    atheris.Setup([sys.argv[0], str(corpus), *limits, *names], watch.one, **options)
    atheris.Fuzz()


def in_a_process(kind: Kind, seconds: int) -> dict[str, Any]:
    """What was counted. A fork, because instrumenting all imports takes as long as fuzzing a parser."""
    told = PLACE / f"{kind.name.replace(' ', '-')}.json"
    told.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
        child = os.fork()
        if child == 0:
            log = os.open(PLACE / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(log, 1)
            os.dup2(log, 2)
            try:
                fuzz_one(kind, Path(folder), seconds)
            except BaseException:  # noqa: BLE001 - the child must not go on as its parent
                traceback.print_exc()
                os._exit(1)
        os.waitpid(child, 0)
    row: dict[str, Any] = {"executions": 0, "refused": 0, "cpu": 0.0, "findings": {}}
    if told.is_file():
        row = json.loads(told.read_text())
    else:
        end = (PLACE / "log.txt").read_text(errors="replace")[-500:]
        row["findings"]["the process died"] = " ".join(end.split())
    return row


def main() -> int:
    """Fuzzes the parsers that are named, or all, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="of parsers; all without one")
    parser.add_argument("--seconds", type=int, default=60, help="of the processor, for each parser")
    given = parser.parse_args()
    kinds = {kind.name: kind for kind in KINDS}
    unknown = [name for name in given.names if name not in kinds]
    if unknown:
        parser.error(f"{unknown[0]!r} is no parser; there are {', '.join(kinds)}")
    jax.config.update("jax_enable_x64", True)
    PLACE.mkdir(parents=True, exist_ok=True)
    total, found = 0, 0
    print("| parser | executions | refused | CPU s | findings |\n|---|---|---|---|---|")
    for name in given.names or kinds:
        row = in_a_process(kinds[name], given.seconds)
        findings = "; ".join(f"{what}: {where}" for what, where in row["findings"].items()) or "none"
        print(f"| {name} | {row['executions']} | {row['refused']} | {row['cpu']:.0f} | {findings} |", flush=True)
        total, found = total + row["executions"], found + len(row["findings"])
    print(f"\n{total} executions, {found} findings")
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
