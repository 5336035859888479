"""Where a number comes from: code, machine, inputs."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import psutil

from vggtgeo.results.summary import versions

_PACKAGE = Path(__file__).parent.parent
_COMPUTING = ("bundle", "datasets", "evaluation", "geometry", "simulation", "slam", "solvers", "models")
"""Packages that a result depends on; pages and commands do not change it."""
_TEXT = frozenset({".txt", ".toml", ".yaml", ".yml", ".json", ".csv"})


@cache
def source_digest() -> str:
    """Of the code that computes: 12 hexadecimal digits."""
    digest = hashlib.sha256()
    for name in _COMPUTING:
        folder = _PACKAGE / name if (_PACKAGE / name).is_dir() else _PACKAGE.parent / name
        for file in sorted(folder.rglob("*.py")):
            digest.update(file.relative_to(folder.parent).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


@cache
def commit() -> str:
    """Of the checkout that the package lies in, with a `+` where files are changed; empty where it is installed."""
    git = lambda *words: subprocess.run(
        ["git", "-C", str(_PACKAGE), *words], capture_output=True, text=True, check=False, timeout=20
    )
    try:
        if git("ls-files", "--error-unmatch", "__init__.py").returncode:
            return ""
        changed = git("status", "--porcelain", "--untracked-files=no").stdout.strip()
        return git("rev-parse", "--short=12", "HEAD").stdout.strip() + ("+" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return ""


@cache
def machine() -> str:
    """Processor and memory in words; no name of a host."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    except OSError:
        pass
    memory = psutil.virtual_memory().total / 2**30
    return f"{model}, {os.cpu_count()} cores, {memory:.0f} GB, {platform.system()}"


def provenance() -> dict[str, Any]:
    """Columns of every row."""
    found = versions()
    return {
        "version": found.pop("vggtgeo"),
        "commit": commit(),
        "source": source_digest(),
        "machine": machine(),
        **{f"version_{name.replace('-', '_')}": value for name, value in found.items()},
    }


def input_hash(path: Path) -> str:
    """Of a recording: names and sizes of its files, and the content of its text files; 16 hexadecimal digits.

    Images are not read: a gigabyte would take longer than some runs.
    """
    digest = hashlib.sha256()
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    for file in files:
        name = file.relative_to(path.parent).as_posix()
        with contextlib.suppress(OSError):  # gone meanwhile, or not to be read: the run will say so
            size = file.stat().st_size
            digest.update(f"{name} {size}\n".encode(errors="surrogateescape"))  # names need not be UTF-8
            if file.suffix.lower() in _TEXT and size < 2**22:
                digest.update(file.read_bytes())
    return digest.hexdigest()[:16]
