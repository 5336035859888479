"""JAX's global settings for the program; a library call never touches them."""

import os

from vggtgeo.io.jax_environment import jax_environment


def set_jax_flags() -> None:
    """Settings go through environment variables, which JAX reads when it is imported: most of `--help` never does. A
    setting of the user's environment wins.
    """
    for name, value in jax_environment().items():
        os.environ.setdefault(name, value)
