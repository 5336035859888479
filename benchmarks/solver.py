"""Run all benchmarks of the solver, and write a page with their tables and plots.

    .venv/bin/python benchmarks/solver.py [--quick] [--only peers scale gradients batches robustness] [--core 0]
        [--bench ../shared/bench] [--jaxls-python PYTHON] [--out runs/solver]

Runs these benchmarks one after the other, each in a separate process: `peers.py` (time per iteration and energy against
time, interleaved with Ceres, a hand-written C++ solver and jaxls, where they are installed), `scale.py` (cost against
the number of keyframes, compared with Ceres), `gradients.py` (cost of a backward pass), `batches.py` (windows per
second) and `robustness.py` (kernels and false matches). The first three are pinned to one core. On a machine with a GPU
that JAX sees, `gradients.py` and `batches.py` run there, with batches up to 4096; the comparisons with other solvers
stay on the CPU. Writes `solver.md` in the output folder.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
NAMES = ("peers", "scale", "gradients", "batches", "robustness")


@dataclass(frozen=True)
class Part:
    """One benchmark: its flags in full and quick, its plots, and whether it runs on one fixed core of the CPU."""

    title: str
    full: tuple[str, ...]
    quick: tuple[str, ...]
    picture: str | None = None
    pinned: bool = False


PARTS = {
    "peers": Part(
        "Time per iteration, and energy against time",
        ("--rounds", "5"),
        ("--rounds", "2", "--sizes", "small", "medium"),
        "energy.png",
        pinned=True,
    ),
    "scale": Part("Cost against size", (), ("--keyframes", "50", "100", "200"), "scale.png", pinned=True),
    "gradients": Part("Backward pass", (), ("--sizes", "small"), pinned=True),
    "batches": Part("Batches", (), ("--sizes", "small", "--precisions", "float64", "--rounds", "3"), "batches.png"),
    "robustness": Part("False matches", (), ("--seeds", "1")),
}
GPU_BATCHES = ("--batches", "1", "16", "256", "4096")


def main() -> None:
    """Run the parts and write the page; a part that fails is listed at the end, and the others still run."""
    options = _options()
    options.out.mkdir(parents=True, exist_ok=True)
    gpu = _gpu()
    page = [f"# The solver on {platform.processor() or platform.machine()}{f' with {gpu}' if gpu else ''}", ""]
    failed = []
    for name in options.only:
        command = _command(name, options, gpu)
        print(f"\n## {PARTS[name].title}\n{' '.join(command[1:])}", flush=True)
        if subprocess.run(command, env=_environment(name), check=False).returncode:
            failed.append(name)
            continue
        page += [f"## {PARTS[name].title}", "", "```", f"python {' '.join(command[1:])}", "```", ""]
        page += [(options.out / name / f"{name}.md").read_text()]
        if PARTS[name].picture:
            page += [f"![{PARTS[name].title}]({name}/{PARTS[name].picture})", ""]
        (options.out / "solver.md").write_text("\n".join(page))
    print(f"\n{options.out / 'solver.md'}")
    if failed:
        raise SystemExit(f"{', '.join(failed)} failed; the errors are above")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bench", type=Path, default=HERE.parents[1] / "shared" / "bench")
    parser.add_argument("--only", nargs="+", choices=NAMES, default=list(NAMES))
    parser.add_argument("--quick", action="store_true", help="fewer sizes, rounds and seeds")
    parser.add_argument("--core", type=int, default=0, help="the core for pinned parts")
    parser.add_argument("--jaxls-python", type=Path, help="interpreter of an environment with jaxls")
    parser.add_argument("--out", type=Path, default=Path("runs/solver"))
    return parser.parse_args()


def _command(name: str, options: argparse.Namespace, gpu: str) -> list[str]:
    part = PARTS[name]
    command = [sys.executable, str(HERE / f"{name}.py"), "--out", str(options.out / name)]
    command += part.quick if options.quick else part.full
    if name == "scale":
        command += ["--generator", str(options.bench / "problems.py")]
        ceres = options.out / "peers" / "build" / "ceres_solver"
        command += ["--ceres", str(ceres)] if ceres.exists() else []
    else:
        command += ["--bench", str(options.bench)]
    if name == "peers":
        command += ["--core", str(options.core)]
        command += ["--jaxls-python", str(options.jaxls_python)] if options.jaxls_python else []
    if name == "batches" and gpu:
        command += GPU_BATCHES
    if part.pinned and not (gpu and name == "gradients") and shutil.which("taskset"):
        command = ["taskset", "--cpu-list", str(options.core), *command]
    return command


def _environment(name: str) -> dict[str, str]:
    """Return the environment of a part; comparisons on a CPU core ignore a GPU."""
    return {**os.environ, "JAX_PLATFORMS": "cpu"} if name in ("peers", "scale") else dict(os.environ)


def _gpu() -> str:
    """Return the name of the GPU that JAX would use, or an empty text; a separate process asks, and frees the GPU."""
    ask = "import jax; d = jax.devices()[0]; print(d.device_kind if d.platform == 'gpu' else '')"
    return subprocess.run([sys.executable, "-c", ask], stdout=subprocess.PIPE, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()
