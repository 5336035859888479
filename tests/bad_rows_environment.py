"""Rows of the table of bad inputs: what surrounds the program."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from bad_row import nothing, rows

from vggtgeo.cli.address_space import check_address_space
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


ENVIRONMENT = rows(
    "Environment",
    [
        ("no home folder, or one that cannot be written: nothing is cached", nothing, {"call": without_home}),
        ("`ulimit -v` that is too small", nothing, {"call": lambda made: limited(2.5)}),
        ("`ulimit -v` that is small", nothing, {"call": lambda made: limited(4.0)}),
    ],
)
