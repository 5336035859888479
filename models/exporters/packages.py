"""The optional packages of exporting, and what is said when one is missing."""

from __future__ import annotations

import importlib
from typing import Any

from vggtgeo.models.exporters.request import ExportError
from vggtgeo.models.extras import install_hint


def load(name: str) -> Any:
    """Return the package `name`; raise `ExportError` naming the extra if it, or a dependency, is missing."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ExportError(
            f"exporting needs the package `{error.name}`, which is not installed; {install_hint('export')}"
        ) from None


def check_all() -> None:
    """Raise `ExportError` unless everything that an export needs is installed; before any work begins."""
    for name in ("torch", "onnx", "onnxscript", "onnxruntime"):
        load(name)
