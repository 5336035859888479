"""A data set of windows on the disk: for training through the solver with more windows than fit into memory.

A folder with one file a window (`vggtgeo.save_problem`, no pickles) and one of its labels. All windows have one padded
shape, so that any of them can be stacked, and the solver is compiled once. It is a map-style data set, `len(d)` and
`d[i]`, with numpy leaves, read without JAX, so that the loaders of grain and torch may read it in processes of their
own, forked ones too (collate function: `vggtgeo.learning.stack_windows`); `batches` needs neither.
"""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import jax
import numpy as np

from vggtgeo.bundle.padding import SlotIndex
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.problem_file import load_arrays, save_problem
from vggtgeo.datasets.frame import Frame
from vggtgeo.datasets.image_files import path_exists
from vggtgeo.io.argument_checks import path_of
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import whole_text, write_json
from vggtgeo.io.persistence import Format
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.state import Slam

_INDEX = "windows.json"
VERSION = 2
LABELS = Format("set of labels", 1, {}, compressed=True)


class LabelledWindow(NamedTuple):
    """One window, or, with a leading axis on every array, a batch. labels: arrays by name, whatever was stored."""

    problem: Problem
    initial: State
    labels: dict[str, Any]


PackedWindow = tuple[Problem, State, SlotIndex]
"""What `vggtgeo.pack` gives."""


class WindowWriter:
    """Writes windows into a folder, one at a time; a context, at whose end the folder is complete.

    InputError where a window has another padded shape than the first, or other labels.

    Example:
        >>> import tempfile, vggtgeo as vg
        >>> size = vg.PaddedSize(keyframes=3, points=40, lines=0, degree=2)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with vg.learning.WindowWriter(folder) as writer:
        ...         for seed in range(4):
        ...             window = vg.simulate_window(3, points=8, lines=0, seed=seed)
        ...             writer.add(window.pack(size=size), poses=window.poses)
        ...     data = vg.learning.WindowDataset.open(folder)
        ...     batch = next(data.batches(2, seed=1))
        >>> len(data), batch.initial.intrinsics.shape, batch.labels["poses"].shape
        (4, (2, 4), (2, 3, 7))

    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = path_of("folder", folder)
        self.count = 0
        self._shape: Any = None

    def add(self, window: PackedWindow, **labels: Any) -> None:
        """Write a packed window and its labels (arrays of one shape for all windows)."""
        problem, initial, index = window
        arrays = {name: np.asarray(value) for name, value in labels.items()}
        if not self.count and path_exists(self.folder / _name(0)):
            raise InputError(f"`{self.folder}` holds windows already; give a new folder")
        leaves, structure = jax.tree.flatten((problem, initial))
        kinds = [(np.shape(leaf), np.asarray(leaf).dtype) for leaf in leaves]
        shape = structure, kinds, {name: array.shape for name, array in arrays.items()}
        if self._shape not in (None, shape):
            raise InputError(
                f"window {self.count} has another padded shape, other terms or other labels than window 0; pack all "
                "of them with one `size` (`vggtgeo.PaddedSize`) and give the same labels"
            )
        self._shape = shape
        save_problem(self.folder / _name(self.count), problem, initial, index)
        LABELS.write(self.folder / f"{self.count:07d}.labels.npz", arrays)
        self.count += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            write_json(self.folder / _INDEX, {"version": VERSION, "windows": self.count})


class RunWindows(Callback):
    """Writes every window that a run adjusts: give it to `vggtgeo.reconstruct` as a callback, close `writer` after it.

    label: of the state that has a window adjusted (`slam.window.solved`), for labels such as its keyframes' true poses.

    Example:
        >>> with vg.learning.WindowWriter("windows") as writer:  # doctest: +SKIP
        ...     vg.reconstruct("clip.mp4", callbacks=[vg.learning.RunWindows(writer)])

    """

    def __init__(self, writer: WindowWriter, label: Callable[[Slam], Mapping[str, Any]] | None = None) -> None:
        self._writer, self._label = writer, label
        self._last: object = None

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        self._write(slam)

    def on_adjust(self, slam: Slam) -> None:
        self._write(slam)

    def _write(self, slam: Slam) -> None:
        if slam.window.solved is None or slam.window.solved is self._last:
            return
        self._last = slam.window.solved
        adjustment, _ = slam.window.solved
        room = len(adjustment.initial.poses.wxyz_xyz) - len(adjustment.keyframes)
        # -1 where the window has room for more keyframes.
        labels = {"keyframes": np.array([*adjustment.keyframes, *[-1] * room])}
        more = self._label(slam) if self._label is not None else {}
        self._writer.add((adjustment.problem, adjustment.initial, adjustment.index), **labels, **more)


@dataclass(frozen=True)
class WindowDataset:
    """Windows in a folder.

    Fields:
        folder: where `WindowWriter` put them.
        count: how many.
        terms: classes of your own that the problems hold.

    Example:
        >>> vg.learning.WindowDataset.open("no/such/folder")  # see `WindowWriter` for one that is there
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `no/such/folder` is no complete folder of windows; write one first

    """

    folder: Path
    count: int
    terms: tuple[type, ...] = ()

    @classmethod
    def open(cls, folder: str | os.PathLike[str], terms: Sequence[type] = ()) -> Self:
        """Read the index of `WindowWriter`; raise InputError if it is missing, since the writer did not finish."""
        place = path_of("folder", folder)
        try:
            index = json.loads(whole_text(place / _INDEX, errors="strict"))
            version, count = index["version"], index["windows"]
        except (ValueError, KeyError, TypeError, RecursionError):
            raise InputError(f"`{place}` is no complete folder of windows; write one first") from None
        if version != VERSION:
            raise InputError(f"`{place / _INDEX}` is of version {version!r:.20}; this program reads {VERSION}")
        return cls(place, count, tuple(terms))

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, row: int) -> LabelledWindow:
        """Return window `row`, read from the disk, with numpy leaves."""
        if not 0 <= row < self.count:
            raise IndexError(f"window {row} of {self.count}")
        problem, initial, _ = load_arrays(self.folder / _name(row), self.terms)
        labels, _ = LABELS.read(self.folder / f"{row:07d}.labels.npz")
        return LabelledWindow(problem, initial, labels)

    def order(self, seed: int, epoch: int = 0) -> np.ndarray:
        """Return every row once, int [n], shuffled; it follows from `seed` and `epoch` alone."""
        return np.random.default_rng([seed, epoch, 13]).permutation(self.count)

    def batches(
        self, size: int, *, seed: int | None = 0, epochs: int | None = 1, share: tuple[int, int] = (0, 1)
    ) -> Iterator[LabelledWindow]:
        """Yield stacked windows, `size` at a time; two batches are in memory: the next one is read while one is used.

        Args:
            size: of a batch; what is left at the end of an epoch is left out, as another shape would be compiled anew.
            seed: of the order; None keeps that of the folder.
            epochs: how often each window comes; None never ends.
            share: `(k, n)`, the k-th of n equal parts of each epoch, for one of n processes.

        Raises:
            InputError: a batch larger than the share, or an impossible share.

        """
        part, parts = share
        if not 0 <= part < parts:
            raise InputError(f"`share` must be (k, n) with 0 <= k < n, got {share}")
        if not 1 <= size <= self.count // parts:
            raise InputError(f"`size` is {size}; this share has {self.count // parts} windows")
        return self._read(self._rows(size, seed, epochs, part, parts))

    def _rows(self, size: int, seed: int | None, epochs: int | None, part: int, parts: int) -> Iterator[np.ndarray]:
        for epoch in itertools.count() if epochs is None else range(epochs):
            order = np.arange(self.count) if seed is None else self.order(seed, epoch)
            own = order[: self.count // parts * parts][part::parts]
            yield from own[: len(own) // size * size].reshape(-1, size)

    def _read(self, rows: Iterable[np.ndarray]) -> Iterator[LabelledWindow]:
        with ThreadPoolExecutor(1) as pool:
            coming = None
            for chosen in rows:
                following = pool.submit(lambda chosen: stack_windows([self[int(row)] for row in chosen]), chosen)
                if coming is not None:
                    yield coming.result()
                coming = following
            if coming is not None:
                yield coming.result()


def stack_windows(windows: Sequence[LabelledWindow]) -> LabelledWindow:
    """Return windows with a leading axis on every array: what a loader calls its collate function.

    Example:
        >>> from torch.utils.data import DataLoader  # doctest: +SKIP
        >>> data = vg.learning.WindowDataset.open("windows")  # doctest: +SKIP
        >>> loader = DataLoader(data, batch_size=8, collate_fn=vg.learning.stack_windows)  # doctest: +SKIP

    """
    stack: LabelledWindow = jax.tree.map(lambda *leaves: np.stack(leaves), *windows)
    return stack


def _name(row: int) -> str:
    return f"{row:07d}.npz"
