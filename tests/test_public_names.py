"""The public surface: every name of `vggtgeo.__all__` can be had from `import vggtgeo` alone."""

from __future__ import annotations

import importlib
import pkgutil

import pytest

import vggtgeo


@pytest.mark.parametrize("name", vggtgeo.__all__)
def test_name_is_documented_and_is_no_module(name: str) -> None:
    """Each public name resolves, also after all modules are imported, and says what it is."""
    for module in pkgutil.iter_modules(vggtgeo.__path__, "vggtgeo."):
        if not module.ispkg:
            importlib.import_module(module.name)
    found = getattr(vggtgeo, name)
    assert not isinstance(found, type(vggtgeo)), f"the module `vggtgeo.{name}` hides the public name"
    assert found.__doc__, f"`{name}` has no docstring"


def test_an_unknown_name_is_an_attribute_error() -> None:
    """A misspelt name fails as it does in any module, and names itself."""
    with pytest.raises(AttributeError, match="solv"):
        vggtgeo.solv  # noqa: B018
