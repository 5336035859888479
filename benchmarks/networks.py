"""Export every network with random weights (M-LSD: trained ones) and run it: the table of docs/guides/networks.md.

    .venv/bin/python benchmarks/networks.py --checkouts FOLDER [--out runs/networks] [--only dinov3] [--threads 1]
    .venv/bin/python benchmarks/networks.py --checkouts FOLDER --out runs/gpu --provider cuda --views 10 [--half]

FOLDER holds checkouts of the networks' code, one folder each, under any name. Existing files are not exported again.
Each export and each measurement runs in a separate process; memory is its peak resident memory. Prints Markdown. Disk
needed: 13 GB; memory: 8 GB (VGGT).

With `--provider cuda` a call is timed by the wall clock, memory is the rise of the GPU's memory in nvidia-smi (so no
other program may use that GPU), and the line after the table is the whole front end: all networks of the paper's preset
loaded together, every role called once per frame of a simulated walk. `--front-end` prints that line alone, on any
provider. `--against-cpu` prints instead the difference between the provider's answers and the CPU's, with the program's
precision and with TF32, onnxruntime's default.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from vggtgeo.models.exporters.recipes import RECIPES
from vggtgeo.models.onnx.contracts import NetworkFileError
from vggtgeo.models.onnx.session import CUDA_OPTIONS, NAMES, choose_provider, load_cuda_libraries, used_device

from vggtgeo.slam.settings.presets import NEEDED

CALLS = 3
FRONT_END_FRAMES = 20
PAPER_GB = 21.2
"""GPU memory of the whole system in the paper."""


@dataclass(frozen=True)
class Row:
    """One export: file name, network, options, and the input in words."""

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
    Row("vggt", "vggt", (), "392 x 518"),
)
PROVIDERS = {
    "cpu": [NAMES["cpu"]],
    "cuda": [(NAMES["cuda"], CUDA_OPTIONS)],
}
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
    """Export and measure the chosen networks, and print each row when it is ready."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkouts", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/networks"))
    parser.add_argument("--only", help="name of one file")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--provider", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--views", type=int, default=2, help="images per window of VGGT")
    parser.add_argument("--half", action="store_true", help="half precision where a network has it")
    parser.add_argument(
        "--front-end", type=int, metavar="FRAMES", help="only time all roles together on this number of frames"
    )
    parser.add_argument("--against-cpu", action="store_true", help="only compare the files of --out with the CPU")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)  # the process that measures one file
    arguments = parser.parse_args()
    try:
        choose_provider(arguments.provider)
    except NetworkFileError as error:
        raise SystemExit(str(error)) from None
    if arguments.measure:
        print(json.dumps(measure(arguments.measure, arguments.threads, arguments.provider)))
        return
    if arguments.against_cpu:
        for file in sorted(arguments.out.glob(f"{arguments.only or '*'}.onnx")):
            print(file.stem, json.dumps(against_cpu(file, arguments.provider)), flush=True)
        return
    if arguments.front_end:
        print(json.dumps(front_end(arguments.out, arguments.front_end, arguments.provider)))
        return
    print("| " + " | ".join(HEADINGS) + " |\n" + "|---" * len(HEADINGS) + "|")
    gigabytes = 0.0
    for row in rows(arguments.views, arguments.half):
        if arguments.only in (None, row.name):
            report = exported(row, arguments.checkouts, arguments.out, arguments.threads)
            run = in_own_process(arguments, "--measure", str(arguments.out / f"{row.name}.onnx"))
            gigabytes += run["gigabytes"] if row.name in NEEDED["paper"] else 0.0
            print(line(row, report, run), flush=True)
    if arguments.provider == "cuda" and arguments.only is None:
        print(f"\nThe paper's preset: {gigabytes:.1f} GB one by one; the paper's system took {PAPER_GB} GB.")
        print(f"Front end: {json.dumps(in_own_process(arguments, '--front-end', str(FRONT_END_FRAMES)))}")


def rows(views: int, half: bool) -> Iterator[Row]:
    """Return the rows with this number of views in VGGT's window and, where such an export exists, in half
    precision.
    """
    for row in ROWS:
        options, size = row.options, row.size
        if row.network == "vggt":
            options, size = ("--views", str(views)), f"392 x 518, {views} views"
        if half and RECIPES[row.network].half:
            options, size = (*options, "--half"), f"{size}, half"
        yield replace(row, options=options, size=size)


def exported(row: Row, checkouts: Path, out: Path, threads: int) -> dict:
    """Return the output of `vggtgeo models export --json` for the row's file, from now or from when it was written."""
    kept = out / f"{row.name}.json"
    if kept.is_file() and (out / f"{row.name}.onnx").is_file():
        return json.loads(kept.read_text())
    source = RECIPES[row.network].checkout.find(checkouts)
    if source is None:
        raise SystemExit(
            f"`--checkouts` must contain a checkout of {RECIPES[row.network].checkout.repository}, got {checkouts}"
        )
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


def in_own_process(arguments: argparse.Namespace, what: str, value: str) -> dict:
    """Return the output of this script with `--measure FILE` or `--front-end FRAMES`, and the peak memory: of the
    process, or of the GPU.
    """
    common = ["--threads", str(arguments.threads), "--provider", arguments.provider, "--out", str(arguments.out)]
    process = subprocess.Popen([sys.executable, __file__, what, value, *common], stdout=subprocess.PIPE)
    assert process.stdout is not None
    text = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{what} {value} ended with status {status}")
    return {"gigabytes": usage.ru_maxrss / 2**20} | json.loads(text)


def measure(file: Path, threads: int, provider: str) -> dict:
    """Return the median seconds of a call after the first; on the CPU processor seconds."""
    import numpy as np
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    with gpu_memory(provider) as memory:
        if provider == "cuda":
            load_cuda_libraries()
        session = onnxruntime.InferenceSession(str(file), options, providers=PROVIDERS[provider])
        used_device(session, provider, provider)
        with np.load(f"{file}.parity.npz") as parity:
            inputs = {value.name: parity[f"input.{value.name}"] for value in session.get_inputs()}
        session.run(None, inputs)
        clock = time.process_time if provider == "cpu" else time.perf_counter
        seconds = []
        for _ in range(CALLS if provider == "cpu" else 10 * CALLS):
            started = clock()
            session.run(None, inputs)
            seconds.append(clock() - started)
    return {"seconds": statistics.median(seconds), **memory}


def against_cpu(file: Path, provider: str) -> dict[str, dict[str, float]]:
    """Return the largest difference of each output from the CPU's, relative to its largest value, in float32 and in
    TF32.
    """
    import numpy as np
    import onnxruntime

    def answers(providers: list) -> dict[str, np.ndarray]:
        session = onnxruntime.InferenceSession(str(file), providers=providers)
        with np.load(f"{file}.parity.npz") as parity:
            inputs = {value.name: parity[f"input.{value.name}"] for value in session.get_inputs()}
        return {
            value.name: found for value, found in zip(session.get_outputs(), session.run(None, inputs), strict=True)
        }

    if provider == "cuda":
        load_cuda_libraries()
    expected = answers(PROVIDERS["cpu"])
    ways = {"float32": PROVIDERS[provider], "TF32": [(NAMES["cuda"], {**CUDA_OPTIONS, "use_tf32": "1"})]}
    found = {way: answers(providers) for way, providers in ways.items() if way == "float32" or provider == "cuda"}
    off = lambda one, other: float(np.abs(one - other).max() / np.abs(other).max())
    return {way: {name: off(one[name], expected[name]) for name in expected} for way, one in found.items()}


def front_end(folder: Path, frames: int, provider: str) -> dict:
    """Run every role of the paper's preset once per frame; return frames per second, and seconds and calls of each
    network.
    """
    import numpy as np
    from vggtgeo.models.roles import PoseQuery

    from vggtgeo.simulation.sequence import simulate
    from vggtgeo.slam.settings.presets import perception
    from vggtgeo.slam.settings.slam_settings import Roles

    walk = list(simulate("room", frames + 1, 0, (640, 480), rate=10.0).frames())
    camera, nothing = np.array([532.5, 532.5, 319.5, 239.5]), (np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0))
    with gpu_memory(provider) as memory:
        found = perception("paper", Roles(), folder, provider=provider)
        roles, before, began = found.roles, None, 0.0
        for frame in walk:
            points = roles.points.describe(frame.image)
            lines = roles.line_matches.describe(frame.image, roles.lines.detect(frame.image))
            depth = roles.depth.estimate(frame.image, None, tuple(camera)).depth
            roles.confidence.confidence(frame.image)
            if before is None:  # the first frame has nothing to be matched with
                began = time.perf_counter()
            else:
                roles.points.match(before[1], points)
                roles.line_matches.match(before[2], lines)
                window = {"window_images": (before[0],), "window_poses": (np.eye(4),), "window_depths": (before[3],)}
                roles.geometry.locate(PoseQuery(frame.image, camera, *nothing, **window))
            before = frame.image, points, lines, depth
        seconds = time.perf_counter() - began
    networks = {name: [net.tally.calls, round(net.tally.seconds, 3)] for name, net in found.networks.items()}
    return {"frames_per_second": round(frames / seconds, 4), "calls_and_seconds": networks, **memory}


@contextlib.contextmanager
def gpu_memory(provider: str) -> Iterator[dict[str, float]]:
    """Measure the rise of the GPU's memory during the block, as `gigabytes`; nothing on the CPU."""
    risen: dict[str, float] = {}
    if provider == "cpu":
        yield risen
        return
    at_first, done = gpu_megabytes(), threading.Event()

    def watch() -> None:
        while not done.wait(0.05):
            risen["gigabytes"] = max(risen.get("gigabytes", 0.0), (gpu_megabytes() - at_first) / 1024)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield risen
    finally:
        done.set()
        watcher.join()


def gpu_megabytes() -> float:
    """Return the memory in use on the first GPU."""
    command = ["nvidia-smi", "--id=0", "--query-gpu=memory.used", "--format=csv,noheader,nounits"]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def line(row: Row, report: dict, run: dict) -> str:
    """Return one row of the table."""
    cells = (
        f"`{row.name}`",
        row.size,
        f"{report['parameters'] / 1e6:.1f}",
        f"{report['megabytes']:.0f}",
        f"{report['seconds']:.0f}",
        f"{report['gigabytes']:.1f}",
        f"{run['seconds']:.3g}",
        f"{run['gigabytes']:.1f}",
        f"{report['rewrite']:.0e}",
        f"{report['parity']:.0e}",
    )
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
