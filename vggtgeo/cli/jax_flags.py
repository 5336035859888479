"""JAX's global settings for the program; a library call never touches them."""

import os

from vggtgeo.io.errors import InputError
from vggtgeo.io.jax_environment import jax_environment


def set_jax_flags() -> None:
    """Settings go through environment variables, which JAX reads when it is imported: most of `--help` never does. A
    setting of the user's environment wins.
    """
    for name, value in jax_environment().items():
        os.environ.setdefault(name, value)


def check_jit(command: str) -> None:
    """InputError where JAX is told to compile nothing: a solve then fails after all its work, a run takes days."""
    asked = os.environ.get("JAX_DISABLE_JIT", "").lower() in ("y", "yes", "t", "true", "on", "1")
    if asked and command in ("run", "demo", "solve", "bench"):
        raise InputError(f"the environment variable `JAX_DISABLE_JIT` is set; `{command}` is compiled: unset it")
