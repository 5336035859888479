"""A network and a plain function as one torch module, the form in which torch exports."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from vggtgeo.models.exporters.packages import load


def as_module(network: Any, forward: Callable[..., Any]) -> Any:
    """Return a torch module that owns `network` and computes `forward(network, *inputs)`."""
    base: Any = load("torch").nn.Module

    class Wrapped(base):
        def __init__(self, owned: Any) -> None:  # an argument: a class that knows the network would outlive it
            super().__init__()
            self.network = owned

        def forward(self, *inputs: Any) -> Any:
            return forward(self.network, *inputs)

    return Wrapped(network).eval()
