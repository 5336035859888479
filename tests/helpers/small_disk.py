"""A disk that gets full: files of this process cannot grow beyond a size."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def small_disk(size: int) -> Iterator[None]:
    """Inside, what would make a file larger than `size` bytes fails, as on a disk without space."""
    if os.name != "posix":
        pytest.skip("a limit that this system has not")
    import resource

    before, byte_code = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    # Python 3.11 keeps a compiled module that the limit cut short, and every later process fails on it.
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = byte_code
