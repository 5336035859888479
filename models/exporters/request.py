"""One export: its request, the published code and the optional packages that it needs, and the graph that it gives."""

from __future__ import annotations

import contextlib
import importlib
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.io.errors import InputError, install_hint


def load(name: str) -> Any:
    """Return the package `name`; raise `InputError` naming the extra if it, or a dependency, is missing."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise InputError(
            f"exporting needs the package `{error.name}`, which is not installed; {install_hint('export')}"
        ) from None


@dataclass(frozen=True)
class Checkout:
    """Where a network's code lies.

    repository: owner/name, for messages. marker: a file that a checkout has, relative to one of `roots`.
    packages: top-level names that its code imports from there. roots: folders of the checkout, relative, in which
    `marker` may lie; the first that has it is imported from. hint: what to do if something that it imports is missing.
    """

    repository: str
    marker: str
    packages: tuple[str, ...]
    roots: tuple[str, ...] = (".",)
    hint: str = ""

    def root(self, source: Path) -> Path:
        """Return the folder to import from; raises `InputError` if `source` is no such checkout."""
        for folder in self.roots:
            if (source / folder / self.marker).is_file():
                return (source / folder).resolve()
        found = "no such folder" if not source.is_dir() else f"no `{self.marker}` in it"
        raise InputError(
            f"`--source` {source}: {found}; expected a checkout of {self.repository}: "
            f"git clone https://github.com/{self.repository}"
        )

    def find(self, folder: Path) -> Path | None:
        """Return the checkout among the folders in `folder`, whatever it is called, or None."""
        for candidate in sorted(path for path in folder.iterdir() if path.is_dir()):
            if any((candidate / root / self.marker).is_file() for root in self.roots):
                return candidate
        return None

    @contextlib.contextmanager
    def importable(self, source: Path) -> Iterator[Callable[[str], Any]]:
        """Import `packages` from the checkout and from nowhere else, in the block; give a function that imports one.

        It raises `InputError` if something that the module imports is missing.
        """
        root = self.root(source)
        search_path = list(sys.path)
        for name in [name for name in sys.modules if name.split(".")[0] in self.packages]:
            del sys.modules[name]
        # a namespace package (croco's `models`, say) loses against any regular one of its name later on the path
        sys.path[:] = [str(root), *(entry for entry in search_path if not _provides(entry, self.packages))]
        importlib.invalidate_caches()

        def imported(module: str) -> Any:
            try:
                return importlib.import_module(module)
            except ImportError as error:
                raise InputError(f"`--source` {source}: importing `{module}` failed: {error}; {self.hint}") from None

        try:
            yield imported
        finally:
            sys.path[:] = search_path

    def revision(self, source: Path) -> str:
        """Return `repository@commit` of the checkout, the commit `unknown` outside git."""
        try:
            command = ["git", "-C", str(source), "rev-parse", "HEAD"]
            commit = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        except (OSError, subprocess.CalledProcessError):
            commit = "unknown"
        return f"{self.repository}@{commit}"


def _provides(entry: str, packages: Sequence[str]) -> bool:
    folder = Path(entry or ".")
    return any((folder / name).is_dir() or (folder / f"{name}.py").is_file() for name in packages)


@dataclass(frozen=True)
class Request:
    """One export, already checked against its recipe.

    checkout, source: the code, and where it lies. checkpoint: the file of weights, or None for random ones drawn with
    `seed`. height, width: pixels of the input image. views: images a window (VGGT). tokens: patches inside MoGe-2.
    variant: the size of the network, one of the recipe's. half: attention and perceptrons in float16.
    allow_extra: whether the checkpoint may hold weights that the network has no place for.
    """

    checkout: Checkout
    source: Path
    checkpoint: Path | None
    height: int
    width: int
    variant: str
    views: int = 1
    tokens: int = 0
    half: bool = False
    allow_extra: bool = False
    seed: int = 0

    def random_images(self, low: float, high: float, count: int = 1) -> np.ndarray:
        """Return float32 [count, 3, height, width], uniform in [low, high]: the input on which PyTorch is repeated."""
        draw = np.random.default_rng(self.seed).uniform(low, high, (count, 3, self.height, self.width))
        return draw.astype(np.float32)

    @contextlib.contextmanager
    def code(self) -> Iterator[Callable[[str], Any]]:
        """Give a function that imports modules of the checkout, in the block; torch's random numbers are fixed."""
        with self.checkout.importable(self.source) as imported:
            load("torch").manual_seed(self.seed)
            yield imported


@dataclass(frozen=True)
class Graph:
    """A network ready to be exported.

    module: a torch module that takes the arrays of `inputs` in order and gives the outputs in order.
    inputs: example input by name, float32. published: what the published code gives for it, before any change, by
    the output's name, float32.
    """

    module: Any
    inputs: Mapping[str, np.ndarray]
    published: Mapping[str, np.ndarray]

    @classmethod
    def unchanged(
        cls, network: Any, forward: Callable[..., Any], inputs: Mapping[str, np.ndarray], names: Sequence[str]
    ) -> Graph:
        """Return the graph of a network whose published outputs, by `names`, are what `forward` gives."""
        module = as_module(network, forward)
        return cls(module, inputs, evaluate(module, inputs, names))


def evaluate(module: Any, inputs: Mapping[str, np.ndarray], names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the outputs of a torch module by `names`, in order."""
    torch = load("torch")
    with torch.inference_mode():
        outputs = module(*(torch.from_numpy(array) for array in inputs.values()))
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    return {name: output.numpy() for name, output in zip(names, outputs, strict=True)}


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
