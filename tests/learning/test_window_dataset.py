"""Windows on the disk: what was written is read, in an order that the seed tells, without holding all of it."""

import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from reported import raises

import vggtgeo as vg
from vggtgeo.learning.window_dataset import RunWindows, WindowDataset, WindowWriter, stack_windows

SIZE = vg.PaddedSize(keyframes=3, points=16, lines=0, degree=2)
COUNT = 7


def _window(seed: int) -> vg.data.SimulatedWindow:
    return vg.simulate_window(3, points=8 + seed % 3, lines=0, seed=seed)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven simulated windows with their true poses."""
    place = tmp_path_factory.mktemp("windows")
    with WindowWriter(place) as writer:
        for seed in range(COUNT):
            window = _window(seed)
            writer.add(window.pack(size=SIZE), poses=window.poses, seed=seed)
    return place


def test_a_window_comes_back_as_it_was(folder: Path) -> None:
    # Proves that every leaf of problem and state, and the labels, are those that were written. Oracle: packed again.
    data = WindowDataset.open(folder)
    assert len(data) == COUNT
    for row in (0, 5):
        found = data[row]
        expected = _window(row).pack(size=SIZE)[:2]
        for a, b in zip(jax.tree.leaves((found.problem, found.initial)), jax.tree.leaves(expected), strict=True):
            assert isinstance(a, np.ndarray)
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(found.labels["poses"], _window(row).poses)
    with pytest.raises(IndexError):
        data[COUNT]


def test_the_order_is_that_of_seed_and_epoch(folder: Path) -> None:
    # Proves that each epoch has every window once, in another order, the same for the same seed. Oracle: the labels.
    data = WindowDataset.open(folder)
    seeds = lambda **options: [int(n) for batch in data.batches(1, **options) for n in batch.labels["seed"]]
    assert seeds(seed=None) == list(range(COUNT))
    first = seeds(seed=3, epochs=2)
    assert first == seeds(seed=3, epochs=2)
    assert sorted(first[:COUNT]) == sorted(first[COUNT:]) == list(range(COUNT))
    assert first[:COUNT] != first[COUNT:]
    assert first[:COUNT] != seeds(seed=4)


def test_shares_are_apart_and_alike(folder: Path) -> None:
    # Proves that two processes see different windows, equally many, and that batches have one size. Oracle: the labels.
    data = WindowDataset.open(folder)
    shares = [list(data.batches(2, seed=1, share=(k, 2))) for k in (0, 1)]
    seen = [{int(n) for batch in share for n in batch.labels["seed"]} for share in shares]
    assert [len(share) for share in shares] == [1, 1]
    assert not seen[0] & seen[1]
    with raises("size", 4, 3):
        data.batches(4, share=(0, 2))
    with raises("share"):
        data.batches(1, share=(2, 2))


def test_only_two_batches_are_read_ahead(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that windows are read as they are asked for. Oracle: the reads counted.
    read: list[int] = []
    plain = WindowDataset.__getitem__
    monkeypatch.setattr(WindowDataset, "__getitem__", lambda self, row: read.append(row) or plain(self, row))
    batches = WindowDataset.open(folder).batches(1, seed=None, epochs=None)
    next(batches)
    next(batches)
    assert len(read) <= 4
    batches.close()


def test_a_batch_can_be_solved(folder: Path) -> None:
    # Proves that a batch is what `solve_batch` takes. Oracle: energies fall, and poses come nearer to the labels.
    batch = next(WindowDataset.open(folder).batches(2, seed=0))
    solution = jax.jit(vg.batches.solve_batch)(batch.problem, batch.initial)
    off = lambda state: np.linalg.norm(np.asarray(state.poses.wxyz_xyz)[..., 4:] - batch.labels["poses"][..., 4:])
    assert off(solution.state) < 0.5 * off(batch.initial)


FORKED = """
import multiprocessing, sys, warnings
import jax
import vggtgeo as vg

warnings.simplefilter("ignore")  # JAX's own about forks
data = vg.learning.WindowDataset.open(sys.argv[1])
jax.block_until_ready(jax.jit(lambda x: x @ x)(jax.numpy.ones((500, 500))))

def read(row):
    return vg.learning.stack_windows([data[row], data[row + 1]]).labels["seed"].tolist()

with multiprocessing.get_context("fork").Pool(2) as pool:
    print(pool.map_async(read, range(4)).get(30))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems start the workers of a loader anew")
def test_forked_workers_read_it(folder: Path) -> None:
    # Proves that a loader's worker, forked from a process that has used JAX, does not wait for ever: what torch's
    # loader does on Linux. Oracle: the labels.
    ran = subprocess.run([sys.executable, "-c", FORKED, folder], capture_output=True, text=True, check=False)
    assert ran.stdout.strip() == "[[0, 1], [1, 2], [2, 3], [3, 4]]", ran.stderr


def test_grain_takes_it_as_it_is(folder: Path) -> None:
    # Proves that grain's loader shuffles and batches the data set: every window once an epoch, stacked as `batches`
    # stacks it. Oracle: the labels, and the windows themselves.
    grain = pytest.importorskip("grain.python", reason="grain is not installed")
    data = WindowDataset.open(folder)
    loaded = grain.MapDataset.source(data).shuffle(seed=3).batch(1, batch_fn=stack_windows)
    seeds = [int(batch.labels["seed"][0]) for batch in loaded]
    assert sorted(seeds) == list(range(COUNT))
    assert seeds != list(range(COUNT))
    expected = stack_windows([data[seeds[0]]])
    for a, b in zip(jax.tree.leaves(loaded[0].problem), jax.tree.leaves(expected.problem), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow  # compiles the pipeline
def test_the_windows_of_a_run(tmp_path: Path) -> None:
    # Proves that every window that a run adjusts is stored, and solves to what the run made of it. Oracle: the energy
    # that the run reports.
    settings = vg.SlamSettings(
        window=vg.settings.WindowSettings(size=3, point_slots=32, line_slots=12),
        refinement=vg.settings.GlobalMapSettings(global_adjustment=False),
    )
    sequence = vg.simulate("room", 20, size=(160, 120), rate=4.0)
    with WindowWriter(tmp_path) as writer:
        result = vg.reconstruct(sequence, settings=settings, callbacks=[RunWindows(writer)])
    data = WindowDataset.open(tmp_path)
    assert len(data) == len(result.record.windows) > 1
    last = data[len(data) - 1]
    energy = float(vg.energy(last.problem, last.initial))
    assert energy == pytest.approx(result.record.windows[-1].energy[0], rel=1e-6)
