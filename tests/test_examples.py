"""Every public name has an example in its docstring, and it gives what it says."""

from __future__ import annotations

import doctest
from typing import Any

import jax
import pytest

import vggtgeo as vg

WITHOUT = {"BenchReport"}
"""What takes minutes to make; `notebooks/evaluate.ipynb` shows it."""


@pytest.fixture(scope="module")
def session() -> dict[str, Any]:
    """The names that the examples of `solve`'s neighbours take as given."""
    problem, initial, index = vg.simulate_window().pack()
    solution = jax.jit(vg.solve)(problem, initial)
    return {"vg": vg, "jax": jax, "problem": problem, "initial": initial, "index": index, "solution": solution}


@pytest.mark.parametrize("name", sorted(set(vg.__all__) - WITHOUT))
def test_the_example_of_a_public_name_is_true(name: str, session: dict[str, Any]) -> None:
    """Its docstring has an example, and running it prints what stands there; oracle: Python's doctest."""
    text = getattr(vg, name).__doc__
    example = doctest.DocTestParser().get_doctest(text, dict(session), name, None, None)
    assert example.examples, f"`{name}` has no example"
    wrong: list[str] = []
    doctest.DocTestRunner(verbose=False).run(example, out=wrong.append)
    assert not wrong, "".join(wrong)


def test_the_exceptions_are_public() -> None:
    """The list of names without an example holds no name that is gone."""
    assert set(vg.__all__) >= WITHOUT
