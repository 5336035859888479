"""Rotary position embedding in two dimensions, for token positions that are known when exporting.

VGGT's and CroCo's modules look the largest position up in the data, which no exporter can follow. The angles depend
on the grid of patches alone: with D the size of a head, the first D / 2 channels turn with the row, the others with
the column, channel pair (c, c + D / 4) by position / base^(4 c / D). (Su et al., RoFormer, 2021; Heo et al., 2024.)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from vggtgeo.models.exporters.packages import load


def fix_positions(rope: Any, positions: np.ndarray, head_size: int, base: float) -> None:
    """Make the torch module `rope` turn tokens at `positions`, int [P, 2] of (row, column), whatever it is given.

    It then takes tokens [batch, heads, k P, head_size] for any k: sequences of k images with the same positions.
    Angles and products are float32, as upstream; float16 tokens come back as float16.
    """
    torch = load("torch")
    cosine, sine = (torch.from_numpy(table) for table in angle_tables(positions, head_size, base))
    quarter = head_size // 4

    def forward(tokens: Any, _positions: Any = None) -> Any:
        repeats = tokens.shape[2] // len(positions)
        values = tokens.float()
        first, second, third, fourth = values.split(quarter, dim=-1)
        turned = torch.cat((-second, first, -fourth, third), dim=-1)
        return (values * cosine.repeat(repeats, 1) + turned * sine.repeat(repeats, 1)).to(tokens.dtype)

    rope.forward = forward


def angle_tables(positions: np.ndarray, head_size: int, base: float) -> tuple[np.ndarray, np.ndarray]:
    """Cosines and sines, float32 [P, head_size] each, of the tokens at `positions`, int [P, 2]."""
    half = head_size // 2
    frequencies = 1.0 / base ** (np.arange(0, half, 2) / half)
    angles = positions[:, :, None] * frequencies
    angles = np.concatenate([angles, angles], axis=2).reshape(len(positions), head_size)
    return np.cos(angles).astype(np.float32), np.sin(angles).astype(np.float32)


def grid(rows: int, columns: int) -> np.ndarray:
    """(row, column) of each patch, int [rows columns, 2], row by row."""
    return np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1).reshape(-1, 2)
