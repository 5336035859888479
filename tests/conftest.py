"""What all tests share: JAX's global flags, checks of shapes and types, and where the real clips lie."""

import gc
import os
from collections.abc import Iterator
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("JAX_PLATFORMS", "cpu")  # where there is a GPU, too: kept programs are those of the processor
# Most of the tests' time is compilation of what then runs on tiny arrays. Compiling `solve` takes 8.7 s with XLA's own
# settings, 4.8 s without LLVM's optimisation, 2.0 s if fused loops do not go through MLIR, and 1.6 s in one piece (with
# a fifth of the memory mappings). `XLA_FLAGS= make test` compiles as users do; test_optimised.py does so for the core.
FLAGS = ["--xla_backend_optimization_level=0", "--xla_cpu_parallel_codegen_split_count=1"]
if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11):  # later ones end the process of whoever sets it
    FLAGS.append("--xla_cpu_use_fusion_emitters=false")
os.environ.setdefault("XLA_FLAGS", " ".join(FLAGS))
# What one worker, or an earlier run, has compiled is loaded by the others: `make test` once more takes three quarters.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "compiled"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


# Each worker of pytest-xdist keeps to a core of its own, before numpy and JAX count the cores: the thread pools of two
# workers on two cores wait for each other. test_gradients.py takes 51 s alone on one core, 62 s beside another pinned
# worker, 116 s beside one that is not.
WORKER = os.environ.get("PYTEST_XDIST_WORKER", "")
if WORKER and hasattr(os, "sched_setaffinity"):
    CORES = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {CORES[int(WORKER.removeprefix("gw")) % len(CORES)]})

import jax  # noqa: E402
import pytest  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

SHARED = ROOT.parent / "shared"

jax.config.update("jax_enable_x64", True)  # oracles need it; a test of float32 says so in its arrays
# From here on every annotated function of the package checks its arguments and results; see typechecker.py.
install_import_hook("vggtgeo", "typechecker.check")

# Tracing makes objects by the million, nearly all of them alive: fewer searches for garbage save some 8 %.
gc.set_threshold(200_000, 50, 100)

LONGEST = (
    "test_transformations",
    "test_gradients",
    "test_doc_blocks",
    "test_pipeline",
    "test_rows",
    "test_tracking",
    "test_loop_consistency",
    "test_pose_uncertainty",
    "test_user_terms",
    "test_terms",
    "test_host_pixels",
    "test_recorded_prior",
    "test_properties",
    "test_examples",
    "test_notebooks",
    "test_batches",
    "test_camera_groups",
    "test_optimised",
    "test_sliding",
    "test_known_map",
    "test_uncertainty",
    "test_diagnosis",
    "test_solve",
    "test_resume",
    "test_run_folder",
    "test_single_leaves",
    "test_single_precision",
    "test_simulation_sequence",
    "test_structured_inverse",
)
"""Files of more than 15 s, with or without the tests marked `long`: they begin, so that no worker waits long for
another's last file (`make test` keeps this order by `--no-loadscope-reorder`; pytest-xdist would begin with the files
of most tests)."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first."""
    rank = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(LONGEST)))


_MOST_MAPPINGS = 30_000
"""Half of what Linux allows a process by default (`vm.max_map_count`). Each compiled function holds some, and XLA ends
with a segmentation fault where there are no more."""


@pytest.fixture(scope="session", autouse=True)
def _worlds_are_built_once() -> None:
    """Keep each synthetic world of a seed: one takes some seconds to build, and nothing ever changes it."""
    from vggtgeo.simulation import WORLDS  # after the hook above

    WORLDS.update({name: (cache(build), walk) for name, (build, walk) in WORLDS.items()})


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_functions() -> Iterator[None]:
    """Drop what earlier files compiled, before it is too much for one process."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > _MOST_MAPPINGS:
        jax.clear_caches()


def _shared(folder: str) -> Path:
    path = SHARED / folder
    if not path.is_dir():
        pytest.skip(f"needs `../shared/{folder}` beside the repository, which is not there")
    return path


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of the real clips (`redkitchen/`, `corridor-office/`), or a skip."""
    return _shared("data")


@pytest.fixture(scope="session")
def shared_bench() -> Path:
    """The folder of the benchmark problems and their numpy oracle (`problems.py`), or a skip."""
    return _shared("bench")


@pytest.fixture(scope="session")
def shared_cases() -> Path:
    """The folder of small inputs that fail, by kind, or a skip."""
    return _shared("cases")


@pytest.fixture(scope="session")
def run() -> Any:
    """A short simulated run: its frames, its states, and what a recorder noted (`RecordedRun`)."""
    from recorded_run import recorded_run  # after the hook above

    return recorded_run()


@pytest.fixture(scope="session")
def room() -> Any:
    """24 frames of a walk through a room, their camera and the true poses."""
    from recorded_run import room  # after the hook above

    return room()


@pytest.fixture(scope="session")
def healthy() -> Any:
    """A synthetic walk in which the verdict finds nothing."""
    from corner_walk import walk  # after the hook above

    return walk(40)


@pytest.fixture
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of frames that start no window, or hardly one: nothing is compiled beforehand."""
    monkeypatch.setattr("vggtgeo.results.tracking_loop.warm_up", lambda settings, metric: ())
    monkeypatch.setattr("vggtgeo.slam.callback.WindowRecorder.on_warm_up", lambda self: None)
    monkeypatch.setattr("vggtgeo.slam.callback.Callback.on_warm_up", lambda self: None)
