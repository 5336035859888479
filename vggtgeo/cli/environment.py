"""The environment of a command: flags of JAX, and characters that the terminal cannot show."""

from __future__ import annotations

import io
import os
import sys

from vggtgeo.io.jax_environment import jax_environment


def set_jax_flags() -> None:
    """Set environment variables, which JAX reads on import; those of the user take precedence."""
    for name, value in jax_environment().items():
        os.environ.setdefault(name, value)


def show_unknown_characters() -> None:
    """Print `?` for characters that standard output or error cannot encode."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # not the stream of a notebook
            stream.reconfigure(errors="replace")
