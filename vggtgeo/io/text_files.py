"""Read text files of any origin: lists, poses, tables, summaries."""

from __future__ import annotations

import codecs
from pathlib import Path

from vggtgeo.io.errors import InputError

MAX_BYTES = 64 * 2**20
"""Maximum size of a text file: 600,000 poses, five hours of frames; parsed, it takes ten times as much memory."""


def content_of(file: Path, max_bytes: int) -> bytes:
    """Return the bytes of a regular file; raise InputError if it is larger, or cannot be read."""
    try:
        if file.exists() and not file.is_file():  # a pipe has no end
            raise InputError(f"`{file}` is not a regular file")
        size = file.stat().st_size
        if size > max_bytes:
            raise InputError(f"`{file}` has {size} bytes; at most {max_bytes} are read")
        return file.read_bytes()
    except OSError as error:
        raise InputError(f"`{file}` cannot be read: {error.strerror or error}") from None


def whole_text(file: Path, errors: str = "replace") -> str:
    """Return the text of a file of at most `MAX_BYTES` bytes, UTF-8 or UTF-16, without a byte order mark; raise
    InputError if it is larger, or cannot be read.
    """
    content = content_of(file, MAX_BYTES)
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = content.decode("utf-16" if wide else "utf-8-sig", errors)
    return text.replace("\r\n", "\n").replace("\r", "\n")  # as Python reads a text
