"""Environment of the commands: the XLA flag that shortens compilation, only for versions of jaxlib that know it."""

from importlib import metadata

import pytest

from vggtgeo.compilation.jax_environment import jax_environment


@pytest.mark.parametrize(
    ("version", "is_set"), [("0.8.0", True), ("0.10.2", True), ("0.11.0", False), ("1.0.0", False)]
)
def test_the_flag_is_set_for_versions_that_know_it(monkeypatch: pytest.MonkeyPatch, version: str, is_set: bool) -> None:
    """Later versions of jaxlib end a process that sets the flag; oracle: the first version without it, 0.11."""
    monkeypatch.setattr(metadata, "version", lambda name: version)
    assert ("XLA_FLAGS" in jax_environment()) == is_set
