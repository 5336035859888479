"""Define the exceptions and warnings about invalid input, and format their messages."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any


class InputError(ValueError):
    """Invalid input of the user (a path, a file, a number); the message says what is wrong and what to do.

    Example:
        >>> import vggtgeo as vg
        >>> vg.simulate("moon")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `scene` must be one of room, office, ..., got 'moon'

    """


class InputWarning(UserWarning):
    """A part of the user's input is ignored or assumed, and the run continues; the message names it."""


class NoteWarning(InputWarning):
    """Information on how an input was read (an IMU is ignored, one of two depths is chosen); nothing is wrong."""


class GuessedCameraWarning(InputWarning):
    """The camera is unknown and will be estimated: normal for a video, but not for a recording with a calibration."""


class UnusableDepthWarning(InputWarning):
    """No depth image has a valid pixel, probably because its unit is another one."""


class LeftOutWarning(InputWarning):
    """Frames of the input are left out; `frames` is their number."""

    def __init__(self, message: str, frames: int = 1) -> None:
        super().__init__(message)
        self.frames = frames


def warn(message: str | InputWarning, category: type[InputWarning] = InputWarning) -> None:
    """Warn about the input; the warning points to the caller of the function that calls this one."""
    warnings.warn(message, category, stacklevel=3)


MAX_LENGTH = 1200
"""Maximum characters of a line: a message may quote a whole damaged file."""


def one_line(message: str) -> str:
    """Return `message` without line breaks and control characters, shortened in the middle to `MAX_LENGTH` characters.

    Control characters are removed since a file name may contain, for example, a code that clears the screen.
    """
    text = "".join(sign if sign.isprintable() else f"\\x{ord(sign):02x}" for sign in " ".join(message.split()))
    half = MAX_LENGTH // 2
    return text if len(text) <= MAX_LENGTH else f"{text[:half]} ... {text[-half:]}"


_lock = Lock()


class _CollectingShow:
    """Function for `warnings.showwarning` that also adds warnings about the input to `lists`."""

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

    Python has one function to show warnings for all threads, so if several threads collect at the same time, each gets
    the warnings of all. That is better than missing one: the verdict of a run depends on its warnings.
    """
    collected: list[Warning | str] = []
    with _lock:
        showing = warnings.showwarning
        if not isinstance(showing, _CollectingShow):
            showing = warnings.showwarning = _CollectingShow(showing)
        showing.lists.append(collected)
    try:
        yield collected
    finally:
        with _lock:  # threads may end in any order
            showing.lists[:] = [other for other in showing.lists if other is not collected]
            if not showing.lists and warnings.showwarning is showing:
                warnings.showwarning = showing.as_before


def install_hint(extra: str) -> str:
    """Return how to install an extra of `pyproject.toml`, in a clone and with a released package."""
    clone, release = f"pip install -e '.[{extra}]'", f"pip install 'vggtgeo[{extra}]'"
    return f"install the extra `{extra}`: `{clone}` in a clone, `{release}` elsewhere"


def reinstall_hint(package: str, version: str) -> str:
    """Return how to restore a package whose files another package has overwritten."""
    return f"`pip install --force-reinstall --no-deps {package}=={version}` restores them"
