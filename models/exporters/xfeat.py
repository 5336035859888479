"""XFeat (Potje et al., CVPR 2024): a map of scores, and unit descriptors of 8 x 8 blocks.

The score of a pixel is the probability of a key point there, among the pixels of its block and none, times the
reliability of the block, as in the published detector. Key points are taken of the maps by the adapter.
"""

from __future__ import annotations

from typing import Any

from vggtgeo.models.exporters.attention import as_module
from vggtgeo.models.exporters.checkout import Checkout, import_from
from vggtgeo.models.exporters.request import Graph, Request, load
from vggtgeo.models.exporters.weights import fill, seed

CHECKOUT = Checkout("verlab/accelerated_features", "modules/model.py", ("modules",))
_BLOCK = 8


def build(request: Request) -> Graph:
    """Return the network for one image of the request's size."""
    torch = load("torch")
    with CHECKOUT.importable(request.source):
        seed(request)
        network = import_from(request.source, "modules.model", "").XFeatModel()
    fill(network, request, "XFeat")
    image = request.random_images(0.0, 1.0)

    def forward(network: Any, image: Any) -> tuple[Any, Any]:
        features, logits, reliability = network(image)
        places = torch.nn.functional.pixel_shuffle(logits.softmax(dim=1)[:, : _BLOCK**2], _BLOCK)
        trust = torch.nn.functional.interpolate(reliability, scale_factor=_BLOCK, mode="bilinear")
        return places * trust, torch.nn.functional.normalize(features, dim=1)

    with torch.inference_mode():
        scores, descriptors = forward(network, torch.from_numpy(image))
    published = {"scores": scores.numpy(), "block_descriptors": descriptors.numpy()}
    return Graph(as_module(network, forward), {"image": image}, published)
