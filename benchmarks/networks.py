"""Every network, exported with random weights (M-LSD with its own) and run: the table of docs/exporting.md.

    .venv/bin/python benchmarks/networks.py --checkouts FOLDER [--out runs/networks] [--only dinov3] [--threads 1]

FOLDER holds checkouts of the networks' code, one folder each, under any name. Files that exist are not exported
again. Each export and each measurement is a process of its own; memory is the largest resident memory of it.
Printed as Markdown. Disk needed: 13 GB; memory: 8 GB (VGGT).
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from vggtgeo.models.exporters.recipes import RECIPES

CALLS = 3


@dataclass(frozen=True)
class Row:
    """One export: file name, network, options, and the input as words."""

    name: str
    network: str
    options: tuple[str, ...]
    size: str


ROWS = (
    Row("mlsd", "mlsd", (), "512 x 512"),
    Row("letr", "letr", (), "480 x 640"),
    Row("dinov3", "dinov3", (), "480 x 640"),
    Row("dinov3-small", "dinov3", ("--variant", "vits16"), "480 x 640"),
    Row("moge2", "moge2", (), "480 x 640, 1800 patches"),
    Row("moge2-small", "moge2", ("--variant", "vits"), "480 x 640, 1800 patches"),
    Row("mast3r_encoder", "mast3r_encoder", (), "384 x 512"),
    Row("mast3r_decoder", "mast3r_decoder", (), "384 x 512, a pair"),
    Row("vggt", "vggt", ("--views", "2"), "392 x 518, 2 views"),
)
HEADINGS = (
    "file",
    "input",
    "weights, M",
    "file, MB",
    "export, s",
    "export, GB",
    "one call, s",
    "running, GB",
    "changes",
    "onnxruntime",
)


def main() -> None:
    """Export and measure what was asked for, and print the table as it grows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkouts", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/networks"))
    parser.add_argument("--only", help="one file's name")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)  # the process that measures one file
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(measure(arguments.measure, arguments.threads)))
        return
    print("| " + " | ".join(HEADINGS) + " |\n" + "|---" * len(HEADINGS) + "|")
    for row in ROWS:
        if arguments.only in (None, row.name):
            report = exported(row, arguments.checkouts, arguments.out, arguments.threads)
            print(line(row, report, measured(arguments.out / f"{row.name}.onnx", arguments.threads)), flush=True)


def exported(row: Row, checkouts: Path, out: Path, threads: int) -> dict:
    """What `vggtgeo models export --json` said of the row's file, now or when it was written."""
    kept = out / f"{row.name}.json"
    if kept.is_file() and (out / f"{row.name}.onnx").is_file():
        return json.loads(kept.read_text())
    source = RECIPES[row.network].checkout.find(checkouts)
    if source is None:
        raise SystemExit(f"`--checkouts` {checkouts} holds no checkout of {RECIPES[row.network].checkout.repository}")
    carried = source / "models/mlsd_tiny_512_fp32.pth"
    weights = ["--checkpoint", carried] if carried.is_file() else ["--random-weights"]
    program = Path(sys.executable).with_name("vggtgeo")
    command = [program, "models", "export", row.network, "--source", source, "-o", out / f"{row.name}.onnx", "--json"]
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    text = subprocess.run(
        [*command, *weights, *row.options], check=True, stdout=subprocess.PIPE, env=environment
    ).stdout
    kept.write_bytes(text)
    return json.loads(text)


def measured(file: Path, threads: int) -> dict:
    """`measure` in a process of its own, with its memory."""
    command = [sys.executable, __file__, "--measure", file, "--threads", str(threads)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    text = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"measuring {file} ended with status {status}")
    return json.loads(text) | {"gigabytes": usage.ru_maxrss / 2**20}


def measure(file: Path, threads: int) -> dict:
    """Median processor seconds of a call, after a first one: on an idle machine with one thread, its latency."""
    import numpy as np
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    with np.load(f"{file}.parity.npz") as parity:
        inputs = {value.name: parity[f"input.{value.name}"] for value in session.get_inputs()}
    session.run(None, inputs)
    seconds = []
    for _ in range(CALLS):
        started = time.process_time()
        session.run(None, inputs)
        seconds.append(time.process_time() - started)
    return {"seconds": statistics.median(seconds)}


def line(row: Row, report: dict, run: dict) -> str:
    """One line of the table."""
    cells = (
        f"`{row.name}`",
        row.size,
        f"{report['parameters'] / 1e6:.1f}",
        f"{report['megabytes']:.0f}",
        f"{report['seconds']:.0f}",
        f"{report['gigabytes']:.1f}",
        f"{run['seconds']:.2f}",
        f"{run['gigabytes']:.1f}",
        f"{report['rewrite']:.0e}",
        f"{report['parity']:.0e}",
    )
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
