"""DINOv3 (Siméoni et al., 2025): descriptors of the patches, and what the last block attends to.

Changes to the loaded module:

- The published code never returns its attention. The last block's is computed once more, from its own weights, for
  the class token and the registers, and given as an output of its own.
- `bias_mask` of the attention layers starts as NaN and is filled by the checkpoint or by the published
  initialisation; the network is made with `pretrained=False`, which downloads nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from vggtgeo.models.exporters.attention import attention_replaced, halve_blocks
from vggtgeo.models.exporters.network import Graph, Request, as_module, fill_weights, load

PREFIX = 5
"""The class token and four registers."""
_DEVIATIONS = 2.0
"""Uniform noise of a normalised image, roughly."""


def build(request: Request) -> Graph:
    """Return the network for one image of the request's size."""
    torch = load("torch")
    with request.code() as imported:
        network = getattr(imported("dinov3.hub.backbones"), f"dinov3_{request.variant}")(pretrained=False)
    fill_weights(network, request, f"DINOv3 {request.variant}")
    image = request.random_images(-_DEVIATIONS, _DEVIATIONS)
    recorded: list[tuple[Any, Any]] = []

    def recorded_attention(original: Callable[..., Any], query: Any, key: Any, *others: Any, **named: Any) -> Any:
        recorded[:] = [(query, key)]
        return original(query, key, *others, **named)

    with torch.inference_mode(), attention_replaced(recorded_attention):
        descriptors = network.forward_features(torch.from_numpy(image))["x_norm_patchtokens"]
        attention = _attention(*recorded[-1])
    published = {"patch_descriptors": descriptors.numpy(), "attention": attention.numpy()}
    if request.half:
        halve_blocks(network.blocks)
    return Graph(as_module(network, _forward), {"image": image}, published)


def _forward(network: Any, image: Any) -> tuple[Any, Any]:
    tokens, (rows, columns) = network.prepare_tokens_with_masks(image)
    rope = network.rope_embed(H=rows, W=columns)
    for block in network.blocks[:-1]:
        tokens = block(tokens, rope)
    last = network.blocks[-1]
    attention = _last_attention(last, tokens, rope)
    tokens = last(tokens, rope)
    return network.norm(tokens)[:, PREFIX:], attention


def _last_attention(block: Any, tokens: Any, rope: Any) -> Any:
    layer = block.attn
    batch, count, size = tokens.shape
    states = layer.qkv(block.norm1(tokens).to(layer.qkv.weight.dtype))
    states = states.reshape(batch, count, 3, layer.num_heads, size // layer.num_heads)
    query, key = states[:, :, 0].transpose(1, 2), states[:, :, 1].transpose(1, 2)
    return _attention(*layer.apply_rope(query, key, rope))


def _attention(query: Any, key: Any) -> Any:
    """Return softmax(q k^T / sqrt(size)) of the prefix tokens' queries, [1, heads, 5, tokens]."""
    prefix = query[:, :, :PREFIX].float()
    return (prefix @ key.float().transpose(-2, -1) * query.shape[-1] ** -0.5).softmax(dim=-1)
