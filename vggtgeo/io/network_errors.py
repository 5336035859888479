"""Errors of networks as input errors: one line, no traceback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from vggtgeo.io.errors import InputError
from vggtgeo.models.onnx.file_checks import NetworkFileError
from vggtgeo.models.onnx.session import NetworkRunError


@contextmanager
def as_input_errors() -> Iterator[None]:
    """Raise `InputError` for a network that cannot be opened or fails while it runs."""
    try:
        yield
    except (NetworkFileError, NetworkRunError) as error:
        raise InputError(str(error)) from error
