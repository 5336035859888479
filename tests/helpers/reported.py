"""Errors and warnings of the package, tested by their type and by what they name, never by their sentences."""

from __future__ import annotations

import re
from typing import Any

import pytest

from vggtgeo.io.errors import InputError, InputWarning


def pattern(*named: object) -> str:
    """Return a pattern of messages that name each of these: the argument or file, and the offending value.

    A number is matched as a whole: `1` does not occur in `10`.
    """
    return "(?s)" + "".join(_part(str(one)) for one in named)


def _part(named: str) -> str:
    edges = (r"(?<!\w)", r"(?!\w)") if named[-1:].isdigit() and named.lstrip("-")[:1].isdigit() else ("", "")
    return f"(?=.*{edges[0]}{re.escape(named)}{edges[1]})"


def raises(*named: object, error: type[Exception] = InputError) -> Any:
    """Expect an error whose message names these; a context manager, as `pytest.raises`."""
    return pytest.raises(error, match=pattern(*named))


def warns(*named: object, warning: type[Warning] = InputWarning) -> Any:
    """Expect a warning whose message names these; a context manager, as `pytest.warns`."""
    return pytest.warns(warning, match=pattern(*named))
