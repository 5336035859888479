"""JAX's global settings for the program; a library call never touches them."""

import importlib.metadata
import importlib.util
import mmap
import os
import re
from pathlib import Path

from vggtgeo.io.errors import InputError
from vggtgeo.io.jax_environment import jax_environment


def set_jax_flags() -> None:
    """Settings go through environment variables, which JAX reads when it is imported: most of `--help` never does. A
    setting of the user's environment wins.
    """
    for name, value in jax_environment().items():
        os.environ.setdefault(name, value)


_COMPILED = ("run", "demo", "solve", "bench")


def check_jit(command: str) -> None:
    """InputError where JAX is told to compile nothing: a solve then fails after all its work, a run takes days."""
    asked = os.environ.get("JAX_DISABLE_JIT", "").lower() in ("y", "yes", "t", "true", "on", "1")
    if asked and command in _COMPILED:
        raise InputError(f"the environment variable `JAX_DISABLE_JIT` is set; `{command}` is compiled: unset it")


def check_xla_flags(command: str) -> None:
    """InputError for a flag in `XLA_FLAGS` that JAX does not know, and would end the process for."""
    names = re.findall(r"(?:^|\s)--(\w+)", os.environ.get("XLA_FLAGS", ""))
    library = _jax_library() if names and command in _COMPILED else None
    unknown = [name for name in names if library is not None and not _holds(library, name)]
    if unknown:
        version = importlib.metadata.version("jaxlib")
        raise InputError(
            f"the environment variable `XLA_FLAGS` has `--{unknown[0]}`, which jaxlib {version} does not know; leave "
            "it out, or unset the variable"
        )


def _jax_library() -> Path | None:
    """The file that knows the flags: by far the largest of the package."""
    found = importlib.util.find_spec("jaxlib")
    folders = [Path(place) for place in (found.submodule_search_locations or ())] if found else []
    files = [file for folder in folders for file in folder.iterdir() if file.suffix in (".so", ".pyd", ".dylib")]
    return max(files, key=lambda file: file.stat().st_size, default=None)


def _holds(library: Path, name: str) -> bool:
    """Whether a text of this name is in it: 0.05 s for one that is, up to 0.8 for one that is not."""
    with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return content.find(name.encode() + b"\0") >= 0
