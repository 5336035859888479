"""Attention of the published code, replaced while a network is run or exported."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from vggtgeo.models.exporters.packages import load


@contextmanager
def attention_replaced(make: Callable[[Callable[..., Any]], Callable[..., Any]]) -> Iterator[None]:
    """In the block, `make` of torch's own attention stands in its place."""
    functional = load("torch").nn.functional
    original = functional.scaled_dot_product_attention
    functional.scaled_dot_product_attention = make(original)
    try:
        yield
    finally:
        functional.scaled_dot_product_attention = original


def in_parts(queries: int) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """For `attention_replaced`: the same sums, for so many queries at a time.

    onnxruntime holds the weights of all pairs of tokens at once: of VGGT's 10 views of 392 x 518 pixels 7 GB a layer.
    A query's answer depends on no other query.
    """

    def make(original: Callable[..., Any]) -> Callable[..., Any]:
        torch = load("torch")

        def attention(query: Any, key: Any, value: Any, *others: Any, **named: Any) -> Any:
            parts = [original(part, key, value, *others, **named) for part in query.split(queries, dim=-2)]
            return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-2)

        return attention

    return make
