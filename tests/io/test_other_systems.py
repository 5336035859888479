"""What is the same where the calls of POSIX are missing: imports, and the peak of memory."""

from __future__ import annotations

import resource
import subprocess
import sys

import pytest
from conftest import ROOT

from vggtgeo.io.process import peak_memory_gb, rusage_gb

WINDOWS = """
import importlib, os, pkgutil, signal, sys, types
import av, cv2, equinox, jax, jaxlie, matplotlib.figure, numpy, onnxruntime, optimistix, PIL.Image, plyfile, psutil
import rich, rich.progress, scipy.spatial, scipy.sparse.linalg, simplejpeg, skimage, subprocess, tempfile, threadpoolctl
import tomli_w, typer, typer.main, concurrent.futures, multiprocessing, asyncio, zipfile, urllib.request
import scipy.optimize, scipy.ndimage, scipy.stats, skimage.measure, jax.numpy, jax.experimental
import matplotlib.backends.backend_agg

class Hidden:
    def find_spec(name, path=None, target=None):
        if name in {"fcntl", "resource", "pwd", "grp", "termios"}:
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Hidden)
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules.pop(name, None)
sys.modules["msvcrt"] = types.SimpleNamespace(LK_NBLCK=2, locking=print)
for name in ("SIGKILL", "SIGHUP"):
    delattr(signal, name)
for name in (
    "wait4", "killpg", "sched_getaffinity", "sched_setaffinity", "posix_fallocate", "register_at_fork", "getuid"
):
    delattr(os, name)
sys.platform = "win32"
import vggtgeo
wrong, count = [], 0
names = ["vggtgeo", "vggtgeo.solvers", "vggtgeo.models"]
while names:
    name = names.pop()
    if name.endswith("__main__"):
        continue
    try:
        module = importlib.import_module(name)
        count += 1
    except Exception as error:
        wrong.append(f"{name}: {type(error).__name__}: {error}")
        continue
    names += [f"{name}.{part.name}" for part in pkgutil.iter_modules(getattr(module, "__path__", []))]
print(count)
print("\\n".join(wrong))
"""


def test_nothing_fails_to_import_without_posix() -> None:
    # Proves that no module needs `fcntl`, `resource`, SIGKILL or `os.wait4` to be imported, as on Windows. Oracle: an
    # interpreter in which they are hidden.
    done = subprocess.run([sys.executable, "-c", WINDOWS], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    count, *wrong = done.stdout.splitlines()
    assert int(count) > 300
    assert list(filter(None, wrong)) == []


def test_the_peak_of_memory_is_that_of_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves the unit of the peak on Linux and macOS. Oracle: `getrusage`, and 3 GiB in either unit.
    there = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert peak_memory_gb() == pytest.approx(there / 2**20, rel=0.05)
    assert rusage_gb(3 * 2**20) == 3.0
    monkeypatch.setattr(sys, "platform", "darwin")
    assert rusage_gb(3 * 2**30) == 3.0
