"""What is told is one line of a terminal, whatever is in it."""

from __future__ import annotations

from vggtgeo.io.errors import MAX_LENGTH, one_line


def test_names_cannot_break_or_clear_a_terminal() -> None:
    """Line breaks, escapes and bytes that are no UTF-8 become readable; letters stay. Oracle: the text."""
    assert one_line("a\nb\x1b[2J \udcff ü 木") == "a b\\x1b[2J \\xdcff ü 木"


def test_a_file_is_not_told_as_a_whole() -> None:
    """Of a long message begin and end are told. Oracle: its length, and both."""
    told = one_line("begin " + "x" * 10**6 + " end")
    assert len(told) <= MAX_LENGTH + len(" ... ")
    assert told.startswith("begin x")
    assert told.endswith("x end")
