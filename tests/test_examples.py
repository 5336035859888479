"""Every public name has an example in its docstring, and it gives what it says."""

from __future__ import annotations

import doctest
from typing import Any

import jax
import pytest
from public_names import SHORT

import vggtgeo as vg


@pytest.fixture(scope="module")
def session() -> dict[str, Any]:
    """The names that the examples of `solve`'s neighbours take as given."""
    problem, initial, index = vg.simulate_window().pack()
    solution = jax.jit(vg.solve)(problem, initial)
    return {"vg": vg, "jax": jax, "problem": problem, "initial": initial, "index": index, "solution": solution}


LONG = {"ArrowAdjoint", "reconstruct", "slide"}
"""What compiles for long, of what other files show in a quick test."""


NAMES = [pytest.param(name, marks=pytest.mark.long) if name in LONG else name for name in sorted(SHORT)]


@pytest.mark.parametrize("name", NAMES)
def test_the_example_of_a_public_name_is_true(name: str, session: dict[str, Any]) -> None:
    """Its docstring has an example, and running it prints what stands there; oracle: Python's doctest."""
    text = SHORT[name].__doc__
    example = doctest.DocTestParser().get_doctest(text, dict(session), name, None, None)
    assert example.examples, f"`{name}` has no example"
    wrong: list[str] = []
    doctest.DocTestRunner(verbose=False).run(example, out=wrong.append)
    assert not wrong, "".join(wrong)


def test_outside_jit_a_call_compiles_one_program(session: dict[str, Any]) -> None:
    """A plain call, as in a notebook, does not compile its operations one by one (`covariances` took 50 s that way).
    Oracle: JAX's own count of the programs that it compiles.
    """
    compiled: list[str] = []

    def listen(event: str, duration: float, **_: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    functions = (
        vg.covariances,
        vg.energy,
        vg.analysis.energy_terms,
        vg.observability,
        vg.analysis.residual_sizes,
        vg.residuals_at,
    )
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for function in functions:
            function(session["problem"], session["initial"])
        vg.solve(session["problem"], session["initial"])
    finally:
        jax.monitoring.clear_event_listeners()
    # Besides: a few operations of the checks of arguments.
    assert len(compiled) < 30
