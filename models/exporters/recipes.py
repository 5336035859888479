"""Which networks can be exported: from whose code, in which variants and sizes, under which licence."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vggtgeo.models.exporters.checkout import Checkout
from vggtgeo.models.exporters.request import ExportError, Graph, Request

_HERE = "vggtgeo.models.exporters"


@dataclass(frozen=True)
class Recipe:
    """One network.

    module, function: what builds it. variants: its sizes, the default first; `test` is small and has no checkpoint.
    size: default height and width, pixels, for images of 640 x 480. multiple: both are multiples of this.
    fixed_height, fixed_width: the only value there is, or None. views, tokens: their default, 0 where there are none.
    half: whether it can be written in half precision.
    """

    network: str
    module: str
    variants: tuple[str, ...]
    size: tuple[int, int]
    function: str = "build"
    multiple: int = 1
    fixed_height: int | None = None
    fixed_width: int | None = None
    views: int = 0
    tokens: int = 0
    half: bool = True

    @property
    def checkout(self) -> Checkout:
        """Return where its code is looked for."""
        found: Checkout = importlib.import_module(f"{_HERE}.{self.module}").CHECKOUT
        return found

    @property
    def build(self) -> Callable[[Request], Graph]:
        """Make the network that a request asks for."""
        found: Callable[[Request], Graph] = getattr(importlib.import_module(f"{_HERE}.{self.module}"), self.function)
        return found

    def request(
        self,
        source: Path,
        checkpoint: Path | None,
        height: int | None = None,
        width: int | None = None,
        views: int | None = None,
        tokens: int | None = None,
        variant: str | None = None,
        half: bool = False,
        allow_extra: bool = False,
    ) -> Request:
        """Return the request with defaults filled in; `ExportError` for what this network cannot be."""
        height, width = height or self.size[0], width or self.size[1]
        self._check_size(height, width)
        if variant is not None and variant not in self.variants:
            raise ExportError(
                f"`--variant` {variant} is not known for {self.network}; expected one of {', '.join(self.variants)}"
            )
        if half and not self.half:
            raise ExportError(f"`--half` does nothing for {self.network}, which is small; leave it out")
        return Request(
            source=source,
            checkpoint=checkpoint,
            height=height,
            width=width,
            variant=variant or self.variants[0],
            views=self._only_where("--views", views, self.views) or 1,
            tokens=self._only_where("--tokens", tokens, self.tokens),
            half=half,
            allow_extra=allow_extra,
        )

    def _check_size(self, height: int, width: int) -> None:
        for option, size, fixed in (("--height", height, self.fixed_height), ("--width", width, self.fixed_width)):
            if fixed is not None and size != fixed:
                raise ExportError(f"`{option}` is {size}; {self.network} takes {fixed} alone, leave it out")
            if size < 1 or size % self.multiple:
                near = max(self.multiple, round(size / self.multiple) * self.multiple)
                raise ExportError(
                    f"`{option}` is {size}; {self.network} takes multiples of {self.multiple}: {near}, for instance"
                )

    def _only_where(self, option: str, value: int | None, default: int) -> int:
        if value is not None and not default:
            raise ExportError(f"`{option}` means nothing to {self.network}; leave it out")
        if value is not None and value < 1:
            raise ExportError(f"`{option}` is {value}, expected at least 1")
        return default if value is None else value


RECIPES = {
    recipe.network: recipe
    for recipe in (
        Recipe("vggt", "vggt", ("1b", "test"), (392, 518), multiple=14, fixed_width=518, views=4),
        Recipe("dinov3", "dinov3", ("vitl16", "vitb16", "vits16"), (480, 640), multiple=16),
        Recipe("moge2", "moge2", ("vitl", "vitb", "vits"), (480, 640), tokens=1800),
        Recipe("letr", "letr", ("resnet50", "resnet101", "test"), (480, 640), half=False),
        Recipe("mast3r_encoder", "mast3r", ("vitl", "test"), (384, 512), "build_encoder", multiple=16),
        Recipe("mast3r_decoder", "mast3r", ("vitl", "test"), (384, 512), "build_decoder", multiple=16),
        Recipe("alike", "alike", ("normal", "tiny", "small", "large"), (480, 640), multiple=32, half=False),
        Recipe("xfeat", "xfeat", ("published",), (480, 640), multiple=32, half=False),
        Recipe("mlsd", "mlsd", ("tiny",), (512, 512), fixed_height=512, fixed_width=512, half=False),
    )
}
"""Every network that can be exported, by the name of its contract."""


def recipe_of(network: str) -> Recipe:
    """Return the recipe of `network`; `ExportError` with the names there are."""
    if network not in RECIPES:
        raise ExportError(f"`NAME` is {network!r}, expected one of {', '.join(RECIPES)}")
    return RECIPES[network]
