"""Point matchers: MASt3R (Leroy et al., ECCV 2024) in two files, encoder features once an image, then the decoder for
each pair; and ALIKE (Zhao et al., IEEE Transactions on Multimedia 2022) and XFeat (Potje et al., CVPR 2024), as
published. Key points are taken of their maps by the adapter, so that their number is no part of the file.

Changes to MASt3R:

- Rotary embedding looks `positions.max()` up in the data: angles become constants of the grid (`attention`).
- Image shapes travel through the published code as tensors: encoder, decoder and heads are called one by one, with
  the size as plain numbers.
- The checkpoint's configuration is a line of Python that upstream evaluates; here the published configuration is
  written out, and the weights must fit it.
- Importing the code switches TF32 on for the whole process; that is undone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from vggtgeo.models.exporters.attention import fix_positions, grid, halve_blocks
from vggtgeo.models.exporters.network import Graph, Request, as_module, fill_weights, load

PATCH = 16
_BASE = 100.0
_UNBOUNDED = float("inf")
_METRIC: dict[str, Any] = {
    "pos_embed": f"RoPE{_BASE:.0f}",
    "patch_embed_cls": "PatchEmbedDust3R",
    "landscape_only": False,
    "img_size": (512, 512),
    "head_type": "catmlp+dpt",
    "output_mode": "pts3d+desc24",
    "depth_mode": ("exp", -_UNBOUNDED, _UNBOUNDED),
    "conf_mode": ("exp", 1, _UNBOUNDED),
    "desc_conf_mode": ("exp", 0, _UNBOUNDED),
    "two_confs": True,
    "enc_embed_dim": 1024,
    "enc_depth": 24,
    "enc_num_heads": 16,
    "dec_embed_dim": 768,
    "dec_depth": 12,
    "dec_num_heads": 12,
}
"""`MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric`, for images that are not turned to landscape."""
_SMALL = {"enc_embed_dim": 192, "enc_depth": 2, "enc_num_heads": 3, "dec_embed_dim": 192, "dec_num_heads": 3}
_HEAD_OUTPUTS = {"points": "pts3d", "confidence": "conf", "descriptors": "desc", "descriptor_confidence": "desc_conf"}
_ALIKE_SIZES = {
    "tiny": (8, 16, 32, 64, 64),
    "small": (8, 16, 48, 96, 96),
    "normal": (16, 32, 64, 128, 128),
    "large": (32, 64, 128, 128, 128),
}
"""Channels of the four blocks, and of the descriptors."""
_BLOCK = 8
"""Side of the blocks of pixels of XFeat."""


def build_mast3r_encoder(request: Request) -> Graph:
    """Return image to features."""
    torch = load("torch")
    network = _network(request)
    image = request.random_images(-1.0, 1.0)
    shape = torch.tensor([[request.height, request.width]])
    with torch.inference_mode():
        features = network._encode_image(torch.from_numpy(image), shape)[0]
    _prepare(network, request)
    network.dec_blocks = network.dec_blocks2 = network.downstream_head1 = network.downstream_head2 = None
    return Graph(as_module(network, _encode), {"image": image}, {"features": features.numpy()})


def build_mast3r_decoder(request: Request) -> Graph:
    """Build the decoder: features of two images to points, descriptors and confidences of both.

    The example's features are of random images.
    """
    torch = load("torch")
    network = _network(request)
    images = torch.from_numpy(request.random_images(-1.0, 1.0, 2)).split(1)
    shape = torch.tensor([[request.height, request.width]])
    views = [{"img": image, "true_shape": shape, "instance": [str(index)]} for index, image in enumerate(images)]
    with torch.inference_mode():
        features = [network._encode_image(image, shape)[0].numpy() for image in images]
        first, second = network(*views)
    second["pts3d"] = second.pop("pts3d_in_other_view")
    _prepare(network, request)
    inputs = {f"features_{view + 1}": features[view] for view in range(2)}
    published = {
        f"{name}_{number}": view[key].numpy()
        for number, view in enumerate((first, second), start=1)
        for name, key in _HEAD_OUTPUTS.items()
    }
    return Graph(as_module(network, _decode(request)), inputs, published)


def _network(request: Request) -> Any:
    torch = load("torch")
    allowed = torch.backends.cuda.matmul.allow_tf32
    with request.code() as imported:
        small = _SMALL if request.variant == "test" else {}
        network = imported("mast3r.model").AsymmetricMASt3R(**_METRIC | small)
    torch.backends.cuda.matmul.allow_tf32 = allowed
    fill_weights(network, request, "MASt3R ViT-L metric")
    return network


def _prepare(network: Any, request: Request) -> None:
    positions = grid(request.height // PATCH, request.width // PATCH)
    head_size = network.enc_embed_dim // network.enc_blocks[0].attn.num_heads  # the decoder's is the same
    kind = type(network.rope)
    for rope in [module for module in network.modules() if isinstance(module, kind)]:  # the second decoder has its own
        fix_positions(rope, positions, head_size, _BASE)
    if request.half:
        halve_blocks([*network.enc_blocks, *network.dec_blocks, *network.dec_blocks2])


def _encode(network: Any, image: Any) -> Any:
    features = network.patch_embed.proj(image).flatten(2).transpose(1, 2)
    features = network.patch_embed.norm(features)
    for block in network.enc_blocks:
        features = block(features, None)
    return network.enc_norm(features)


def _decode(request: Request) -> Callable[..., tuple[Any, ...]]:
    size = (request.height, request.width)

    def forward(network: Any, features_1: Any, features_2: Any) -> tuple[Any, ...]:
        decoded = network._decoder(features_1, None, features_2, None)
        heads = (network.downstream_head1, network.downstream_head2)
        views = [head(list(tokens), size) for head, tokens in zip(heads, decoded, strict=True)]
        return tuple(view[key] for view in views for key in _HEAD_OUTPUTS.values())

    return forward


def build_alike(request: Request) -> Graph:
    """Return the network for one image of the request's size: a map of scores and one of unit descriptors."""
    torch = load("torch")
    with request.code() as imported:
        network = imported("alnet").ALNet(*_ALIKE_SIZES[request.variant], single_head=request.variant != "large")
    fill_weights(network, request, f"ALIKE {request.variant}")

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
    fill_weights(network, request, "XFeat")

    def forward(network: Any, image: Any) -> tuple[Any, Any]:
        features, logits, reliability = network(image)
        places = functional.pixel_shuffle(logits.softmax(dim=1)[:, : _BLOCK**2], _BLOCK)
        trust = functional.interpolate(reliability, scale_factor=_BLOCK, mode="bilinear")
        return places * trust, functional.normalize(features, dim=1)

    image = {"image": request.random_images(0.0, 1.0)}
    return Graph.unchanged(network, forward, image, ("scores", "block_descriptors"))
