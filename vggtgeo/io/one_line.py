"""A message as one line of a terminal, whatever names and contents of files are in it."""

MOST = 1200
"""Characters of a line that is told; a damaged file may be quoted as a whole."""


def one_line(message: str, most: int = MOST) -> str:
    """`message` without line breaks and without control characters (a file's name may hold those that clear a screen),
    its middle left out where it is longer than `most`.
    """
    text = "".join(sign if sign.isprintable() else f"\\x{ord(sign):02x}" for sign in " ".join(message.split()))
    half = most // 2
    return text if len(text) <= most else f"{text[:half]} ... {text[-half:]}"
