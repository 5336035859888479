"""LETR (Xu et al., CVPR 2021), both stages: line segments and their scores.

Changes, since the published code is of the time of torch 1.7:

- It asks torchvision for a backbone, which is made here instead (`residual_network`); nothing is downloaded.
- It imports a private class of torch by its old name: the name is lent to it while it is imported.
- Its copy of multi-head attention calls internals of torch that cannot be exported: torch's own takes its place, with
  exactly the same weights.
- It pads lists of images; here there is one image and a mask that says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from vggtgeo.models.exporters.checkout import Checkout, import_from, stand_in
from vggtgeo.models.exporters.module import as_module
from vggtgeo.models.exporters.packages import load
from vggtgeo.models.exporters.request import Graph, Request
from vggtgeo.models.exporters.residual_network import layer_getter, residual_network
from vggtgeo.models.exporters.weights import fill, require_random, seed

CHECKOUT = Checkout("mlpc-ucsd/LETR", "models/letr_stack.py", ("models", "util", "args"), ("src", "."))
_HINT = "install scipy and pillow"
_SMALL = ("--enc_layers", "--dec_layers", "--second_enc_layers", "--second_dec_layers")


def build(request: Request) -> Graph:
    """Return the network for one image of the request's size."""
    torch = load("torch")
    require_random(request, ("test",))
    with CHECKOUT.importable(request.source), _stand_ins(request):
        seed(request)
        code = import_from(request.source, "models.letr", _HINT)
        options = import_from(request.source, "args", _HINT).get_args_parser().parse_args(_arguments(request))
        network = code.build(options)[0]
        nested = import_from(request.source, "util.misc", _HINT).NestedTensor
    fill(network, request, f"LETR {request.variant}, both stages")
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


def _arguments(request: Request) -> list[str]:
    backbone = "resnet50" if request.variant == "test" else request.variant
    arguments = ["--LETRpost", "--backbone", backbone, "--no_aux_loss", "--device", "cpu"]
    if request.variant == "test":
        arguments += ["--num_queries", "50", *(word for name in _SMALL for word in (name, "1"))]
    return arguments


@contextmanager
def _stand_ins(request: Request) -> Iterator[None]:
    """What LETR imports: a torchvision with one backbone, and a class of torch under its old name."""
    linear = load("torch").nn.modules.linear

    def backbone(norm_layer: Any, **_options: Any) -> Any:
        name = "resnet50" if request.variant == "test" else request.variant
        return residual_network(name, norm_layer)

    linear._LinearWithBias = linear.NonDynamicallyQuantizableLinear
    try:
        with stand_in("torchvision.models._utils", IntermediateLayerGetter=layer_getter()):
            torchvision = load("torchvision")
            torchvision.__version__ = "0.99"
            torchvision._is_tracing = lambda: False
            torchvision.models.resnet50 = torchvision.models.resnet101 = backbone
            yield
    finally:
        del linear._LinearWithBias


def _replace_attention(network: Any) -> None:
    attention = load("torch").nn.MultiheadAttention
    for module in list(network.modules()):
        for name, child in list(module.named_children()):
            if type(child).__name__ == "MultiheadAttention" and not isinstance(child, attention):
                own = attention(child.embed_dim, child.num_heads)
                own.load_state_dict(child.state_dict(), strict=True)
                setattr(module, name, own.eval().requires_grad_(False))
