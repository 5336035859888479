"""The request and the result of an exporter, and the optional packages that it needs."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.io.errors import install_hint


class ExportError(ValueError):
    """A checkout, a checkpoint or a size does not fit the network; the message says what, and what to do."""


@dataclass(frozen=True)
class Request:
    """One export, already checked against its recipe.

    source: the checkout. checkpoint: the file of weights, or None for random ones drawn with `seed`.
    height, width: pixels of the input image. views: images a window (VGGT). tokens: patches inside MoGe-2.
    variant: the size of the network, one of the recipe's. half: attention and perceptrons in float16.
    allow_extra: whether the checkpoint may hold weights that the network has no place for.
    """

    source: Path
    checkpoint: Path | None
    height: int
    width: int
    variant: str
    views: int = 1
    tokens: int = 0
    half: bool = False
    allow_extra: bool = False
    seed: int = 0

    def random_images(self, low: float, high: float, count: int = 1) -> np.ndarray:
        """Return float32 [count, 3, height, width], uniform in [low, high]: the input on which PyTorch is repeated."""
        draw = np.random.default_rng(self.seed).uniform(low, high, (count, 3, self.height, self.width))
        return draw.astype(np.float32)


@dataclass(frozen=True)
class Graph:
    """A network ready to be exported.

    module: a torch module that takes the arrays of `inputs` in order and gives the outputs in order.
    inputs: example input by name, float32. published: what the published code gives for it, before any change, by
    the output's name, float32.
    """

    module: Any
    inputs: Mapping[str, np.ndarray]
    published: Mapping[str, np.ndarray]


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
