"""LETR (Xu et al., CVPR 2021), both stages: line segments and their scores.

Changes, since the published code is of the time of torch 1.7:

- It asks torchvision for a ResNet (He et al., CVPR 2016; stride in the 3 x 3 convolution), with options that newer
  versions lack and that download weights. It is made here instead, with torchvision's names of parameters.
- It imports a private class of torch by its old name: the name is lent to it while it is imported.
- Its copy of multi-head attention calls internals of torch that cannot be exported: torch's own takes its place, with
  exactly the same weights.
- It pads lists of images; here there is one image and a mask that says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

from vggtgeo.models.exporters.request import Graph, Request, as_module, load, stand_in
from vggtgeo.models.exporters.weights import fill

_SMALL = ("--enc_layers", "--dec_layers", "--second_enc_layers", "--second_dec_layers")


def build(request: Request) -> Graph:
    """Return the network for one image of the request's size."""
    torch = load("torch")
    backbone = "resnet50" if request.variant == "test" else request.variant
    with request.code() as imported, _stand_ins(backbone):
        code = imported("models.letr")
        options = imported("args").get_args_parser().parse_args(_arguments(request, backbone))
        network = code.build(options)[0]
        nested = imported("util.misc").NestedTensor
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


def _arguments(request: Request, backbone: str) -> list[str]:
    arguments = ["--LETRpost", "--backbone", backbone, "--no_aux_loss", "--device", "cpu"]
    if request.variant == "test":
        arguments += ["--num_queries", "50", *(word for name in _SMALL for word in (name, "1"))]
    return arguments


@contextmanager
def _stand_ins(backbone: str) -> Iterator[None]:
    """Provide what LETR imports: a torchvision with one backbone, and a class of torch under its old name."""
    linear = load("torch").nn.modules.linear
    make = lambda norm_layer, **_options: residual_network(backbone, norm_layer)
    old_name = mock.patch.object(linear, "_LinearWithBias", linear.NonDynamicallyQuantizableLinear, create=True)
    with old_name, stand_in("torchvision.models._utils", IntermediateLayerGetter=layer_getter()):
        torchvision = load("torchvision")
        torchvision.__version__ = "0.99"
        torchvision._is_tracing = lambda: False
        torchvision.models.resnet50 = torchvision.models.resnet101 = make
        yield


def _replace_attention(network: Any) -> None:
    attention = load("torch").nn.MultiheadAttention
    for module in list(network.modules()):
        for name, child in list(module.named_children()):
            if type(child).__name__ == "MultiheadAttention" and not isinstance(child, attention):
                own = attention(child.embed_dim, child.num_heads)
                own.load_state_dict(child.state_dict(), strict=True)
                setattr(module, name, own.eval().requires_grad_(False))


DEPTHS = {"resnet50": (3, 4, 6, 3), "resnet101": (3, 4, 23, 3)}
_EXPANSION = 4


def residual_network(name: str, norm: Callable[[int], Any]) -> Any:
    """Return the torch module: `layer1` .. `layer4` after a stem, with `norm(channels)` as the norm, random weights."""
    nn = load("torch").nn
    base: Any = nn.Module

    class Bottleneck(base):
        def __init__(self, before: int, inner: int, stride: int) -> None:
            super().__init__()
            after = inner * _EXPANSION
            self.conv1, self.bn1 = nn.Conv2d(before, inner, 1, bias=False), norm(inner)
            self.conv2, self.bn2 = nn.Conv2d(inner, inner, 3, stride, 1, bias=False), norm(inner)
            self.conv3, self.bn3 = nn.Conv2d(inner, after, 1, bias=False), norm(after)
            self.downsample = None
            if stride != 1 or before != after:
                self.downsample = nn.Sequential(nn.Conv2d(before, after, 1, stride, bias=False), norm(after))

        def forward(self, values: Any) -> Any:
            inner = self.bn1(self.conv1(values)).relu()
            inner = self.bn2(self.conv2(inner)).relu()
            kept = values if self.downsample is None else self.downsample(values)
            return (self.bn3(self.conv3(inner)) + kept).relu()

    network = nn.Module()
    network.conv1, network.bn1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False), norm(64)
    network.relu, network.maxpool = nn.ReLU(), nn.MaxPool2d(3, 2, 1)
    channels = 64
    for level, depth in enumerate(DEPTHS[name]):
        inner = 64 * 2**level
        blocks = []
        for block in range(depth):
            blocks.append(Bottleneck(channels, inner, 2 if block == 0 and level > 0 else 1))
            channels = inner * _EXPANSION
        network.add_module(f"layer{level + 1}", nn.Sequential(*blocks))
    return network


def layer_getter() -> Any:
    """Return a class like torchvision's, which runs children in order and returns those in `return_layers`."""
    base: Any = load("torch").nn.ModuleDict

    class LayerGetter(base):
        def __init__(self, network: Any, return_layers: dict[str, str]) -> None:
            names = list(dict(network.named_children()))
            last = max(names.index(name) for name in return_layers)
            super().__init__({name: getattr(network, name) for name in names[: last + 1]})
            self.return_layers = return_layers

        def forward(self, values: Any) -> dict[str, Any]:
            found = {}
            for name, layer in self.items():
                values = layer(values)
                if name in self.return_layers:
                    found[self.return_layers[name]] = values
            return found

    return LayerGetter
