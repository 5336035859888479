"""Which networks can be exported: from whose code, in which variants and sizes, under which licence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vggtgeo.models.exporters import dinov3, line_detectors, moge2, point_matchers, vggt
from vggtgeo.models.exporters.network import Checkout, Graph, Request

from vggtgeo.io.errors import InputError


@dataclass(frozen=True)
class Recipe:
    """One network.

    checkout: its published code. build: makes the network that a request asks for. variants: its sizes, the default
    first; `test` is small and has no checkpoint. size: default height and width, pixels, for images of 640 x 480.
    multiple: both are multiples of this. fixed: options of the sizes that can only be the default. views, tokens: their
    default, 0 where there are none. half: whether it can be written in half precision.
    """

    network: str
    checkout: Checkout
    build: Callable[[Request], Graph]
    variants: tuple[str, ...]
    size: tuple[int, int] = (480, 640)
    multiple: int = 1
    fixed: tuple[str, ...] = ()
    views: int = 0
    tokens: int = 0
    half: bool = True

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
        """Return the request with defaults filled in; `InputError` for what this network cannot be."""
        height, width = height or self.size[0], width or self.size[1]
        for option, size, default in zip(("--height", "--width"), (height, width), self.size, strict=True):
            if size < 1 or size % self.multiple or (option in self.fixed and size != default):
                allowed = f"{default} alone" if option in self.fixed else f"multiples of {self.multiple}"
                raise InputError(f"`{option}` is {size}; {self.network} takes {allowed}")
        for option, value, default in (("--views", views, self.views), ("--tokens", tokens, self.tokens)):
            if value is not None and (value < 1 or not default):
                raise InputError(f"`{option}` is {value}; {self.network} takes {'at least 1' if default else 'none'}")
        if variant is not None and variant not in self.variants:
            raise InputError(
                f"`--variant` {variant} is not known for {self.network}; expected one of {', '.join(self.variants)}"
            )
        if checkpoint is not None and variant == "test":
            raise InputError("`--variant` test is for tests, with `--random-weights`; no checkpoint fits it")
        if half and not self.half:
            raise InputError(f"`--half` does nothing for {self.network}, which is small; leave it out")
        return Request(
            checkout=self.checkout,
            source=source,
            checkpoint=checkpoint,
            height=height,
            width=width,
            variant=variant or self.variants[0],
            views=views or self.views or 1,
            tokens=tokens or self.tokens,
            half=half,
            allow_extra=allow_extra,
        )


_NEEDS = "install einops and huggingface-hub"
_VGGT = Checkout("facebookresearch/vggt", "vggt/models/vggt.py", ("vggt",), (".", "base_models"), _NEEDS)
_DINOV3 = Checkout("facebookresearch/dinov3", "dinov3/hub/backbones.py", ("dinov3",), hint="see its requirements.txt")
_MOGE2 = Checkout("microsoft/MoGe", "moge/model/v2.py", ("moge",), hint="install huggingface-hub")
_LETR = Checkout(
    "mlpc-ucsd/LETR", "models/letr_stack.py", ("models", "util", "args"), ("src", "."), "install scipy and pillow"
)
_MAST3R = Checkout(
    "naver/mast3r",
    "mast3r/model.py",
    ("mast3r", "dust3r", "models", "utils"),
    (".", "thirdparty/mast3r"),
    f"{_NEEDS}, fetch the submodules",
)
_ALIKE = Checkout("Shiaoming/ALIKE", "alnet.py", ("alnet",))
_XFEAT = Checkout("verlab/accelerated_features", "modules/model.py", ("modules",))
_MLSD = Checkout("lhwcv/mlsd_pytorch", "models/mbv2_mlsd_tiny.py", ("models",))
_ALL = (
    Recipe("vggt", _VGGT, vggt.build, ("1b", "test"), (392, 518), multiple=14, fixed=("--width",), views=4),
    Recipe("dinov3", _DINOV3, dinov3.build, ("vitl16", "vitb16", "vits16"), multiple=16),
    Recipe("moge2", _MOGE2, moge2.build, ("vitl", "vitb", "vits"), tokens=1800),
    Recipe("letr", _LETR, line_detectors.build_letr, ("resnet50", "resnet101", "test"), half=False),
    Recipe("mast3r_encoder", _MAST3R, point_matchers.build_mast3r_encoder, ("vitl", "test"), (384, 512), multiple=16),
    Recipe("mast3r_decoder", _MAST3R, point_matchers.build_mast3r_decoder, ("vitl", "test"), (384, 512), multiple=16),
    Recipe("alike", _ALIKE, point_matchers.build_alike, ("normal", "tiny", "small", "large"), multiple=32, half=False),
    Recipe("xfeat", _XFEAT, point_matchers.build_xfeat, ("published",), multiple=32, half=False),
    Recipe("mlsd", _MLSD, line_detectors.build_mlsd, ("tiny",), (512, 512), fixed=("--height", "--width"), half=False),
)
RECIPES = {recipe.network: recipe for recipe in _ALL}
"""Every network that can be exported, by the name of its contract."""


def recipe_of(network: str) -> Recipe:
    """Return the recipe of `network`; `InputError` with the names there are."""
    if network not in RECIPES:
        raise InputError(f"`NAME` is {network!r}, expected one of {', '.join(RECIPES)}")
    return RECIPES[network]
