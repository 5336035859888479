"""Every public name: those of `vggtgeo` and of its groups, as `vg.solve` and `vg.terms.PoseTerm` are."""

import types
from typing import Any

import vggtgeo as vg

GROUPS = ("analysis", "batches", "callbacks", "cameras", "data", "kernels", "settings", "terms")
LEARNING = ("RunWindows", "WindowDataset", "WindowWriter", "stack_windows")
"""What of `vg.learning` is documented as public: the rest is an example of research."""


def _names(group: types.ModuleType) -> list[str]:
    return [name for name, value in vars(group).items() if callable(value)]


PUBLIC: dict[str, Any] = {
    **{name: getattr(vg, name) for name in vg.__all__ if not isinstance(getattr(vg, name), types.ModuleType)},
    **{f"{group}.{name}": getattr(getattr(vg, group), name) for group in GROUPS for name in _names(getattr(vg, group))},
    **{f"learning.{name}": getattr(vg.learning, name) for name in LEARNING},
}
"""Each by its name after `vg.`."""
SHORT = {name.rpartition(".")[2]: value for name, value in PUBLIC.items()}
"""Each by its own name."""
