"""JAX's global settings for the program, and checks of the user's; library calls do not change them."""

import importlib.metadata
import importlib.util
import mmap
import os
import re
import warnings
from pathlib import Path

from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.jax_environment import jax_environment, own_cache


def set_jax_flags() -> None:
    """Set environment variables, which JAX reads on import; those of the user take precedence."""
    for name, value in jax_environment().items():
        os.environ.setdefault(name, value)


_CACHE = "JAX_COMPILATION_CACHE_DIR"
_COMPILED = ("run", "demo", "solve", "bench")


def check_jit(command: str) -> None:
    """Raise InputError if JIT compilation is disabled: a solve would fail at its end, a run take days."""
    asked = os.environ.get("JAX_DISABLE_JIT", "").lower() in ("y", "yes", "t", "true", "on", "1")
    if asked and command in _COMPILED:
        raise InputError(f"the environment variable `JAX_DISABLE_JIT` is set, but `{command}` needs JIT: unset it")


def check_cache(command: str) -> None:
    """Raise InputError if the user's JIT cache is not a folder; warn if the program's own is not: each call would
    compile for a minute or more.
    """
    if command not in _COMPILED:
        return
    given = os.environ.get(_CACHE, "")
    if given and "://" not in given and (file := _in_the_way(Path(given))) is not None:
        raise InputError(f"the environment variable `{_CACHE}` is `{given}`, but `{file}` is not a folder; unset it")
    if not given and (file := _in_the_way(own_cache())) is not None:
        warnings.warn(
            f"`{file}` is not a folder, so compiled code cannot be cached, and each call compiles for a minute or "
            "more; move that file away",
            InputWarning,
            stacklevel=2,
        )


def _in_the_way(folder: Path | None) -> Path | None:
    """The first existing non-folder among a path and its parents."""
    places = [] if folder is None else [folder, *folder.parents]
    existing = (place for place in places if os.path.lexists(place))
    return next((place for place in existing if not place.is_dir()), None)


def check_xla_flags(command: str) -> None:
    """Raise InputError for an unknown flag in `XLA_FLAGS`, for which XLA would abort the process."""
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
    """The library that defines the flags: by far the largest file of the package."""
    found = importlib.util.find_spec("jaxlib")
    folders = [Path(place) for place in (found.submodule_search_locations or ())] if found else []
    files = [file for folder in folders for file in folder.iterdir() if file.suffix in (".so", ".pyd", ".dylib")]
    return max(files, key=lambda file: file.stat().st_size, default=None)


def _holds(library: Path, name: str) -> bool:
    """Whether the library contains this name: 0.05 s if it does, up to 0.8 s if not."""
    with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return content.find(name.encode() + b"\0") >= 0
