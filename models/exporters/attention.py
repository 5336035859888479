"""Changes of published modules that exporters share: attention, rotary embeddings, half precision.

Rotary embedding: VGGT's and CroCo's modules look the largest position up in the data, which no exporter can follow. The
angles depend on the grid of patches alone: with D the size of a head, the first D / 2 channels turn with the row, the
others with the column, channel pair (c, c + D / 4) by position / base^(4 c / D). (Su et al., RoFormer, 2021; Heo et
al., 2024.)

Half precision is used in the attention layers and perceptrons of transformer blocks. Sums of residuals, norms, layer
scales, rotary embeddings and convolutional heads stay in float32, since activations leave the range or the precision of
float16 there. The file's inputs and outputs are float32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from vggtgeo.models.exporters.network import load


@contextmanager
def attention_replaced(attention: Callable[..., Any]) -> Iterator[None]:
    """Replace torch's own attention in the block; `attention` takes the original function and its arguments."""
    functional = load("torch").nn.functional
    original = functional.scaled_dot_product_attention
    functional.scaled_dot_product_attention = partial(attention, original)
    try:
        yield
    finally:
        functional.scaled_dot_product_attention = original


def in_parts(queries: int) -> Callable[..., Any]:
    """Compute the same sums, for so many queries at a time; for `attention_replaced`.

    onnxruntime holds the weights of all pairs of tokens at once: of VGGT's 10 views of 392 x 518 pixels 7 GB a layer.
    A query's answer depends on no other query.
    """
    torch = load("torch")

    def attention(original: Callable[..., Any], query: Any, key: Any, value: Any, *others: Any, **named: Any) -> Any:
        parts = [original(part, key, value, *others, **named) for part in query.split(queries, dim=-2)]
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-2)

    return attention


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
    """Return cosines and sines, float32 [P, head_size] each, of the tokens at `positions`, int [P, 2]."""
    half = head_size // 2
    frequencies = 1.0 / base ** (np.arange(0, half, 2) / half)
    angles = positions[:, :, None] * frequencies
    angles = np.concatenate([angles, angles], axis=2).reshape(len(positions), head_size)
    return np.cos(angles).astype(np.float32), np.sin(angles).astype(np.float32)


def grid(rows: int, columns: int) -> np.ndarray:
    """Return (row, column) of each patch, int [rows columns, 2], row by row."""
    return np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1).reshape(-1, 2)


def halve_blocks(blocks: Iterable[Any]) -> None:
    """Turn every attention layer and perceptron of `blocks` (torch modules) to float16, with casts around it."""
    for block in blocks:
        for name in ("attn", "cross_attn", "mlp"):
            layer = getattr(block, name, None)
            if layer is not None:
                _halve(layer)


def _halve(layer: Any) -> None:
    torch = load("torch")
    layer.half()
    inner = layer.forward

    def forward(*tokens: Any, **others: Any) -> Any:
        cast = [t.half() if isinstance(t, torch.Tensor) and t.is_floating_point() else t for t in tokens]
        return inner(*cast, **others).float()

    layer.forward = forward
