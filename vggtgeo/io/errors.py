"""What the library says about input that it cannot use: one exception, one warning."""


class InputError(ValueError):
    """Something the user gave (a path, a file, a number) is wrong; the message says what, and what to do.

    Example:
        >>> import vggtgeo as vg
        >>> vg.simulate("moon")
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `scene` is 'moon'; it must be one of room, office, hall, corridor, staircase

    """


class InputWarning(UserWarning):
    """Something the user gave was left out or assumed, and the work goes on; the message names it."""
