"""Who may import whom (the layers of docs/concepts/architecture.md), read from the sources."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ROOT

FILES = sorted(file for folder in ("vggtgeo", "solvers", "models") for file in (ROOT / folder).rglob("*.py"))
ALLOWED = {
    "solvers": {"vggtgeo.solvers", "equinox", "jax", "jaxtyping", "numpy", "optimistix"},
    "models": {"vggtgeo.models", "vggtgeo.io", "vggtgeo.geometry", "cv2", "numpy", "onnxruntime", "scipy"},
}
STAIR = (
    ("io",),
    ("compilation", "geometry"),
    ("bundle", "datasets", "evaluation"),
    ("simulation", "slam"),
    ("mapping",),
    ("figures",),
    ("report",),
    ("results",),
    ("export", "learning", "viewing"),
    ("benchmark",),
    ("cli",),
)
"""Packages of `vggtgeo`, the lowest first: each imports of those below it; those of one step nothing of each other."""
STEP = {package: step for step, packages in enumerate(STAIR) for package in packages}
SLAM_STAIR = (
    ("clock", "threads"),
    ("perception",),
    ("settings",),
    ("sparse_map",),
    ("camera", "tracking", "window"),
    ("state",),
    ("callback", "keyframe_decision", "local_mapping", "pose_prior_check"),
    ("global_map",),
    ("manhattan", "map_initialisation", "pose_prior"),
    ("pipeline",),
    ("state_file",),
    ("known_map",),
    ("run",),
    ("self_calibration",),
    ("verdict",),
)
"""Folders and files of `vggtgeo.slam`, the lowest first: each imports of those below it; those of one step nothing of
each other."""
SLAM_STEP = {part: step for step, parts in enumerate(SLAM_STAIR) for part in parts}
LATE = {"vggtgeo.cli"}
"""Packages whose functions import the project: a command's help must not load what the command needs."""
NEVER_AT_MODULE_LEVEL = {"evo", "onnx", "onnxscript", "pyarrow", "ray", "rerun", "rosbags", "torch"}


def _statements(body: ast.AST, in_functions: bool, for_types: bool = True) -> Iterator[ast.AST]:
    """The nodes below `body`, those inside functions and those below `if TYPE_CHECKING` only if asked for."""
    for node in ast.iter_child_nodes(body):
        yield node
        late = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        if (in_functions or not late) and (for_types or not types):
            yield from _statements(node, in_functions, for_types)


def imported(source: str, in_functions: bool = True, for_types: bool = True) -> set[str]:
    """Dotted names of all that `source` imports: `a.b` for `from a import b`, `.` for relative ones."""
    names = set()
    for node in _statements(ast.parse(source), in_functions, for_types):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {"." if node.level else f"{node.module}.{alias.name}" for alias in node.names}
    return names


def modules(source: str, in_functions: bool = True, for_types: bool = True) -> set[str]:
    """The modules of the project that `source` imports from: `vggtgeo.a.b` for `from vggtgeo.a.b import c`."""
    below = [name for name in imported(source, in_functions, for_types) if _within(name, {"vggtgeo"})]
    return {max((known for known in MODULES if _within(name, {known})), key=len) for name in below}


def _within(name: str, packages: set[str]) -> bool:
    return any(name == package or name.startswith(f"{package}.") for package in packages)


def _module(file: Path) -> str:
    """The dotted name by which a source file is imported."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] == "vggtgeo" else ("vggtgeo", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {_module(file): file for file in FILES}
ABOVE = [file for file in FILES if file.is_relative_to(ROOT / "vggtgeo") and file.parent != ROOT / "vggtgeo"]
"""The files on the stair; `vggtgeo/__init__.py` stands on top of it."""
IN_SLAM = [file for file in ABOVE if _module(file).startswith("vggtgeo.slam.")]


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


def test_the_stair_has_a_step_for_every_package() -> None:
    # Proves that no package is left out of the tests below. Oracle: the folders.
    assert {file.relative_to(ROOT / "vggtgeo").parts[0] for file in ABOVE} == set(STEP)


@pytest.mark.parametrize("file", ABOVE, ids=lambda file: str(Path(file).relative_to(ROOT)))
def test_nothing_imports_upward(file: Path) -> None:
    # Proves that data flows down one stair: no import at any depth, of a type or of a value, leads up or aside.
    # Oracle: the steps above.
    own = file.relative_to(ROOT / "vggtgeo").parts[0]
    for module in modules(file.read_text()):
        package = module.split(".")[1]
        if package not in (own, "solvers", "models"):
            assert STEP[package] < STEP[own], f"`vggtgeo.{own}` imports `{module}`"


def test_the_stair_of_slam_has_a_step_for_every_folder_and_file() -> None:
    # Proves that no part of `slam` is left out of the test below. Oracle: the folders and files.
    parts = {_module(file).split(".")[2] for file in IN_SLAM}
    assert parts == set(SLAM_STEP)


@pytest.mark.parametrize("file", IN_SLAM, ids=lambda file: str(Path(file).relative_to(ROOT)))
def test_nothing_in_slam_imports_upward(file: Path) -> None:
    # Proves that stages know nothing of the state that holds them, nor of each other. Oracle: the steps above.
    own = _module(file).split(".")[2]
    for module in modules(file.read_text()):
        if module.startswith("vggtgeo.slam."):
            part = module.split(".")[2]
            assert part == own or SLAM_STEP[part] < SLAM_STEP[own], f"`slam.{own}` imports `{module}`"


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(Path(file).relative_to(ROOT)))
def test_no_import_hides_in_a_function(file: Path) -> None:
    # Proves that no circle is broken by importing late. Oracle: the same file without its functions.
    if _within(_module(file), LATE) or _module(file) == "vggtgeo":
        pytest.skip("loads its parts when they are asked for")
    source = file.read_text()
    assert modules(source) - modules(source, in_functions=False) == set()


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    # Proves that the modules can be loaded from the bottom up. Oracle: repeated removal of those whose
    # imports are all removed already must leave none.
    known = {name: modules(file.read_text(), False, for_types=False) - {name} for name, file in MODULES.items()}
    left = {name: set(needs) for name, needs in known.items() if name != "vggtgeo"}
    while free := [name for name, needs in left.items() if not needs & left.keys()]:
        for name in free:
            del left[name]
    assert left == {}
