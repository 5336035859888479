"""The run-time checker of annotations that conftest.py applies to the whole package."""

from collections.abc import Callable
from typing import Any, Self

from beartype import BeartypeConf, beartype

_configured = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is welcome for a float, as for mypy


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check arguments and results against annotations, except for `Self`: the class is not seen here."""
    for name, hint in function.__annotations__.items():
        if hint in (Self, "Self"):
            function.__annotations__[name] = Any
    return _configured(function)
