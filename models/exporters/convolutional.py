"""Small convolutional networks, exported as published: M-LSD tiny (Gu et al., AAAI 2022), ALIKE (Zhao et al., IEEE
Transactions on Multimedia 2022) and XFeat (Potje et al., CVPR 2024).

Key points are taken of the maps by the adapter, so that their number is no part of the file.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from vggtgeo.models.exporters.request import Graph, Request, load
from vggtgeo.models.exporters.weights import fill

_FOURTH_CHANNEL = 1 / 127.5 - 1
"""An image of ones, scaled as the colours are (M-LSD)."""
_ALIKE_SIZES = {
    "tiny": (8, 16, 32, 64, 64),
    "small": (8, 16, 48, 96, 96),
    "normal": (16, 32, 64, 128, 128),
    "large": (32, 64, 128, 128, 128),
}
"""Channels of the four blocks, and of the descriptors."""
_BLOCK = 8
"""Side of the blocks of pixels of XFeat."""


def build_mlsd(request: Request) -> Graph:
    """Return the network for its one size, 512 x 512: maps of segment centres and displacements."""
    with request.code() as imported:
        network = imported("models.mbv2_mlsd_tiny").MobileV2_MLSD_Tiny()
    fill(network, request, "M-LSD tiny")
    colours = request.random_images(-1.0, 1.0)
    image = np.concatenate([colours, np.full_like(colours[:, :1], _FOURTH_CHANNEL)], axis=1)
    return Graph.unchanged(network, lambda network, image: network(image), {"image": image}, ("maps",))


def build_alike(request: Request) -> Graph:
    """Return the network for one image of the request's size: a map of scores and one of unit descriptors."""
    torch = load("torch")
    with request.code() as imported:
        network = imported("alnet").ALNet(*_ALIKE_SIZES[request.variant], single_head=request.variant != "large")
    fill(network, request, f"ALIKE {request.variant}")

    def forward(network: Any, image: Any) -> tuple[Any, Any]:
        scores, descriptors = network(image)
        return scores, torch.nn.functional.normalize(descriptors, dim=1)

    return Graph.unchanged(network, forward, {"image": request.random_images(0.0, 1.0)}, ("scores", "descriptors"))


def build_xfeat(request: Request) -> Graph:
    """Return the network for one image of the request's size: a map of scores, and unit descriptors of 8 x 8 blocks.

    The score of a pixel is the probability of a key point there, among the pixels of its block and none, times the
    reliability of the block, as in the published detector.
    """
    functional = load("torch").nn.functional
    with request.code() as imported:
        network = imported("modules.model").XFeatModel()
    fill(network, request, "XFeat")

    def forward(network: Any, image: Any) -> tuple[Any, Any]:
        features, logits, reliability = network(image)
        places = functional.pixel_shuffle(logits.softmax(dim=1)[:, : _BLOCK**2], _BLOCK)
        trust = functional.interpolate(reliability, scale_factor=_BLOCK, mode="bilinear")
        return places * trust, functional.normalize(features, dim=1)

    image = {"image": request.random_images(0.0, 1.0)}
    return Graph.unchanged(network, forward, image, ("scores", "block_descriptors"))
