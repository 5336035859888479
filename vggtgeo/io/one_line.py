"""A message as one line of a terminal, whatever names and contents of files are in it."""

import re

MOST = 1200
"""Characters of a line that is told; a damaged file may be quoted as a whole."""
_LONG_WORD = re.compile(r"[^\s]{500,}")
"""Names of folders and files have at most 255 characters each: what is longer is no word that anybody reads."""


def shortened(message: str) -> str:
    """`message` with the middles of endless words left out, so that what is said behind them is seen."""
    return _LONG_WORD.sub(lambda word: f"{word[0][:60]}...{word[0][-60:]}", message)


def one_line(message: str, most: int = MOST) -> str:
    """`message` without line breaks and without control characters (a file's name may hold those that clear a screen),
    its middle left out where it is longer than `most`.
    """
    words = shortened(" ".join(message.split()))
    text = "".join(sign if sign.isprintable() else f"\\x{ord(sign):02x}" for sign in words)
    half = most // 2
    return text if len(text) <= most else f"{text[:half]} ... {text[-half:]}"
