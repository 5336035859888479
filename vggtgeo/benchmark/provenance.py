"""Record the provenance of results: code, machine, inputs."""

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
_PACKAGES = ("bundle", "datasets", "evaluation", "geometry", "simulation", "slam", "solvers", "models")
"""Packages that results depend on; reports and commands do not change results."""
_TEXT = frozenset({".txt", ".toml", ".yaml", ".yml", ".json", ".csv"})


@cache
def source_digest() -> str:
    """Return a digest of the code that results depend on: 12 hexadecimal digits."""
    digest = hashlib.sha256()
    for name in _PACKAGES:
        folder = _PACKAGE / name if (_PACKAGE / name).is_dir() else _PACKAGE.parent / name
        for file in sorted(folder.rglob("*.py")):
            digest.update(file.relative_to(folder.parent).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


@cache
def commit() -> str:
    """Return the commit of the package's checkout, with `+` if files are changed; empty for an installed package."""
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
    """Describe processor and memory, without the host's name."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    except OSError:
        pass
    memory = psutil.virtual_memory().total / 2**30
    return f"{model}, {os.cpu_count()} cores, {memory:.0f} GB, {platform.system()}"


def provenance() -> dict[str, Any]:
    """Return the provenance columns of a row."""
    found = versions()
    return {
        "version": found.pop("vggtgeo"),
        "commit": commit(),
        "source": source_digest(),
        "machine": machine(),
        **{f"version_{name.replace('-', '_')}": value for name, value in found.items()},
    }


def input_hash(path: Path) -> str:
    """Return a digest of a recording: names and sizes of its files, content of its text files; 16 hexadecimal digits.

    Contents of images are not hashed: reading a gigabyte takes longer than some runs.
    """
    digest = hashlib.sha256()
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    for file in files:
        name = file.relative_to(path.parent).as_posix()
        with contextlib.suppress(OSError):  # a missing or unreadable file: the run itself reports it
            size = file.stat().st_size
            digest.update(f"{name} {size}\n".encode(errors="surrogateescape"))  # names need not be UTF-8
            if file.suffix.lower() in _TEXT and size < 2**22:
                digest.update(file.read_bytes())
    return digest.hexdigest()[:16]
