"""The public surface: every public name can be had from `import vggtgeo` alone."""

from __future__ import annotations

import importlib
import operator
import pkgutil

import pytest
from public_names import PUBLIC

import vggtgeo


@pytest.mark.parametrize("name", PUBLIC)
def test_name_is_documented_and_is_no_module(name: str) -> None:
    """Each public name resolves, also after all modules are imported, and says what it is."""
    for module in pkgutil.iter_modules(vggtgeo.__path__, "vggtgeo."):
        if not module.ispkg:
            importlib.import_module(module.name)
    found = operator.attrgetter(name)(vggtgeo)
    assert not isinstance(found, type(vggtgeo)), f"the module `vggtgeo.{name}` hides the public name"
    assert found.__doc__, f"`{name}` has no docstring"


def test_an_unknown_name_is_an_attribute_error() -> None:
    """A misspelt name fails as it does in any module, and names itself."""
    with pytest.raises(AttributeError, match="solv"):
        vggtgeo.solv  # noqa: B018


def test_the_top_of_the_package_is_short() -> None:
    """At most 45 names at the top, groups apart: a user reads the list once."""
    top = [name for name in vggtgeo.__all__ if name in PUBLIC]
    assert len(top) <= 45, top
