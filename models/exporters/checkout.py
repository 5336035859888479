"""Importing a network's published code from a checkout, without leaving traces in the way other code is imported."""

from __future__ import annotations

import contextlib
import importlib
import io
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

from vggtgeo.models.exporters.request import ExportError


@dataclass(frozen=True)
class Checkout:
    """Where a network's code lies.

    repository: owner/name, for messages. marker: a file that a checkout has, relative to one of `roots`.
    roots: folders of the checkout, relative, in which `marker` may lie; the first that has it is imported from.
    packages: top-level names that its code imports from there.
    """

    repository: str
    marker: str
    packages: tuple[str, ...]
    roots: tuple[str, ...] = (".",)

    def root(self, source: Path) -> Path:
        """Return the folder to import from; raises `ExportError` if `source` is no such checkout."""
        for folder in self.roots:
            if (source / folder / self.marker).is_file():
                return (source / folder).resolve()
        found = "no such folder" if not source.is_dir() else f"no `{self.marker}` in it"
        raise ExportError(
            f"`--source` {source}: {found}; expected a checkout of {self.repository}: "
            f"git clone https://github.com/{self.repository}"
        )

    def find(self, folder: Path) -> Path | None:
        """Return the checkout among the folders in `folder`, whatever it is called, or None."""
        for candidate in sorted(path for path in folder.iterdir() if path.is_dir()):
            if any((candidate / root / self.marker).is_file() for root in self.roots):
                return candidate
        return None

    @contextlib.contextmanager
    def importable(self, source: Path) -> Iterator[None]:
        """Import `packages` from the checkout and from nowhere else, in the block."""
        root = self.root(source)
        search_path = list(sys.path)
        _forget(self.packages)
        # a namespace package (croco's `models`, say) loses against any regular one of its name later on the path
        others = [entry for entry in search_path if not _provides(entry, self.packages)]
        sys.path[:] = [str(root), *others]
        importlib.invalidate_caches()
        try:
            with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
                warnings.simplefilter("ignore")
                yield
        finally:
            sys.path[:] = search_path

    def revision(self, source: Path) -> str:
        """Return `repository@commit` of the checkout, the commit `unknown` outside git."""
        try:
            command = ["git", "-C", str(source), "rev-parse", "HEAD"]
            commit = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        except (OSError, subprocess.CalledProcessError):
            commit = "unknown"
        return f"{self.repository}@{commit}"


def import_from(source: Path, module: str, hint: str) -> Any:
    """Return the module, inside `Checkout.importable`; `ExportError` with `hint` if something that it imports is
    missing.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ExportError(f"`--source` {source}: importing `{module}` failed: {error}; {hint}") from None


@contextlib.contextmanager
def stand_in(name: str, **attributes: Any) -> Iterator[None]:
    """Let `import name` give an empty module with `attributes` in the block, if it is not installed.

    For packages that the published code imports at the top and does not need for the forward pass.
    """
    parts = [".".join(name.split(".")[: depth + 1]) for depth in range(name.count(".") + 1)]
    previous = {part: sys.modules.get(part) for part in parts}
    sys.modules.update({part: ModuleType(part) for part in parts})
    for parent, child in pairwise(parts):
        setattr(sys.modules[parent], child.rsplit(".", 1)[1], sys.modules[child])
    vars(sys.modules[name]).update(attributes)
    try:
        yield
    finally:
        for part, module in previous.items():
            if module is None:
                sys.modules.pop(part, None)
            else:
                sys.modules[part] = module


def _forget(packages: Sequence[str]) -> None:
    for name in list(sys.modules):
        if name.split(".")[0] in packages:
            del sys.modules[name]


def _provides(entry: str, packages: Sequence[str]) -> bool:
    folder = Path(entry or ".")
    return any((folder / name).is_dir() or (folder / f"{name}.py").is_file() for name in packages)
