"""ALIKE (Zhao et al., IEEE Transactions on Multimedia 2022): a map of scores and one of unit descriptors.

Changes: it asks torchvision for two kinds of convolution, which are made here instead; key points are taken of the maps
by the adapter, so that their number is no part of the file.
"""

from __future__ import annotations

from typing import Any

from vggtgeo.models.exporters.attention import as_module
from vggtgeo.models.exporters.checkout import Checkout, import_from, stand_in
from vggtgeo.models.exporters.request import Graph, Request, load
from vggtgeo.models.exporters.weights import fill, seed

CHECKOUT = Checkout("Shiaoming/ALIKE", "alnet.py", ("alnet",))
_SIZES = {
    "tiny": (8, 16, 32, 64, 64),
    "small": (8, 16, 48, 96, 96),
    "normal": (16, 32, 64, 128, 128),
    "large": (32, 64, 128, 128, 128),
}
"""Channels of the four blocks, and of the descriptors."""


def build(request: Request) -> Graph:
    """Return the network for one image of the request's size."""
    torch = load("torch")
    with CHECKOUT.importable(request.source), _stand_in(torch):
        seed(request)
        code = import_from(request.source, "alnet", "")
        network = code.ALNet(*_SIZES[request.variant], single_head=request.variant != "large")
    fill(network, request, f"ALIKE {request.variant}")
    image = request.random_images(0.0, 1.0)

    def forward(network: Any, image: Any) -> tuple[Any, Any]:
        scores, descriptors = network(image)
        return scores, torch.nn.functional.normalize(descriptors, dim=1)

    with torch.inference_mode():
        scores, descriptors = forward(network, torch.from_numpy(image))
    published = {"scores": scores.numpy(), "descriptors": descriptors.numpy()}
    return Graph(as_module(network, forward), {"image": image}, published)


def _stand_in(torch: Any) -> Any:
    """Return the one module of torchvision that ALIKE imports, with the two functions that it calls."""

    def convolution(side: int) -> Any:
        def make(inputs: int, outputs: int, stride: int = 1) -> Any:
            return torch.nn.Conv2d(inputs, outputs, side, stride, padding=side // 2, bias=False)

        return make

    return stand_in("torchvision.models.resnet", conv3x3=convolution(3), conv1x1=convolution(1))
