"""Every parser on files that were damaged at random: it reads them, or says in a sentence why not; nothing else.

`make fuzz COUNT=20000 ARGS=tests/test_mutated_files.py` runs so many of each kind; a finding becomes a row of
`bad_inputs.csv`.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import bad_files as bad
import numpy as np
import pytest
from campaign import COUNT
from parsers import KINDS, Kind, finite_problem

from vggtgeo.io.errors import InputError

WORDS = (b"nan", b"inf", b"-1", b"1e400", b"99999999999999999999", b"\0", b"\xff\xfe", b"\n", b",", b"[", b"{", b'"')


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Bytes changed, taken out, put in or repeated, at one to four places."""
    changed = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        place = int(rng.integers(0, len(changed) + 1))
        end = min(place + int(rng.integers(1, 40)), len(changed))
        kind = rng.integers(0, 6)
        if kind == 0 and place < len(changed):
            changed[place] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            del changed[place:end]
        elif kind == 2:
            changed[place:end] = rng.bytes(end - place)
        elif kind == 3:
            changed[place:place] = WORDS[int(rng.integers(0, len(WORDS)))]
        elif kind == 4:
            changed[place:place] = changed[place:end] * 3
        else:
            del changed[place:]
    return bytes(changed)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
@pytest.mark.filterwarnings("ignore::vggtgeo.io.errors.InputWarning")
def test_a_whole_file_is_read(kind: Kind, tmp_path: Path) -> None:
    """What the damage begins with is no damaged file itself; oracle: no InputError, and the file as it was."""
    content = kind.content(tmp_path)
    (tmp_path / kind.file).write_bytes(content)
    kind.read(tmp_path / kind.file)
    assert (tmp_path / kind.file).read_bytes() == content


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_damaged_file_is_read_or_refused(kind: Kind, tmp_path: Path) -> None:
    """No exception but InputError, and no NaN that gets through; oracle: the kinds of exceptions that there are."""
    whole, rng = kind.content(tmp_path), np.random.default_rng(0)
    file = tmp_path / kind.file
    refused = 0
    for number in range(COUNT or kind.count):
        content = damaged(whole, rng)
        file.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                kind.read(file)
        except InputError as error:
            refused += bool(str(error))
        except BaseException:
            (tmp_path / f"finding-{number}").write_bytes(content)
            raise
    assert refused > 0


@pytest.mark.parametrize(
    "name", ["edges", "pt_weight", "pt_target", "d_prior", "T_init", "k_init", "ln_abc", "d_sigma"]
)
def test_an_array_with_one_strange_value_is_refused_or_harmless(name: str, tmp_path: Path) -> None:
    """One value of one array becomes NaN, infinite, negative or huge: the file is refused, or nothing in the problem is
    NaN; oracle: the leaves.
    """
    rng, refused = np.random.default_rng(0), 0
    for value in (np.nan, np.inf, -1.0, 0.0, 1e300):
        change = lambda old, value=value: _with(old, value, rng)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                finite_problem(bad.problem(**{name: change})(tmp_path))
        except InputError as error:
            refused += "problem.npz" in str(error)
    assert refused > 0


def _with(array: np.ndarray, value: float, rng: np.random.Generator) -> np.ndarray:
    changed = array if array.dtype.kind == "f" or not np.isfinite(value) else array.astype(array.dtype)
    if changed.dtype.kind in "iu":
        value = -1 if not np.isfinite(value) or value < 0 else min(value, 10**6)
    changed.reshape(-1)[int(rng.integers(0, changed.size))] = value
    return changed
