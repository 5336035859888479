"""Real kills of the real program, at moments that nobody chose."""

from __future__ import annotations

import os
import runpy
import sys
from pathlib import Path

import pytest
from conftest import ROOT


@pytest.mark.slow  # processes of their own, each of which imports and compiles
@pytest.mark.skipif(os.name != "posix", reason="signals of another kind")
def test_killed_runs_end_with_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs that get SIGKILL at random moments and are resumed leave the files of an undisturbed one; oracle: those."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["killed_runs.py", "--kills", "4", "--frames", "40"])
    assert runpy.run_path(str(ROOT / "benchmarks/killed_runs.py"))["main"]() == 0
