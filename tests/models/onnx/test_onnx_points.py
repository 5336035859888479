"""MASt3R, ALIKE, XFeat and DINOv3 behind ONNX, and the cache of what networks answer."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import plane_views as views
import pytest
import tiny_networks as tiny
from vggtgeo.models.onnx import contracts
from vggtgeo.models.onnx.cache import FolderCache, MemoryCache, OutputCache, Outputs
from vggtgeo.models.onnx.dinov3 import DinoFeatures, saliency
from vggtgeo.models.onnx.fit import vectors_at
from vggtgeo.models.onnx.point_matchers import DensePointMatcher, nearest, peaks, reciprocal
from vggtgeo.models.onnx.session import Session, open_session
from vggtgeo.models.roles import DenseConfidence


def test_peaks_lie_between_pixels() -> None:
    # Proves the place of a maximum between pixels, and the least score. Oracle: a bell at a known place.
    y, x = np.mgrid[:64, :96].astype(np.float64)
    bell = np.exp(-0.5 * ((x - 40.3) ** 2 + (y - 20.8) ** 2) / 4) + 0.3 * (np.hypot(x - 70, y - 30) < 0.5)
    places, values = peaks(bell, 0.2)
    np.testing.assert_allclose(places[values.argmax()], [40.3, 20.8], atol=0.05)
    assert len(places) == 2
    assert len(peaks(bell, 0.5)[0]) == 1


@pytest.mark.parametrize("step", [1, 8, 64])
def test_vectors_are_interpolated_between_the_centres_of_cells(step: int) -> None:
    # Proves vectors of a map as large as the network's input, of one 8 times coarser and of a single cell, and beyond
    # the outermost centres. Oracle: a map that is linear in the place.
    rows, columns = (np.arange(0, side, step) + 0.5 * (step - 1) for side in (64, 128))
    grid = np.stack(np.broadcast_arrays(columns[None, :], rows[:, None], 50.0), axis=-1).astype(np.float32)
    pixels = np.array([[40.3, 20.8], [12.0, 9.5], [-0.4, 63.4], [127.0, 0.0]])
    x, y = (np.clip(place, edge[0], edge[-1]) for place, edge in zip(pixels.T, (columns, rows), strict=True))
    expected = np.column_stack([x, y, np.full(4, 50.0)])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(vectors_at(grid, pixels, (64, 128)), expected, atol=1e-5)


def test_xfeat_s_blocks_have_vectors(tmp_path: Path) -> None:
    # Proves the adapter on the other contract. Oracle: shapes.
    file = tiny.xfeat(tmp_path / "xfeat.onnx")
    features = DensePointMatcher(session=open_session(file, contracts.XFEAT)).describe(views.texture(0, (128, 96)))
    assert features.descriptors.vectors.shape == (len(features), 64)
    assert len(features) > 20


def _smooth_grid(seed: int, shape: tuple[int, int] = (24, 30)) -> np.ndarray:
    """Unit descriptors that vary smoothly, as a network's do."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    waves = rng.uniform(-0.5, 0.5, (12, 2))
    phase = waves[:, :1, None] * x + waves[:, 1:, None] * y
    grid = np.concatenate([np.sin(phase), np.cos(phase)]).transpose(1, 2, 0)
    return (grid / np.linalg.norm(grid, axis=2, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_nearest_is_the_brute_force_answer(stride: int) -> None:
    # Proves the search, coarse or not, on smooth descriptors with noisy queries. Oracle: all inner products.
    grid = _smooth_grid(0)
    rng = np.random.default_rng(1)
    queries = grid.reshape(-1, 24)[rng.choice(720, 300)] + rng.normal(0, 0.02, (300, 24)).astype(np.float32)
    brute = np.stack(np.divmod((queries @ grid.reshape(-1, 24).T).argmax(axis=1), 30)[::-1], axis=1)
    np.testing.assert_array_equal(nearest(queries.astype(np.float32), grid, stride), brute)


def test_the_way_back_ends_at_its_start_only_for_true_matches() -> None:
    # Proves the reciprocal check: where the second map lacks the start's content, the way back ends elsewhere.
    # Oracle: a shift by 4 pixels, for which the first columns have no counterpart.
    grid = _smooth_grid(0, (24, 60))
    first, second = grid[:, :40], grid[:, 4:44]
    starts = np.stack(np.meshgrid(np.arange(0, 40, 4), np.arange(2, 24, 4)), axis=-1).reshape(-1, 2)
    targets, gap = reciprocal(first, second, starts, stride=1)
    seen = starts[:, 0] >= 4
    np.testing.assert_array_equal(targets[seen], starts[seen] - [4, 0])
    assert (gap[seen] == 0).all()
    assert (gap[~seen] > 2).all()


# --- DINOv3 ------------------------------------------------------------------------------------------------------


def test_saliency_is_attention_relative_to_the_mean() -> None:
    # Proves Omega = s / (1 + s). Oracle: two heads by hand; the five prefix columns count nothing.
    attention = np.array([[0.9, 0.9, 0.9, 0.9, 0.9, 0.1, 0.3], [0, 0, 0, 0, 0, 0.3, 0.5]])
    s = np.array([0.2, 0.4]) / 0.3
    np.testing.assert_allclose(saliency(attention), s / (1 + s), rtol=1e-6)


def test_confidence_is_high_where_the_network_looks(tmp_path: Path) -> None:
    # Proves that the patch grid comes back to the image the right way round. Oracle: the tiny network attends to the
    # patches with most energy, and only one quarter of the image has any.
    image = np.full((96, 128, 3), 120, np.uint8)
    image[:48, 64:] = views.texture(0, (64, 48))
    role = DinoFeatures(open_session(tiny.dinov3(tmp_path / "dinov3.onnx", (96, 128)), contracts.DINOV3))
    assert isinstance(role, DenseConfidence)
    omega = role.confidence(image)
    assert omega.dtype == np.float32
    assert omega.shape == (96, 128)
    assert (omega >= 0).all()
    assert (omega < 1).all()
    means = [part.mean() for half in np.split(omega, 2, axis=0) for part in np.split(half, 2, axis=1)]
    assert np.argmax(means) == 1, means
    assert means[1] > 1.5 * max(means[0], means[2], means[3]), means


# --- the cache ---------------------------------------------------------------------------------------------------


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return open_session(tiny.letr(tmp_path / "letr.onnx"), contracts.LETR)


def _counted(values: Outputs) -> tuple[Callable[[], Outputs], list[int]]:
    calls: list[int] = []

    def compute() -> Outputs:
        calls.append(1)
        return values

    return compute, calls


@pytest.mark.parametrize("kind", ["memory", "folder"])
def test_what_was_asked_before_is_not_computed_again(tmp_path: Path, session: Session, kind: str) -> None:
    # Proves that equal questions are answered from the cache and any change asks again. Oracle: a count.
    cache: OutputCache = MemoryCache(9) if kind == "memory" else FolderCache(tmp_path / "cache")
    image = views.texture(0, (64, 48))
    other = image.copy()
    other[0, 0, 0] ^= 1
    compute, calls = _counted({"a": np.arange(6.0).reshape(2, 3), "b": np.array(3, np.float16)})
    images = [(image,), (other,), (image, other), (image.reshape(64, 48, 3),)]  # the last has the bytes of the first
    questions = [(("x", 2), (image,)), *((("x", 1), given) for given in images)]
    for count, (settings, images) in enumerate(questions, start=1):
        for _ in range(2):
            found = cache.get((session,), settings, images, compute)
            assert len(calls) == count, (settings, len(images))
            np.testing.assert_array_equal(found["a"], np.arange(6.0).reshape(2, 3))
            assert found["b"] == 3


def test_another_file_is_another_network(tmp_path: Path, session: Session) -> None:
    # Proves that the cache of a folder is bound to the file's content, not to its name. Oracle: two contents.
    cache = FolderCache(tmp_path / "cache")
    other = open_session(tiny.letr(tmp_path / "other.onnx", lines=[(0.1, 0.1, 0.9, 0.9)]), contracts.LETR)
    again = open_session(tiny.letr(tmp_path / "again.onnx"), contracts.LETR)
    compute, calls = _counted({"a": np.zeros(1)})
    for network, count in ((session, 1), (other, 2), (again, 2)):
        cache.get((network,), (), (), compute)
        assert len(calls) == count


def test_the_memory_forgets_the_oldest(session: Session) -> None:
    # Proves the bound on memory. Oracle: a count, and what is still known.
    cache = MemoryCache(2)
    compute, calls = _counted({"a": np.zeros(1)})
    for settings in ((1,), (2,), (1,), (3,), (1,), (2,)):
        cache.get((session,), settings, (), compute)
    assert len(calls) == 4
