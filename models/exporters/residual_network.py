"""The ResNet backbone that LETR asks torchvision for (He et al., CVPR 2016; stride in the 3 x 3 convolution).

LETR's code calls torchvision with options that newer versions lack and that download weights. Names of parameters are
torchvision's, so that LETR's checkpoints fit; the norm comes from LETR.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from vggtgeo.models.exporters.packages import load

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
