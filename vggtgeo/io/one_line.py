"""Messages as one line of a terminal, whatever file names and contents they quote."""

import re

MOST = 1200
"""Characters of a line; a message may quote a whole damaged file."""
_LONG_WORD = re.compile(r"[^\s]{500,}")
"""Longer words are no file names, which have at most 255 characters."""


def shortened(message: str) -> str:
    """Return `message` with the middle of very long words left out."""
    return _LONG_WORD.sub(lambda word: f"{word[0][:60]}...{word[0][-60:]}", message)


def one_line(message: str, most: int = MOST) -> str:
    """Return `message` without line breaks and control characters (a file name may contain a code that clears the
    screen), at most `most` characters, its middle left out.
    """
    words = shortened(" ".join(message.split()))
    text = "".join(sign if sign.isprintable() else f"\\x{ord(sign):02x}" for sign in words)
    half = most // 2
    return text if len(text) <= most else f"{text[:half]} ... {text[-half:]}"
