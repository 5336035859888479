"""Read text files of any origin: lists, poses, tables, summaries."""

from __future__ import annotations

import codecs
import stat
from pathlib import Path

from vggtgeo.io.errors import InputError

MAX_BYTES = 64 * 2**20
"""Maximum size of a text file: 600,000 poses, five hours of frames; parsed, it takes ten times as much memory."""


def whole_text(file: Path, errors: str = "replace") -> str:
    """Return the text of a file of at most `MAX_BYTES` bytes, UTF-8 or UTF-16, without a byte order mark.

    Raises:
        InputError: the file is larger, or not readable by this user.
        OSError: it cannot be read for another reason.

    """
    status = file.stat()
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):  # a pipe has no end
        raise InputError(f"`{file}` is not a regular file; give a text file on the disk")
    size = status.st_size
    if size > MAX_BYTES:
        raise InputError(f"`{file}` has {size} bytes; expected a text of at most {MAX_BYTES}")
    try:
        content = file.read_bytes()
    except PermissionError as error:
        raise InputError(f"`{file}` cannot be read: {error.strerror}; change its permissions, or remove it") from None
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = content.decode("utf-16" if wide else "utf-8-sig", errors)
    return text.replace("\r\n", "\n").replace("\r", "\n")  # as Python reads a text
