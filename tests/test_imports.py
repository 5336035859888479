"""Who may import whom (the layers of docs/architecture.md), read from the sources."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ROOT

FILES = sorted(file for folder in ("vggtgeo", "solvers", "models") for file in (ROOT / folder).rglob("*.py"))
ALLOWED = {
    "solvers": {"vggtgeo.solvers", "equinox", "jax", "jaxtyping", "lineax", "numpy", "optimistix"},
    "models": {"vggtgeo.models", "cv2", "numpy", "onnxruntime", "scipy"},
}
NEVER_AT_MODULE_LEVEL = {"evo", "onnx", "onnxscript", "rerun", "submitit", "torch"}


def _statements(body: ast.AST, in_functions: bool) -> Iterator[ast.AST]:
    """The nodes below `body`, those inside functions only if asked for."""
    for node in ast.iter_child_nodes(body):
        yield node
        if in_functions or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from _statements(node, in_functions)


def imported(source: str, in_functions: bool = True) -> set[str]:
    """Dotted names of all that `source` imports: `a.b` for `from a import b`, `.` for relative ones."""
    names = set()
    for node in _statements(ast.parse(source), in_functions):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {"." if node.level else f"{node.module}.{alias.name}" for alias in node.names}
    return names


def _within(name: str, packages: set[str]) -> bool:
    return any(name == package or name.startswith(f"{package}.") for package in packages)


def test_imported_sees_every_form() -> None:
    # Proves that the reader above misses no form of import. Oracle: a text with each of them.
    source = "import a.b as c\nfrom d import e, f\nfrom . import g\nif x:\n    import h\ndef i():\n    import j\n"
    assert imported(source) == {"a.b", "d.e", "d.f", ".", "h", "j"}
    assert imported(source, in_functions=False) == {"a.b", "d.e", "d.f", ".", "h"}


@pytest.mark.parametrize("layer", ALLOWED)
def test_lower_layers_import_only_what_they_may(layer: str) -> None:
    # Proves that `solvers` and `models` know nothing of the rest nor of each other. Oracle: the lists above.
    allowed = ALLOWED[layer] | set(sys.stdlib_module_names)
    files = [file for file in FILES if file.is_relative_to(ROOT / layer)]
    wrong = {
        f"{file.relative_to(ROOT)}: {name}"
        for file in files
        for name in imported(file.read_text())
        if not _within(name, allowed)
    }
    assert files
    assert wrong == set()


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(Path(file).relative_to(ROOT)))
def test_optional_packages_are_imported_where_they_are_used(file: Path) -> None:
    # Proves that no module needs an optional or slow package to be imported. Oracle: the list above.
    names = imported(file.read_text(), in_functions=False)
    assert {name for name in names if _within(name, NEVER_AT_MODULE_LEVEL)} == set()
