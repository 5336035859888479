"""The package imports from anywhere as a wheel, and collides with nobody's folders."""

import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from dataclasses import dataclass
from pathlib import Path
from zipfile import ZipFile

import pytest
from conftest import ROOT

from vggtgeo.io.errors import install_hint

SOURCES = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "vggtgeo", "solvers", "models")

# Imports every module, prints `name<TAB>file` of each. Optional packages and the tests' are made absent.
IMPORT_ALL = """
import importlib, pkgutil, sys
class Absent:
    def find_spec(name, path=None, target=None):
        if name in {"torch", "onnx", "onnxscript", "evo", "beartype", "pytest", "setuptools"}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Absent)
pending = ["vggtgeo", "vggtgeo.solvers", "vggtgeo.models"]
seen = set()
while pending:
    name = pending.pop()
    if name not in seen and not name.endswith("__main__"):
        seen.add(name)
        module = importlib.import_module(name)
        print(name, module.__file__, sep="\\t")
        pending += [f"{name}.{m.name}" for m in pkgutil.iter_modules(getattr(module, "__path__", ()))]
print("rerun imported\\t" * ("rerun" in sys.modules))
"""


def test_every_hint_to_install_names_an_extra_that_is_there() -> None:
    # Proves that what is said of a missing package works in a clone: one function writes it, and each extra that the
    # code asks for is in pyproject.toml. Oracle: the sources, pyproject.toml.
    sources = [file for folder in ("vggtgeo", "models", "solvers") for file in (ROOT / folder).rglob("*.py")]
    texts = {file.name: file.read_text(encoding="utf-8") for file in sources}
    asked = {extra for text in texts.values() for extra in re.findall(r"install_hint\([\"'](\w+)", text)}
    assert asked == {"bags", "bench", "cluster", "export", "fetch", "gpu", "maps", "phones", "viewer"}
    known = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert asked <= set(known)
    assert [name for name, text in texts.items() if "pip install" in text] == ["errors.py"]
    assert "`pip install -e '.[gpu]'` in a clone" in install_hint("gpu")
    assert any(package.startswith("jupyterlab") for package in known["notebooks"])


def _run(*arguments: str, cwd: Path = ROOT) -> str:
    """Output of the tests' interpreter called with `arguments`; its errors are the test's message."""
    done = subprocess.run([sys.executable, *arguments], cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@dataclass(frozen=True)
class Installation:
    """A folder with the package installed and the interpreter's lines that put it on `sys.path`."""

    folder: Path
    preamble: str

    def python(self, code: str, cwd: Path) -> str:
        """Output of `python -c code` in `cwd`: it sees this installation, its dependencies, no other."""
        # -S: no site-packages, hence no trace of how the environment of the tests has installed the package.
        dependencies = sorted({sysconfig.get_path("purelib"), sysconfig.get_path("platlib")})
        script = f"import site, sys\n{self.preamble}\nsys.path += {dependencies}\n{code}"
        return _run("-B", "-S", "-c", script, cwd=cwd)

    def modules(self, cwd: Path) -> dict[str, Path]:
        """Each module of the package with its file, as imported with `cwd` as working directory."""
        lines = self.python(IMPORT_ALL, cwd).split("\n")
        return {name: Path(file) for name, file in (line.split("\t") for line in lines if line)}


def _pip_install(*arguments: str | Path) -> None:
    _run("-m", "pip", "install", "--quiet", "--no-deps", "--no-index", *map(str, arguments))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the repository's root (a build writes beside its sources), with a file in `tests/`."""
    root = tmp_path_factory.mktemp("repository")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, root / name)
    (root / "tests").mkdir()
    (root / "tests" / "__init__.py").touch()
    return root


@pytest.fixture(scope="module")
def wheel(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built wheel."""
    folder = tmp_path_factory.mktemp("dist")
    build = f"from setuptools import build_meta; build_meta.build_wheel({str(folder)!r})"
    _run("-c", build, cwd=source)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def installation(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installation:
    folder = tmp_path_factory.mktemp("installed")
    _pip_install("--target", folder, wheel)
    return Installation(folder, f"sys.path.append({str(folder)!r})")


@pytest.fixture
def user_folder(tmp_path: Path) -> Path:
    """A user's project with packages `models` and `solvers` of its own."""
    for name in ("models", "solvers"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("mine = True\n")
    return tmp_path


def _source_modules(root: Path) -> set[str]:
    files = [
        file.relative_to(root) for name in ("vggtgeo", "solvers", "models") for file in (root / name).rglob("*.py")
    ]
    names = {".".join(file.with_suffix("").parts).removesuffix(".__init__") for file in files}
    return {name if name.split(".")[0] == "vggtgeo" else f"vggtgeo.{name}" for name in names}


def _importable(root: Path) -> set[str]:
    return {name for name in _source_modules(root) if not name.endswith("__main__")}


def test_wheel_holds_every_source_file_and_nothing_else(source: Path, wheel: Path) -> None:
    # Proves that no module is forgotten and no top-level `models`, `solvers`, `tests` is installed.
    # Oracle: the files of the source tree.
    with ZipFile(wheel) as archive:
        files = [Path(name) for name in archive.namelist() if ".dist-info/" not in name]
    found = {".".join(file.with_suffix("").parts).removesuffix(".__init__") for file in files if file.suffix == ".py"}
    assert found == _source_modules(source)
    data = {file for file in files if file.suffix != ".py"}
    kinds = ("*.toml", "*.j2", "*.css", "*.js", "*.pyi", "py.typed")
    assert data == {file.relative_to(source) for kind in kinds for file in (source / "vggtgeo").rglob(kind)}
    assert Path("vggtgeo/benchmark/suites/quick.toml") in data


@pytest.mark.long
def test_every_module_imports_from_a_users_folder(installation: Installation, source: Path, user_folder: Path) -> None:
    # Proves that all modules import, from the installation and without optional packages, where a user's
    # `models/` and `solvers/` come first on the path. Oracle: the files of the source tree.
    modules = installation.modules(user_folder)
    assert set(modules) == _importable(source)
    assert {file for file in modules.values() if not file.is_relative_to(installation.folder)} == set()


def test_users_own_folders_are_left_alone(installation: Installation, user_folder: Path) -> None:
    # Proves that `models` and `solvers` stay the user's once vggtgeo is imported. Oracle: a flag in both.
    code = "import vggtgeo.models, vggtgeo.solvers, models, solvers; print(models.mine, solvers.mine)"
    assert installation.python(code, user_folder).split() == ["True", "True"]


def test_every_module_imports_from_the_repository(installation: Installation, source: Path) -> None:
    # Proves that all modules import in the repository's root, where Python finds the source tree before any
    # installation, and come from that tree. Oracle: the files of the source tree.
    modules = installation.modules(source)
    assert set(modules) == _importable(source)
    assert {file for file in modules.values() if not file.is_relative_to(source)} == set()


def test_nothing_else_of_the_repository_is_importable_under_our_name(source: Path, installation: Installation) -> None:
    # Proves that the source tree's finder serves two names only. Oracle: `tests/`, which lies beside them.
    code = "import importlib.util, vggtgeo; print(importlib.util.find_spec('vggtgeo.tests'))"
    assert installation.python(code, source).split() == ["None"]
