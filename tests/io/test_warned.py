"""Warnings about the input, gathered by several runs at once."""

import warnings

import pytest

from vggtgeo.io.errors import InputWarning, collected_warnings


def test_two_that_gather_do_not_take_warnings_from_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that what begins first and ends first, a run in another thread, neither costs the second its warnings nor
    # goes on to gather, and that warnings are shown as before in the end. Oracle: the warnings by number.
    shown: list[str] = []
    monkeypatch.setattr(warnings, "showwarning", lambda message, *_: shown.append(str(message)))
    before = warnings.showwarning

    def warn(number: int, category: type[Warning] = InputWarning) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.warn(str(number), category, stacklevel=1)

    first, second = collected_warnings(), collected_warnings()
    of_first, of_second = first.__enter__(), second.__enter__()
    warn(1)
    first.__exit__(None, None, None)
    warn(2)
    warn(3, UserWarning)
    second.__exit__(None, None, None)
    warn(4)
    assert [str(warning) for warning in of_first] == ["1"]
    assert [str(warning) for warning in of_second] == ["1", "2"]
    assert shown == ["1", "2", "3", "4"]
    assert warnings.showwarning is before
