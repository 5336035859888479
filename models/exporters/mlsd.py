"""M-LSD tiny (Gu et al., AAAI 2022): maps of segment centres and displacements. Exported as published."""

from __future__ import annotations

from typing import Any

import numpy as np
from vggtgeo.models.exporters.attention import as_module
from vggtgeo.models.exporters.checkout import Checkout, import_from
from vggtgeo.models.exporters.request import Graph, Request, load
from vggtgeo.models.exporters.weights import fill, seed

CHECKOUT = Checkout("lhwcv/mlsd_pytorch", "models/mbv2_mlsd_tiny.py", ("models",))
FOURTH_CHANNEL = 1 / 127.5 - 1
"""An image of ones, scaled as the colours are."""


def build(request: Request) -> Graph:
    """Return the network for its one size, 512 x 512."""
    torch = load("torch")
    with CHECKOUT.importable(request.source):
        seed(request)
        code = import_from(request.source, "models.mbv2_mlsd_tiny", "")
        network = code.MobileV2_MLSD_Tiny()
    fill(network, request, "M-LSD tiny")
    colours = request.random_images(-1.0, 1.0)
    image = np.concatenate([colours, np.full_like(colours[:, :1], FOURTH_CHANNEL)], axis=1)
    with torch.inference_mode():
        maps = network(torch.from_numpy(image))

    def forward(network: Any, image: Any) -> Any:
        return network(image)

    return Graph(as_module(network, forward), {"image": image}, {"maps": maps.numpy()})
