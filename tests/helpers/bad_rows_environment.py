"""Rows of the table of bad inputs: what surrounds the program."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from bad_row import nothing, rows

from vggtgeo.cli.environment import check_address_space
from vggtgeo.io.jax_environment import cache_folder


def without_home(folder: Path) -> None:
    """No home folder, and one that cannot be written: there is no cache, and that is all."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("HOME", "XDG_CACHE_HOME"):
            patch.delenv(name, raising=False)
        patch.setattr(os.path, "expanduser", lambda path: path)
        assert cache_folder() is None
        (folder / "file").write_text("")
        patch.setenv("XDG_CACHE_HOME", str(folder / "file"))
        assert cache_folder() is None


def limited(gigabytes: float) -> None:
    """What `vggtgeo run` asks first, with so large an address space."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("resource.getrlimit", lambda kind: (int(gigabytes * 1e9), -1))
        check_address_space("run")


def listed(**variables: str) -> dict[str, Any]:
    """A command in a process of its own, without a terminal, that says the same words with these variables."""

    def call(_: Path) -> None:
        def words(**more: str) -> list[str]:
            command = [sys.executable, "-c", "from vggtgeo.cli import main; main()", "models", "list"]
            done = subprocess.run(command, env={**os.environ, **more}, capture_output=True, check=True)
            return done.stdout.decode(errors="replace").split()

        plain, said = words(), words(**variables)
        assert len(said) > 50
        assert [word for word in said if word.isascii()] == [word for word in plain if word.isascii()]

    return {"call": call, "slack": 3.0}


ENVIRONMENT = rows(
    "Environment",
    [
        ("no terminal", nothing, listed()),
        ("one thread", nothing, listed(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")),
        ("no home folder, or one that cannot be written: nothing is cached", nothing, {"call": without_home}),
        ("`ulimit -v` that is too small", nothing, {"call": lambda made: limited(2.5)}),
        ("`ulimit -v` that is small", nothing, {"call": lambda made: limited(4.0)}),
    ],
)
