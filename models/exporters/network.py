"""The network of one export: its request, the published code and the optional packages that it needs, its weights (from
a checkpoint, every one of them, or drawn at random), and the graph that it gives.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib
import pickle
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.io.errors import InputError, install_hint

_LONGEST = 2000
"""Characters of torch's error, which lists each wrong weight."""
_STATES = ("model", "state_dict", "teacher")
"""Keys under which published checkpoints keep the weights."""


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


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Return the content of a PyTorch checkpoint, read without running code from it, mapped rather than copied.

    Raises `InputError` if it is missing, or not one.
    """
    torch = load("torch")
    try:
        with path.open("rb") as handle:
            is_zip = handle.read(2) == b"PK"  # files of old versions of torch are not, and cannot be mapped
        # some checkpoints keep their training options beside the weights
        with torch.serialization.safe_globals([argparse.Namespace]), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=is_zip)
        return dict(content)
    # torch's message is left out: its advice is to run what the file holds.
    except (RuntimeError, TypeError, ValueError, pickle.UnpicklingError, EOFError, OSError):
        raise InputError(
            f"`--checkpoint` {path} cannot be read, expected the published weights: a dictionary in a .pt or .pth file"
        ) from None


def fill_weights(module: Any, request: Request, fits: str) -> None:
    """Load the request's checkpoint into `module`, or make its random weights tell errors apart.

    fits: what the module is, for the message. Raises `InputError` unless names and shapes of the weights agree
    exactly; with `request.allow_extra`, weights that the module has no place for are left out, as the published code of
    some networks does.
    """
    if request.checkpoint is None:
        liven(module)
    else:
        content = read_checkpoint(request.checkpoint)
        inner = next((content[key] for key in _STATES if isinstance(content.get(key), Mapping)), content)
        weights = {name.removeprefix("module."): value for name, value in inner.items()}
        if request.allow_extra:
            weights = {name: weights[name] for name in module.state_dict() if name in weights}
        try:
            module.load_state_dict(weights, strict=True)
        except RuntimeError as error:  # names all that is missing, superfluous, or of another shape
            raise InputError(
                f"`--checkpoint` {request.checkpoint} does not hold the weights of {fits}: {str(error)[:_LONGEST]}; "
                "give the checkpoint of this network and `--variant`, or allow superfluous ones by "
                "`--allow-extra-weights`"
            ) from None
    module.eval().requires_grad_(False)


def liven(module: Any) -> None:
    """Raise the layer scales of a freshly initialised transformer to 0.5 .. 1.

    They start at 1e-5 to 1e-2, so that every block is almost the identity, and an error in one would hide below any
    tolerance.
    """
    torch = load("torch")
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            if name.endswith(".gamma"):
                parameter.uniform_(0.5, 1.0)


def checkpoint_identity(checkpoint: Path | None) -> str:
    """Return `random`, or `sha256:` and the digest of the checkpoint."""
    if checkpoint is None:
        return "random"
    with open(checkpoint, "rb") as handle:
        return f"sha256:{hashlib.file_digest(handle, 'sha256').hexdigest()}"
