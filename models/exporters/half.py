"""Half precision where the weights and the work are: in the attention layers and perceptrons of transformer blocks.

Sums of residuals, norms, layer scales, rotary embeddings and convolutional heads stay in float32, since activations
of these networks leave the range or the precision of float16 there. The file's inputs and outputs are float32.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from vggtgeo.models.exporters.packages import load


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
