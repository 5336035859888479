"""Make `vggtgeo.solvers` and `vggtgeo.models` importable when `vggtgeo` was found in a source tree.

An installed package has both folders inside `vggtgeo/`. In the source tree they lie beside it, and Python
finds that tree first when it starts in the repository's root. A finder for exactly these two names then looks
one folder up. The root itself stays out of `__path__`, so that nothing else in it, as `tests/`, becomes part
of `vggtgeo`.
"""

import sys
from collections.abc import Iterable
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

_PACKAGE = Path(__file__).resolve().parent
_BESIDE = {"vggtgeo.solvers": "solvers", "vggtgeo.models": "models"}


class _SourceTreeFinder:
    """A `sys.meta_path` entry, asked after the usual ones."""

    @staticmethod
    def find_spec(name: str, path: Iterable[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        return PathFinder.find_spec(name, [str(_PACKAGE.parent)]) if name in _BESIDE else None


if not all((_PACKAGE / folder).is_dir() for folder in _BESIDE.values()):
    sys.meta_path.append(_SourceTreeFinder)
