"""The program: quick to help, one line for an error, and `solve` from file to file."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import typer
from conftest import ROOT
from invoked import invoke
from problem_files import SCENE, arrays_of, write

from vggtgeo.bundle.objective import energy
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.problem_file import load_problem
from vggtgeo.io.errors import InputError

HEAVY = {"jax", "cv2", "matplotlib", "scipy", "onnxruntime", "rerun", "equinox", "numpy"}


def test_help_of_every_command_is_quick_and_shows_examples() -> None:
    # Proves that no command's help loads a numerical package, and that each ends with its examples.
    # Oracle: `sys.modules` of a new process.
    script = (
        "import sys; from typer.testing import CliRunner; from vggtgeo.cli.main import COMMANDS, make_app\n"
        "for name, (_, examples) in COMMANDS.items():\n"
        "    out = CliRunner().invoke(make_app(), [name, '--help'], env={'COLUMNS': '300'}).output\n"
        "    assert all(call in out for call in examples) and examples, (name, out)\n"
        f"print(sorted({HEAVY!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch):
    """Puts a command that raises a given exception in the place of `solve`."""

    def install(error: BaseException) -> None:
        def raising() -> None:
            raise error

        monkeypatch.setattr(sys.modules["vggtgeo.cli.main"], "COMMANDS", {"solve": (raising, ())})

    return install


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (InputError("`x` is 3; it must be 4"), 2, "error: `x` is 3; it must be 4"),
        (PermissionError(13, "Permission denied", "/root/x"), 2, "error: `/root/x`: Permission denied"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (ZeroDivisionError("by zero"), 1, "ZeroDivisionError: by zero (`vggtgeo --debug ...` shows the traceback)"),
        (typer.Exit(7), 7, ""),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else None,
)
def test_an_error_is_one_line_and_a_code(failing, error: BaseException, code: int, message: str) -> None:
    # Proves what a user sees of each kind of failure: one line on stderr, and an exit code that scripts can read.
    failing(error)
    result = invoke("solve")
    assert result.exit_code == code
    assert result.stderr.strip().removeprefix("internal error: ") == message
    assert result.stdout == ""


def test_a_warning_for_the_user_is_one_line_and_no_line_of_code(tmp_path: Path) -> None:
    """Of the input or not, as of a network's answers that cannot be kept; others are shown as Python shows them."""
    program = (
        "import importlib, warnings; module = importlib.import_module('vggtgeo.cli.main')\n"
        "def app():\n    warnings.warn('first\\nsecond', UserWarning); warnings.warn('odd', RuntimeWarning)\n"
        "module.make_app = lambda: lambda prog_name: app()\n"
        "module.main()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path)
    first, *others = done.stderr.splitlines()
    assert first == "warning: first second"
    assert "RuntimeWarning: odd" in others[0]


def test_debug_shows_the_traceback(failing) -> None:
    # Proves that `--debug` lets the exception through, with its traceback.
    failing(InputError("wrong"))
    result = invoke("--debug", "solve")
    assert isinstance(result.exception, InputError)


def test_flags_and_cache_are_set_before_jax(tmp_path: Path) -> None:
    # Proves that the program computes in 64 bits, keeps compiled code in the user's cache folder, adjusts on the
    # processor, and, where it is told to use a GPU, leaves its memory to others.
    script = (
        "from vggtgeo.cli.main import set_jax_flags; set_jax_flags(); import jax, os; "
        "print(jax.numpy.ones(1).dtype, jax.config.jax_compilation_cache_dir, "
        "jax.config.jax_persistent_cache_min_compile_time_secs, os.environ['XLA_PYTHON_CLIENT_PREALLOCATE'], "
        "jax.config.jax_platforms)"
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    compiled = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    for name in ("JAX_ENABLE_X64", "JAX_PLATFORMS", "XLA_PYTHON_CLIENT_PREALLOCATE", *compiled):
        environment.pop(name, None)
    command = [sys.executable, "-c", script]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, check=True)
    assert result.stdout.split() == ["float64", str(tmp_path / "vggtgeo" / "jax"), "0.0", "false", "cpu"]


def test_solve_from_file_to_file(tmp_path: Path) -> None:
    # Proves the printed object and the written arrays. Oracle: the layout, and the energies' order.
    problem, solution = write(tmp_path), tmp_path / "out" / "solution.npz"
    result = invoke("solve", str(problem), "-o", str(solution), "--json", "--repeat", "3", "--max-steps", "3")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert list(report) == [
        *("iterations", "energy_initial", "energy_final", "compile_s", "ms_per_iteration", "dtype", "result")
    ]
    assert (report["iterations"], report["result"], report["dtype"]) == (3, "max_iterations", "float64")
    assert 0 < report["energy_final"] < report["energy_initial"]
    assert report["ms_per_iteration"] > 0
    given = arrays_of(SCENE)
    start = {"T": given["T_init"], "k": given["k_init"], "d": given["d_init"]}
    with np.load(solution) as arrays:
        assert {name: arrays[name].shape for name in arrays.files} == {name: start[name].shape for name in start}
        assert all(arrays[name].dtype == np.float64 for name in arrays.files)
        assert np.abs(arrays["T"] - start["T"]).max() > 1e-4
        np.testing.assert_allclose(arrays["T"][0], start["T"][0], atol=1e-15)


def test_float32_reaches_the_solver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that `--dtype` casts the whole problem, and that energies and solution are in float64 all the same.
    # Oracle: what the solver is given; it answers with its start, whose energy is known (test_solve.py does the rest).
    def return_the_start(problem: Problem, start: State, max_steps: int, repeat: int):
        leaves = jax.tree.leaves((problem, start))
        assert {leaf.dtype for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)} == {np.dtype(np.float32)}
        return SimpleNamespace(state=start, iterations=0, result="max_iterations"), 1.0, 1.0

    monkeypatch.setattr("vggtgeo.cli.solve.timed_solve", return_the_start)
    problem, solution = write(tmp_path), tmp_path / "solution.npz"
    result = invoke("solve", str(problem), "-o", str(solution), "--dtype", "float32", "--json")
    assert result.exit_code == 0, result.output
    report, expected = json.loads(result.stdout), float(energy(*load_problem(problem)[:2]))
    assert (report["dtype"], report["ms_per_iteration"]) == ("float32", None)
    assert report["energy_initial"] == pytest.approx(expected, rel=1e-12)
    assert report["energy_final"] == pytest.approx(expected, rel=1e-4)
    assert report["energy_final"] != report["energy_initial"]
    with np.load(solution) as arrays:
        assert all(arrays[name].dtype == np.float64 for name in arrays.files)
