"""Standard output and error whose failure (a full disk, a closed pipe) does not stop a command.

A run prints between frames: an exception of `print` would end hours of work. Instead the error is recorded, the work
continues, and the program reports the error at its end.
"""

from __future__ import annotations

import errno
import io
import os
import sys
from typing import Any

_LINE = "error: standard output cannot be written ({}): printed text is lost, files are written"
MIN_WIDTH = 40
"""Columns needed to read the tables."""


class _Lasting(io.FileIO):
    """A file that records its first error in `lost`, and raises none."""

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
    """Replace `sys.stdout` and `sys.stderr` by such streams; characters that they cannot encode become `?`."""
    _open_closed_ones()
    for name, number in (("stdout", 1), ("stderr", 2)):
        stream = getattr(sys, name)
        if not isinstance(stream, io.TextIOWrapper):  # None, or the stream of a notebook
            continue
        stream.reconfigure(errors="replace")
        raw = getattr(stream.buffer, "raw", stream.buffer)  # with PYTHONUNBUFFERED, `buffer` is the raw file
        if type(raw) is io.FileIO and stream.fileno() == number:  # not a Windows console
            lines = stream.line_buffering or stream.write_through
            buffer = io.BufferedWriter(_Lasting(number, "w", closefd=False))
            setattr(sys, name, io.TextIOWrapper(buffer, stream.encoding, "replace", line_buffering=lines))


def use_readable_width() -> None:
    """Correct `COLUMNS`: some terminals and schedulers set it to 0 or 1, with which tables would be blank."""
    columns = os.environ.get("COLUMNS", "")
    if not columns.isdecimal() or not int(columns):
        os.environ.pop("COLUMNS", None)
    elif int(columns) < MIN_WIDTH:
        os.environ["COLUMNS"] = str(MIN_WIDTH)


def exit_code(code: Any, failed: int) -> Any:
    """Return the exit code: `failed` instead of 0, with an error message, if standard output failed.

    A closed pipe (`| head`) is not reported.
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
    """Open standard streams that were closed (`>&-`): else the next opened file would get the number of one, and output
    of C libraries would go into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
