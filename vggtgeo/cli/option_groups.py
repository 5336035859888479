"""Option groups: parameters of a command that are dataclasses, each field an option of the command line.

Typer takes options from the parameters of a function alone. With groups a command has few parameters, and passes on
those that belong together as one value.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable, Iterator
from typing import Any


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Replace each parameter of `command` whose type is a dataclass by options, one per field.

    The order of the options is that of the parameters and fields. A parameter that is a group needs no default: its
    fields have theirs.
    """
    hints = typing.get_type_hints(command, include_extras=True)
    options = [
        option
        for parameter in inspect.signature(command).parameters.values()
        for option in _options(parameter, hints[parameter.name])
    ]
    signature = inspect.Signature(options)
    groups = {name: kind for name, kind in hints.items() if isinstance(kind, type) and dataclasses.is_dataclass(kind)}

    @functools.wraps(command)
    def with_groups(*args: Any, **kwargs: Any) -> None:
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        values = bound.arguments
        made = {
            name: kind(**{entry.name: values.pop(entry.name) for entry in dataclasses.fields(kind)})
            for name, kind in groups.items()
        }
        command(**values, **made)

    with_groups.__signature__ = signature  # type: ignore[attr-defined]
    with_groups.__annotations__ = {option.name: option.annotation for option in options}
    return with_groups


def _options(parameter: inspect.Parameter, kind: Any) -> Iterator[inspect.Parameter]:
    if not dataclasses.is_dataclass(kind):
        yield _option(parameter.name, kind, parameter.default)
        return
    hints = typing.get_type_hints(kind, include_extras=True)
    for entry in dataclasses.fields(kind):
        default = inspect.Parameter.empty if entry.default is dataclasses.MISSING else entry.default
        yield _option(entry.name, hints[entry.name], default)


def _option(name: str, kind: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=default, annotation=kind)
