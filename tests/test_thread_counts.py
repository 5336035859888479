"""A run gives the same trajectory whatever the number of threads is."""

from __future__ import annotations

import subprocess
import sys

import pytest
from conftest import ROOT

BOUND_MM, BOUND_DEGREES = 1e-6, 1e-6
"""Nothing but the rounding of the comparison: measured were 0 and 0."""


@pytest.mark.slow
def test_threads_move_no_pose() -> None:
    """One, two and eight threads of OpenMP, BLAS, OpenCV, XLA and our own; oracle: the run with one."""
    command = [sys.executable, str(ROOT / "benchmarks/threads.py"), "--frames", "14"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in done.stdout.splitlines()[2:]]
    assert [row[0] for row in rows] == ["1", "2", "8"]
    assert max(float(row[4]) for row in rows) <= BOUND_MM, done.stdout
    assert max(float(row[5]) for row in rows) <= BOUND_DEGREES, done.stdout
