"""VGGT (Wang et al., CVPR 2025): poses, depth and its confidence of a window of views.

Changes to the loaded module, each needed because the published code cannot be exported as it is:

- The point and track heads are dropped: nothing here uses them.
- Rotary embedding looks `positions.max()` up in the data: angles become constants of the grid (`attention`). Special
  tokens stand at (0, 0), patches at (row + 1, column + 1); global attention sees all views' tokens in one sequence.
- The dense head computes its position embedding in float64 beside float32 (onnxruntime refuses the file): it is
  evaluated once for each size and kept as float32. Half of its channels depend on the column alone and half on the
  row alone, so one row and one column are kept.
- Aggregator and heads are called one by one: the published `forward` switches CUDA autocast off in between, for which
  there is no operator.
- Global attention, of all views' tokens, is computed for the queries of one view at a time: see `attention`.

The number of views and the size are fixed in the file.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from vggtgeo.models.exporters.attention import attention_replaced, fix_positions, grid, halve_blocks, in_parts
from vggtgeo.models.exporters.network import Graph, Request, as_module, fill_weights, load

PATCH = 14


def build(request: Request) -> Graph:
    """Return the network for `request.views` images of the request's size."""
    torch = load("torch")
    with request.code() as imported:
        code = imported("vggt.models.vggt")
        network = _small(code) if request.variant == "test" else code.VGGT()
    fill_weights(network, request, "VGGT-1B")
    network.point_head = network.track_head = None
    images = request.random_images(0.0, 1.0, request.views)
    with torch.inference_mode(), request.checkout.importable(request.source):
        outputs = network(torch.from_numpy(images))
    published = {
        "pose_enc": outputs["pose_enc"][0].numpy(),
        "depth": outputs["depth"][0, ..., 0].numpy(),
        "depth_conf": outputs["depth_conf"][0].numpy(),
    }
    _prepare(network, request)
    return Graph(as_module(network, _forward), {"images": images}, published)


def _small(model: Any) -> Any:
    """Return the same network from its published parts, with one block of each kind in the place of eight."""
    base: Any = model.VGGT

    class Small(base):
        def __init__(self) -> None:
            load("torch").nn.Module.__init__(self)
            self.aggregator = model.Aggregator(embed_dim=384, depth=4, num_heads=6, patch_embed="dinov2_vits14_reg")
            self.camera_head = model.CameraHead(dim_in=768, trunk_depth=1)
            self.depth_head = model.DPTHead(
                dim_in=768,
                output_dim=2,
                activation="exp",
                features=64,
                out_channels=[32, 64, 128, 128],
                intermediate_layer_idx=[0, 1, 2, 3],
            )
            self.point_head = self.track_head = None

    return Small()


def _forward(network: Any, images: Any) -> tuple[Any, Any, Any]:
    batch = images[None]
    patches = (images.shape[-2] // PATCH) * (images.shape[-1] // PATCH)
    with attention_replaced(in_parts(network.aggregator.patch_start_idx + patches)):
        tokens, patch_start = network.aggregator(batch)
    poses = network.camera_head(tokens)[-1]
    depth, confidence = network.depth_head(tokens, images=batch, patch_start_idx=patch_start)
    return poses[0], depth[0, ..., 0], confidence[0]


def _prepare(network: Any, request: Request) -> None:
    aggregator = network.aggregator
    patches = grid(request.height // PATCH, request.width // PATCH) + 1
    special = np.zeros((aggregator.patch_start_idx, 2), patches.dtype)
    attention = aggregator.frame_blocks[0].attn
    base = float(aggregator.rope.base_frequency)
    fix_positions(aggregator.rope, np.concatenate([special, patches]), attention.head_dim, base)
    _fix_dense_embedding(network.depth_head)
    if request.half:
        encoder = getattr(aggregator.patch_embed, "blocks", ())
        halve_blocks([*encoder, *aggregator.frame_blocks, *aggregator.global_blocks, *network.camera_head.trunk])


def _fix_dense_embedding(head: Any) -> None:
    torch = load("torch")
    published = head._apply_pos_embed
    kept: dict[tuple[int, int, int], tuple[Any, Any]] = {}

    def embed(features: Any, width: int, height: int, ratio: float = 0.1) -> Any:
        size = tuple(features.shape[1:])
        if size not in kept:  # filled by the first plain call; exporting finds it here
            embedding = published(torch.zeros(1, *size), width, height, ratio)[0]
            half = size[0] // 2
            kept[size] = embedding[:half, :1].clone(), embedding[half:, :, :1].clone()
        by_column, by_row = kept[size]
        rows, columns = size[1:]
        embedding = torch.cat([by_column.expand(-1, rows, -1), by_row.expand(-1, -1, columns)])
        return features + embedding

    head._apply_pos_embed = embed
