"""ONNX files of a few kilobytes that keep the true contracts: some answer what a test wants, some compute something."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from vggtgeo.models.onnx.contracts import METADATA_NETWORK, METADATA_WEIGHTS

OPSET = 18
Shape = Sequence[int | str]


def save(
    path: Path,
    nodes: Sequence[onnx.NodeProto],
    inputs: Mapping[str, Shape],
    outputs: Mapping[str, Shape],
    constants: Mapping[str, np.ndarray],
    network: str = "",
    weights: str = "random",
    *,
    dtype: int = TensorProto.FLOAT,
    external: bool = False,
) -> Path:
    """Writes a checked graph that names its network; `num_tokens` is an int64 input, all others have `dtype`."""

    def info(name: str, shape: Shape) -> onnx.ValueInfoProto:
        kind = TensorProto.INT64 if name == "num_tokens" else dtype
        return helper.make_tensor_value_info(name, kind, list(shape))

    graph = helper.make_graph(
        list(nodes),
        "tiny",
        [info(*item) for item in inputs.items()],
        [info(*item) for item in outputs.items()],
        [numpy_helper.from_array(np.asarray(value, order="C"), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=9)
    helper.set_model_props(model, {METADATA_NETWORK: network, METADATA_WEIGHTS: weights} if network else {})
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path, save_as_external_data=external, location=f"{path.name}.data", size_threshold=0)
    return path


def constant(
    path: Path,
    network: str,
    inputs: Mapping[str, Shape],
    outputs: Mapping[str, np.ndarray],
    weights: str = "random",
    *,
    dtype: type = np.float32,
    external: bool = False,
) -> Path:
    """A network that answers `outputs` whatever it is shown."""
    nodes = [helper.make_node("Identity", [f"value of {name}"], [name]) for name in outputs]
    values = {f"value of {name}": np.asarray(value, dtype) for name, value in outputs.items()}
    shapes = {name: np.shape(value) for name, value in outputs.items()}
    element = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
    return save(path, nodes, inputs, shapes, values, network, weights, dtype=element, external=external)


def vggt(path: Path, views: int = 2, size: tuple[int, int] = (28, 42), **options: object) -> Path:
    """Cameras in a row, 0.1 apart, in front of a wall at depth 1."""
    pose = np.zeros((views, 9))
    pose[:, 0] = -0.1 * np.arange(views)
    pose[:, 6:] = 1.0, 0.8, 1.1
    outputs = {"pose_enc": pose, "depth": np.ones((views, *size)), "depth_conf": np.full((views, *size), 3.0)}
    return constant(path, "vggt", {"images": (views, 3, *size)}, outputs, **options)


def moge2(
    path: Path, size: tuple[int, int] = (48, 64), tokens: bool = False, mask: float = 1.0, scale: float = 1.0
) -> Path:
    """A wall at z = 2 times `scale` with a wrong shift, seen by a camera 60 degrees wide; depth is valid with
    probability `mask`.
    """
    height, width = size
    focal = 0.866 * width
    x, y = np.meshgrid(np.arange(width) - 0.5 * (width - 1), np.arange(height) - 0.5 * (height - 1))
    points = np.stack([x / focal * 2, y / focal * 2, np.full(x.shape, 1.5)], axis=-1)
    inputs: dict[str, Shape] = {"image": (1, 3, *size)}
    if tokens:
        inputs["num_tokens"] = ()
    outputs = {"points": points[None], "mask": np.full((1, *size), mask), "metric_scale": np.full(1, scale)}
    return constant(path, "moge2", inputs, outputs)


def letr(
    path: Path,
    size: tuple[int, int] = (48, 64),
    lines: Sequence[Sequence[float]] | None = None,
    dtype: type = np.float32,
) -> Path:
    """The given lines (x0 y0 x1 y1 in [0, 1]) with scores above 0.7, and one below."""
    lines = [(0.1, 0.2, 0.8, 0.3), (0.3, 0.1, 0.35, 0.9)] if lines is None else lines
    logits = [(3.0, 0.0)] * len(lines) + [(0.0, 0.0)]
    outputs = {"pred_logits": np.array([logits]), "pred_lines": np.array([[*lines, (0.5, 0.5, 0.9, 0.9)]])}
    return constant(path, "letr", {"image": (1, 3, *size)}, outputs, dtype=dtype)


def mlsd(path: Path, segments: Sequence[Sequence[float]] = ((100, 80, 60, 70, 140, 90),)) -> Path:
    """Maps with a peak at (x, y) and ends x0 y0 x1 y1, in pixels of the map, for each segment."""
    maps = np.zeros((1, 9, 256, 256))
    maps[0, 0] = -8.0
    for x, y, x0, y0, x1, y1 in segments:
        maps[0, :5, int(y), int(x)] = 2.0, x0 - x, y0 - y, x1 - x, y1 - y
    return constant(path, "mlsd", {"image": (1, 4, 512, 512)}, {"maps": maps})


def dinov3(path: Path, size: tuple[int, int] = (48, 64), channels: int = 8, heads: int = 2) -> Path:
    """Descriptors: `channels` fixed random filters of each patch. Attention: softmax of their energy, in every head."""
    rows, columns = size[0] // 16, size[1] // 16
    filters = np.random.default_rng(0).normal(0, 0.05, (channels, 3, 16, 16)).astype(np.float32)
    nodes = [
        helper.make_node("Conv", ["image", "filters"], ["grid"], kernel_shape=[16, 16], strides=[16, 16]),
        helper.make_node("Reshape", ["grid", "flat"], ["channels first"]),
        helper.make_node("Transpose", ["channels first"], ["patch_descriptors"], perm=[0, 2, 1]),
        helper.make_node("ReduceL2", ["channels first", "axis"], ["energy"], keepdims=1),
        helper.make_node("Concat", ["prefix", "energy"], ["all tokens"], axis=2),
        helper.make_node("Softmax", ["all tokens"], ["one row"], axis=2),
        helper.make_node("Unsqueeze", ["one row", "axis"], ["one head"]),
        helper.make_node("Expand", ["one head", "rows"], ["attention"]),
    ]
    constants = {
        "filters": filters,
        "flat": np.array([1, channels, rows * columns]),
        "axis": np.array([1]),
        "prefix": np.zeros((1, 1, 5), np.float32),
        "rows": np.array([1, heads, 5, 5 + rows * columns]),
    }
    count = rows * columns
    outputs = {"patch_descriptors": (1, count, channels), "attention": (1, heads, 5, 5 + count)}
    return save(path, nodes, {"image": (1, 3, *size)}, outputs, constants, "dinov3")


def mast3r_encoder(path: Path, size: tuple[int, int] = (48, 64)) -> Path:
    """Features that are the patch's own 16 x 16 x 3 values."""
    rows, columns = size[0] // 16, size[1] // 16
    nodes = [
        helper.make_node("SpaceToDepth", ["image"], ["grid"], blocksize=16),
        helper.make_node("Reshape", ["grid", "flat"], ["channels first"]),
        helper.make_node("Transpose", ["channels first"], ["features"], perm=[0, 2, 1]),
    ]
    constants = {"flat": np.array([1, 768, rows * columns])}
    return save(
        path, nodes, {"image": (1, 3, *size)}, {"features": (1, rows * columns, 768)}, constants, "mast3r_encoder"
    )


def mast3r_decoder(path: Path, size: tuple[int, int] = (48, 64), reach: int = 7) -> Path:
    """Descriptors: 24 fixed random filters of the image around each pixel, of unit length: they match by appearance."""
    rows, columns = size[0] // 16, size[1] // 16
    constants = {
        "filters": _filters(24, reach),
        "grid shape": np.array([1, 768, rows, columns]),
        "axis": np.array([1]),
        "points": np.ones((1, *size, 3), np.float32),
        "confidence": np.full((1, *size), 2.0, np.float32),
    }
    nodes = [node for view in (1, 2) for node in _decoded(view, reach)]
    outputs: dict[str, Shape] = {}
    for view in (1, 2):
        outputs |= {f"points_{view}": (1, *size, 3), f"confidence_{view}": (1, *size)}
        outputs |= {f"descriptors_{view}": (1, *size, 24), f"descriptor_confidence_{view}": (1, *size)}
    inputs = {f"features_{view}": (1, rows * columns, 768) for view in (1, 2)}
    return save(path, nodes, inputs, outputs, constants, "mast3r_decoder")


def alike(path: Path, size: Sequence[int | str] = (96, 128), channels: int = 24) -> Path:
    """Scores: how much a pixel differs from its surroundings. Descriptors: random filters of the image around it."""
    constants = {**_spot(), "filters": _filters(channels)}
    nodes = [*_scores(), *_vectors("image", "descriptors")]
    outputs = {"scores": (1, 1, *size), "descriptors": (1, channels, *size)}
    return save(path, nodes, {"image": (1, 3, *size)}, outputs, constants, "alike")


def xfeat(path: Path, size: tuple[int, int] = (96, 128)) -> Path:
    """The same, with descriptors of 8 x 8 blocks."""
    blocks = (1, 64, size[0] // 8, size[1] // 8)
    pool = helper.make_node("AveragePool", ["every pixel"], ["block_descriptors"], kernel_shape=[8, 8], strides=[8, 8])
    nodes = [*_scores(), *_vectors("image", "every pixel"), pool]
    outputs = {"scores": (1, 1, *size), "block_descriptors": blocks}
    constants = {**_spot(), "filters": _filters(64)}
    return save(path, nodes, {"image": (1, 3, *size)}, outputs, constants, "xfeat")


def _spot() -> dict[str, np.ndarray]:
    """A difference of two Gaussians over all colours, and the border that it needs."""
    y, x = np.mgrid[-4:5, -4:5]
    near, far = (np.exp(-0.5 * (x**2 + y**2) / sigma**2) for sigma in (1.0, 2.0))
    spot = np.tile(near / near.sum() - far / far.sum(), (1, 3, 1, 1)).astype(np.float32)
    return {"spot": spot, "border": np.array([0, 0, 4, 4, 0, 0, 4, 4])}


def _filters(channels: int, reach: int = 7) -> np.ndarray:
    filters = np.random.default_rng(1).normal(0, 1, (channels, 3, 2 * reach + 1, 2 * reach + 1))
    return (filters - filters.mean(axis=(2, 3), keepdims=True)).astype(np.float32)


def _scores() -> list[onnx.NodeProto]:
    return [
        helper.make_node("Pad", ["image", "border"], ["framed"], mode="edge"),
        helper.make_node("Conv", ["framed", "spot"], ["response"]),
        helper.make_node("Abs", ["response"], ["scores"]),
    ]


def _vectors(image: str, name: str) -> list[onnx.NodeProto]:
    return [
        helper.make_node("Conv", [image, "filters"], ["maps"], pads=[7] * 4),
        helper.make_node("LpNormalization", ["maps"], [name], axis=1, p=2),
    ]


def _decoded(view: int, reach: int) -> list[onnx.NodeProto]:
    name = lambda what: f"{what} {view}"
    return [
        helper.make_node("Transpose", [f"features_{view}"], [name("tokens")], perm=[0, 2, 1]),
        helper.make_node("Reshape", [name("tokens"), "grid shape"], [name("grid")]),
        helper.make_node("DepthToSpace", [name("grid")], [name("image")], blocksize=16, mode="DCR"),
        helper.make_node("Conv", [name("image"), "filters"], [name("maps")], pads=[reach] * 4),
        helper.make_node("LpNormalization", [name("maps")], [name("unit")], axis=1, p=2),
        helper.make_node("Transpose", [name("unit")], [f"descriptors_{view}"], perm=[0, 2, 3, 1]),
        helper.make_node("Identity", ["points"], [f"points_{view}"]),
        helper.make_node("Identity", ["confidence"], [f"confidence_{view}"]),
        helper.make_node("Identity", ["confidence"], [f"descriptor_confidence_{view}"]),
    ]
