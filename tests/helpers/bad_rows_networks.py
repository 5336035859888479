"""Rows of the table of bad inputs: networks that open, keep their contract as far as it shows, and answer nonsense."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import bad_files as bad
import numpy as np
import tiny_networks as tiny
from bad_row import rows
from onnx import helper
from vggtgeo.models.onnx.contracts import METADATA_NETWORK

OPEN: Mapping[str, tiny.Shape] = {"points": (1, "rows", "columns", 3), "mask": (1, "rows", "columns")}
"""Sizes that the file leaves open: what it answers shows only when it runs."""


def depth_network(size: tuple[int, int], **changed: np.ndarray) -> Callable[[Path], Path]:
    """A network that sees a wall at two metres, in maps of this size."""
    height, width = size
    x, y = np.meshgrid(np.arange(width) - 0.5 * (width - 1), np.arange(height) - 0.5 * (height - 1))
    points = np.stack([x / width, y / width, np.full(size, 2.0)], axis=-1)[None]
    answers = {"points": points, "mask": np.ones((1, *size)), "metric_scale": np.ones(1)} | changed
    nodes = [helper.make_node("Identity", [f"value of {name}"], [name]) for name in answers]
    values = {f"value of {name}": np.asarray(value, np.float32) for name, value in answers.items()}
    outputs = {name: OPEN.get(name, np.shape(value)) for name, value in answers.items()}

    def make(folder: Path) -> Path:
        (folder / "photo.png").write_bytes(bad.encoded(".png"))
        inputs: dict[str, tiny.Shape] = {"image": (1, 3, "H", "W")}
        return tiny.save(folder / "net.onnx", nodes, inputs, outputs, values, {METADATA_NETWORK: "moge2"})

    return make


def verify(made: Path) -> Sequence[Any]:
    """`vggtgeo models verify` on a photograph."""
    return ["models", "verify", made, "--image", made.with_name("photo.png"), "--runs", "1"]


SIZE = (bad.HEIGHT, bad.WIDTH)
ANSWERS = rows(
    "Network files",
    [
        ("depth of another size than its image", depth_network((24, 32)), {"argv": verify}),
        ("depth that is negative", depth_network(SIZE, metric_scale=-np.ones(1)), {"argv": verify}),
    ],
    slack=3.0,
)
