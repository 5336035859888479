"""Exception and warnings about invalid input."""

from vggtgeo.io.one_line import shortened


class InputError(ValueError):
    """The user's input (a path, a file, a number) is invalid; the message says what is wrong and what to do.

    Example:
        >>> import vggtgeo as vg
        >>> vg.simulate("moon")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `scene` is 'moon'; it must be one of room, office, ...

    """

    def __str__(self) -> str:
        return shortened(super().__str__())


class InputWarning(UserWarning):
    """A part of the user's input is left out or assumed; the message names it, and the work continues."""

    def __str__(self) -> str:
        return shortened(super().__str__())


class NoteWarning(InputWarning):
    """A reader did what its layout requires (ignored an IMU, chose the better of two depths); nothing is wrong."""


class GuessedCameraWarning(InputWarning):
    """The camera is unknown; the run starts from a guess."""


class UnusableDepthWarning(InputWarning):
    """No depth is in the range of a room in the usual unit of its files."""


class LeftOutWarning(InputWarning):
    """Frames of the input are left out; `frames` is their number."""

    def __init__(self, message: str, frames: int = 1) -> None:
        super().__init__(message)
        self.frames = frames
