"""Errors and warnings of the package, tested by their type and by what they name, never by their sentences."""

from __future__ import annotations

import re
from typing import Any

import pytest

from vggtgeo.io.errors import InputError, InputWarning


def pattern(*named: object) -> str:
    """A pattern of messages in which each of these occurs: the argument or file, and the offending value."""
    return "(?s)" + "".join(f"(?=.*{re.escape(str(one))})" for one in named)


def raises(*named: object, error: type[Exception] = InputError) -> Any:
    """Expect an error whose message names these; a context manager, as `pytest.raises`."""
    return pytest.raises(error, match=pattern(*named))


def warns(*named: object, warning: type[Warning] = InputWarning) -> Any:
    """Expect a warning whose message names these; a context manager, as `pytest.warns`."""
    return pytest.warns(warning, match=pattern(*named))
