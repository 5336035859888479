"""What the library says about input that it cannot use: one exception, one warning."""

from vggtgeo.io.one_line import shortened


class InputError(ValueError):
    """Something the user gave (a path, a file, a number) is wrong; the message says what, and what to do.

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
    """Something the user gave was left out or assumed, and the work goes on; the message names it."""

    def __str__(self) -> str:
        return shortened(super().__str__())


class NoteWarning(InputWarning):
    """What a reader did as its layout wants it (an IMU left out, the better of two depths taken): nothing is wrong."""


class GuessedCameraWarning(InputWarning):
    """Nobody gave the camera: a guess is where the run starts."""


class UnusableDepthWarning(InputWarning):
    """None of the depth that is there is from where a room's can be, in the unit that its files have by convention."""


class LeftOutWarning(InputWarning):
    """Frames of the input were left out; `frames` counts them."""

    def __init__(self, message: str, frames: int = 1) -> None:
        super().__init__(message)
        self.frames = frames
