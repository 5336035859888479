"""MoGe-2 (Wang et al., 2025): points up to a shift in z, mask, metric scale and, where the network has it, normals.

The network is exported as published, with the number of patches fixed. Not changed, but needed around it:

- Its module imports `utils3d`, which the forward pass does not use: an empty module stands in.
- xFormers, where installed, is switched off before the import: its attention cannot be exported.
- The published "ONNX-compatible mode" is for an older exporter and drops the anti-aliasing of the resize, which
  changes results by up to 6 %: it stays off.

Focal length and shift are recovered outside, by the adapter.
"""

from __future__ import annotations

import json
import os
import sys
from types import ModuleType
from typing import Any
from unittest import mock

from vggtgeo.models.exporters.attention import halve_blocks
from vggtgeo.models.exporters.network import Graph, Request, as_module, fill_weights, load, read_checkpoint

from vggtgeo.io.errors import InputError

_BLOCKS = {"vits": 12, "vitb": 12, "vitl": 24}
_CHANNELS = {"vits": 384, "vitb": 768, "vitl": 1024}
_CONFIGURATION = "configs/train/v2.json"
"""The published configuration of the ViT-L; the smaller networks differ in backbone and channels."""


def build(request: Request) -> Graph:
    """Return the network for one image of the request's size, seen as about `request.tokens` patches."""
    torch = load("torch")
    configuration = _configuration(request)
    without_xformers = mock.patch.dict(os.environ, {"XFORMERS_DISABLED": "1"})
    sys.modules.setdefault("utils3d", ModuleType("utils3d"))
    with request.code() as imported, without_xformers:
        network = imported("moge.model.v2").MoGeModel(**configuration)
    fill_weights(network, request, f"MoGe-2 {configuration['encoder']['backbone']}")
    image = request.random_images(0.0, 1.0)
    with torch.inference_mode():
        outputs = network(torch.from_numpy(image), request.tokens)
    names = tuple(name for name in ("points", "normal", "mask", "metric_scale") if name in outputs)
    published = {name: outputs[name].numpy() for name in names}
    if request.half:
        halve_blocks(network.encoder.backbone.blocks)

    def forward(network: Any, image: Any) -> tuple[Any, ...]:
        outputs = network(image, request.tokens)
        return tuple(outputs[name] for name in names)

    return Graph(as_module(network, forward), {"image": image}, published)


def _configuration(request: Request) -> dict[str, Any]:
    """Return the network's options: those in the checkpoint, else the published ones, fitted to the variant."""
    if request.checkpoint is not None:
        configuration = read_checkpoint(request.checkpoint).get("model_config")
        if not isinstance(configuration, dict):
            raise InputError(
                f"`--checkpoint` {request.checkpoint} holds no `model_config`, expected the published MoGe-2 file "
                "(model.pt), which has its options and its weights"
            )
        return configuration
    path = request.checkout.root(request.source) / _CONFIGURATION
    if not path.is_file():
        raise InputError(
            f"`--source` {request.source}: no `{_CONFIGURATION}` in it, from which random weights are "
            "made; update the checkout"
        )
    configuration = json.loads(path.read_text())["model"]
    return _fitted(configuration, request.variant)


def _fitted(configuration: dict[str, Any], variant: str) -> dict[str, Any]:
    """Return the configuration of the ViT-L for another backbone: number of blocks and width."""
    blocks = _BLOCKS[variant]
    levels = [blocks * (quarter + 1) // 4 - 1 for quarter in range(4)]
    encoder = configuration["encoder"] | {"backbone": f"dinov2_{variant}14", "intermediate_layers": levels}
    scale_head = {"dims": [_CHANNELS[variant], *configuration["scale_head"]["dims"][1:]]}
    return configuration | {"encoder": encoder, "scale_head": scale_head}
