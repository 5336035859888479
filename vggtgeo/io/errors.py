"""Exceptions, warnings and messages about invalid input."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any


class InputError(ValueError):
    """The user's input (a path, a file, a number) is invalid; the message says what is wrong and what to do.

    Example:
        >>> import vggtgeo as vg
        >>> vg.simulate("moon")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `scene` is 'moon'; it must be one of room, office, ...

    """


class InputWarning(UserWarning):
    """A part of the user's input is left out or assumed; the message names it, and the work continues."""


class NoteWarning(InputWarning):
    """A reader did what its layout requires (ignored an IMU, chose the better of two depths); nothing is wrong."""


class GuessedCameraWarning(InputWarning):
    """The camera is unknown and will be estimated: normal for a video, a defect of a recording with a known camera."""


class UnusableDepthWarning(InputWarning):
    """No depth is in the range of a room in the usual unit of its files."""


class LeftOutWarning(InputWarning):
    """Frames of the input are left out; `frames` is their number."""

    def __init__(self, message: str, frames: int = 1) -> None:
        super().__init__(message)
        self.frames = frames


def warn(message: str | InputWarning, category: type[InputWarning] = InputWarning) -> None:
    """Warn about the input, at the place that called the function in which this is called."""
    warnings.warn(message, category, stacklevel=3)


MAX_LENGTH = 1200
"""Characters of a line; a message may quote a whole damaged file."""


def one_line(message: str) -> str:
    """Return `message` without line breaks and control characters (a file name may contain a code that clears the
    screen), at most `MAX_LENGTH` characters, its middle left out.
    """
    text = "".join(sign if sign.isprintable() else f"\\x{ord(sign):02x}" for sign in " ".join(message.split()))
    half = MAX_LENGTH // 2
    return text if len(text) <= MAX_LENGTH else f"{text[:half]} ... {text[-half:]}"


_lock = Lock()


class _Showing:
    """Shows warnings, and adds those about the input to `lists`."""

    def __init__(self, as_before: Callable[..., Any]) -> None:
        self.as_before = as_before
        self.lists: list[list[Warning | str]] = []

    def __call__(self, message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, InputWarning):
            for collected in tuple(self.lists):
                collected.append(message)
        self.as_before(message, category, *rest, **more)


@contextmanager
def collected_warnings() -> Iterator[list[Warning | str]]:
    """Yield a list of the warnings about the input, in order, while they are shown as usual.

    Python has one function to show warnings for all threads: if several threads collect at the same time, each gets the
    warnings of all, since a run that misses a warning would be trusted too much.
    """
    collected: list[Warning | str] = []
    with _lock:
        showing = warnings.showwarning
        if not isinstance(showing, _Showing):
            showing = warnings.showwarning = _Showing(showing)
        showing.lists.append(collected)
    try:
        yield collected
    finally:
        with _lock:  # the first to begin may be the first to end
            showing.lists[:] = [other for other in showing.lists if other is not collected]
            if not showing.lists and warnings.showwarning is showing:
                warnings.showwarning = showing.as_before


def install_hint(extra: str) -> str:
    """Say how to install an extra of `pyproject.toml`, in a clone and with a released package."""
    clone, release = f"pip install -e '.[{extra}]'", f"pip install 'vggtgeo[{extra}]'"
    return f"install the extra `{extra}`: `{clone}` in a clone, `{release}` elsewhere"


def put_back_hint(package: str, version: str) -> str:
    """Return how to restore a package whose files another package has overwritten."""
    return f"`pip install --force-reinstall --no-deps {package}=={version}` puts them back"
