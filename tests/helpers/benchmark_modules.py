"""Modules of `benchmarks/`."""

import importlib
import sys
from types import ModuleType

from conftest import ROOT


def benchmark(name: str) -> ModuleType:
    """The module of this name, imported as the benchmarks import each other."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(ROOT / "benchmarks"))
