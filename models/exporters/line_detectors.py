"""Line detectors: LETR (Xu et al., CVPR 2021), both stages, and M-LSD tiny (Gu et al., AAAI 2022), as published.

Changes to LETR, since the published code is of the time of torch 1.7:

- It asks torchvision for a ResNet with options that newer versions lack and that download weights: they are left out.
  It reads the version as a number of three characters: another is given.
- It imports a private class of torch by its old name: the name is lent to it while it is imported.
- Its copy of multi-head attention calls internals of torch that cannot be exported: torch's own takes its place, with
  exactly the same weights.
- It pads lists of images; here there is one image and a mask that says so.
"""

from __future__ import annotations

from typing import Any
from unittest import mock

import numpy as np
from vggtgeo.models.exporters.network import Graph, Request, as_module, fill_weights, load

_FOURTH_CHANNEL = 1 / 127.5 - 1
"""An image of ones, scaled as the colours are (M-LSD)."""
_SMALL = ("--enc_layers", "--dec_layers", "--second_enc_layers", "--second_dec_layers")


def build_letr(request: Request) -> Graph:
    """Return the network for one image of the request's size: line segments and their scores."""
    torch, torchvision = load("torch"), load("torchvision")
    backbone = "resnet50" if request.variant == "test" else request.variant
    resnet = getattr(torchvision.models, backbone)
    linear = torch.nn.modules.linear
    with (
        request.code() as imported,
        mock.patch.object(torchvision, "__version__", "0.99"),
        mock.patch.object(torchvision.models, backbone, lambda norm_layer, **_: resnet(norm_layer=norm_layer)),
        mock.patch.object(linear, "_LinearWithBias", linear.NonDynamicallyQuantizableLinear, create=True),
    ):
        code = imported("models.letr")
        options = imported("args").get_args_parser().parse_args(_arguments(request, backbone))
        network = code.build(options)[0]
        nested = imported("util.misc").NestedTensor
    fill_weights(network, request, f"LETR {request.variant}, both stages")
    image = torch.from_numpy(request.random_images(-2.0, 2.0))
    mask = torch.zeros(1, request.height, request.width, dtype=torch.bool)
    with torch.inference_mode():
        outputs = network([image[0]])[0]
    published = {name: outputs[name].numpy() for name in ("pred_logits", "pred_lines")}
    _replace_attention(network)

    def forward(network: Any, image: Any) -> tuple[Any, Any]:
        outputs = network(nested(image, mask))[0]
        return outputs["pred_logits"], outputs["pred_lines"]

    return Graph(as_module(network, forward), {"image": image.numpy()}, published)


def _arguments(request: Request, backbone: str) -> list[str]:
    arguments = ["--LETRpost", "--backbone", backbone, "--no_aux_loss", "--device", "cpu"]
    if request.variant == "test":
        arguments += ["--num_queries", "50", *(word for name in _SMALL for word in (name, "1"))]
    return arguments


def _replace_attention(network: Any) -> None:
    attention = load("torch").nn.MultiheadAttention
    for module in list(network.modules()):
        for name, child in list(module.named_children()):
            if type(child).__name__ == "MultiheadAttention" and not isinstance(child, attention):
                own = attention(child.embed_dim, child.num_heads)
                own.load_state_dict(child.state_dict(), strict=True)
                setattr(module, name, own.eval().requires_grad_(False))


def build_mlsd(request: Request) -> Graph:
    """Return the network for its one size, 512 x 512: maps of segment centres and displacements."""
    with request.code() as imported:
        network = imported("models.mbv2_mlsd_tiny").MobileV2_MLSD_Tiny()
    fill_weights(network, request, "M-LSD tiny")
    colours = request.random_images(-1.0, 1.0)
    image = np.concatenate([colours, np.full_like(colours[:, :1], _FOURTH_CHANNEL)], axis=1)
    return Graph.unchanged(network, lambda network, image: network(image), {"image": image}, ("maps",))
