"""Standard output and error that cannot stop a command: a full disk or a reader that went away costs what was printed.

A run prints between its frames and after its last file. Were a failed `print` an exception there, hours of work would
end for a line of text; so it is noted, the work goes on, and the end of the program says it.
"""

from __future__ import annotations

import errno
import io
import os
import sys
from typing import Any

_LINE = "error: standard output cannot be written ({}): what is printed there is lost, files are written all the same"


LEAST_WIDTH = 40
"""Columns in which the tables can still be read."""


class _Lasting(io.FileIO):
    """A file whose errors are noted. Fields: lost, the first."""

    lost: OSError | None = None

    def write(self, data: Any, /) -> int:
        try:
            written = super().write(data)
            if written is not None:
                return written
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        except OSError as error:
            self.lost = self.lost or error
            return memoryview(data).nbytes


def use_lasting_streams() -> None:
    """Puts such streams in place of `sys.stdout` and `sys.stderr`; letters that they do not know become `?`."""
    _open_closed_ones()
    for name, number in (("stdout", 1), ("stderr", 2)):
        stream = getattr(sys, name)
        if not isinstance(stream, io.TextIOWrapper):  # none at all, or that of a notebook
            continue
        stream.reconfigure(errors="replace")
        raw = getattr(stream.buffer, "raw", stream.buffer)  # PYTHONUNBUFFERED leaves out what lies between
        if type(raw) is io.FileIO and stream.fileno() == number:  # no console of Windows
            lines = stream.line_buffering or stream.write_through
            buffer = io.BufferedWriter(_Lasting(number, "w", closefd=False))
            setattr(sys, name, io.TextIOWrapper(buffer, stream.encoding, "replace", line_buffering=lines))


def use_readable_width() -> None:
    """Some terminals and schedulers say that they have no columns, or one: what is printed there would be blank."""
    told = os.environ.get("COLUMNS", "")
    if not told.isdecimal() or not int(told):
        os.environ.pop("COLUMNS", None)
    elif int(told) < LEAST_WIDTH:
        os.environ["COLUMNS"] = str(LEAST_WIDTH)


def exit_code(code: Any, failed: int) -> Any:
    """The program's code, `failed` in place of 0 where standard output was lost, which is said in one line. Of a reader
    that went away (`| head`) nothing is said: it had what it wanted.
    """
    if not isinstance(sys.stdout, io.TextIOWrapper):
        return code
    sys.stdout.flush()
    lost = getattr(getattr(sys.stdout.buffer, "raw", None), "lost", None)
    if lost is None:
        return code
    if isinstance(lost, BrokenPipeError):
        return code or 1
    print(_LINE.format(lost.strerror), file=sys.stderr)
    return code or failed


def _open_closed_ones() -> None:
    """A stream that was closed (`>&-`) would lend its number to the next file that is opened, and libraries in C that
    print would write into a result.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
