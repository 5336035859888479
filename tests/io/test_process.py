"""Memory of the own process."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from vggtgeo.io.process import return_freed_memory


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc alone gives memory back on request")
def test_freed_memory_is_given_back() -> None:
    """Blocks that were freed between others leave the process. Oracle: its resident memory, as Linux counts it."""
    resident = lambda: 4096 * int(Path("/proc/self/statm").read_text().split()[1])
    blocks = [bytes([1]) * 20_000 for _ in range(10_000)]
    kept = blocks[::50]
    blocks.clear()
    before = resident()
    return_freed_memory()
    returned = before - resident()
    assert returned > 100e6, f"{returned / 1e6:.0f} of 196 MB were returned, {len(kept)} blocks kept"
