"""`help()` of what a user constructs explains every field."""

import dataclasses
import pydoc
import re

import pytest
from public_names import SHORT

GIVEN = {
    *("Solution", "Covariances", "Observability", "ResidualSizes", "Result", "Verdict", "Trajectory"),
    *("View", "SimulatedWindow"),
}
"""What functions give and no user constructs."""
NAMES = [
    name
    for name, value in SHORT.items()
    if isinstance(value, type) and dataclasses.is_dataclass(value) and name not in GIVEN
]


@pytest.mark.parametrize("name", NAMES)
def test_help_explains_every_field(name: str) -> None:
    """Each public field, inherited or not, has an explanation of its own in the class's docstring, which `help()`
    shows. Oracle: the fields of the class; pydoc's text.
    """
    kind = SHORT[name]
    fields = [field.name for field in dataclasses.fields(kind) if not field.name.startswith("_")]
    shown, docstring = pydoc.render_doc(kind, renderer=pydoc.plaintext), kind.__doc__
    missing = [field for field in fields if not re.search(rf"^ +(\w+, )*{field}(, \w+)*: \S", docstring, re.MULTILINE)]
    assert not missing, f"the docstring of `{name}` does not explain {missing}"
    for line in docstring.strip().splitlines():
        assert line.strip() in shown
