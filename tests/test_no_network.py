"""No default path opens a connection: a run, a solve and an evaluation work where sockets are denied."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny_sequences as tiny
from bad_files import problem, walk

SWITCH = "ORT_DISABLE_TELEMETRY"
DENIED = """
import socket, sys

def denied(*arguments, **options):
    raise AssertionError(f"a socket was asked for: {arguments}")

socket.socket.connect = socket.socket.connect_ex = socket.socket.bind = denied
socket.create_connection = socket.getaddrinfo = denied
import vggtgeo.results.tracking_loop, vggtgeo.slam.callback
import vggtgeo.slam.callback, vggtgeo.viewing.callback
vggtgeo.results.tracking_loop.warm_up = lambda settings, metric: ()
vggtgeo.slam.callback.WindowRecorder.on_warm_up = lambda self: None
vggtgeo.slam.callback.Callback.on_warm_up = lambda self: None
vggtgeo.viewing.callback.RerunCallback.on_warm_up = lambda self: None
from vggtgeo.cli.main import make_app, set_jax_flags
set_jax_flags()
for line in sys.argv[1].split("|"):
    try:
        make_app()(line.split(), prog_name="vggtgeo")
    except SystemExit as end:
        assert end.code in (0, 3), (line, end.code)
print("done")
"""


TOLD = """
from vggtgeo.models.onnx.session import onnxruntime
from onnx import TensorProto, helper

ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]) for name in "xy"]
graph = helper.make_graph([helper.make_node("Identity", ["x"], ["y"])], "one", ends[:1], ends[1:])
model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
"""


def test_onnxruntime_tells_nobody(tmp_path: Path) -> None:
    """Its telemetry, which is native code, begins with a file in the home folder. Oracle: an empty home stays empty."""
    environment = {name: value for name, value in os.environ.items() if name not in ("XDG_CACHE_HOME", SWITCH)}
    environment |= {"HOME": str(tmp_path), "USERPROFILE": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    subprocess.run([sys.executable, "-c", TOLD], env=environment, timeout=120, check=True)
    assert list(tmp_path.rglob("*")) == []


@pytest.mark.long
def test_default_paths_open_no_socket(tmp_path: Path) -> None:
    """Oracle: `socket` with its connections taken away, in a process of its own."""
    pixels = np.random.default_rng(1).integers(0, 255, (12, 16, 3)).astype(np.uint8).repeat(10, 0).repeat(10, 1)
    for row in range(3):
        tiny.write_image(tmp_path / f"frames/{row}.png", pixels)
    walk(tmp_path / "a.txt", 0)
    problem()(tmp_path)
    lines = [
        f"run {tmp_path}/frames -o {tmp_path}/out",
        f"run {tmp_path}/frames -o {tmp_path}/out --rerun {tmp_path}/out/run.rrd --quiet",
        f"evaluate {tmp_path}/a.txt {tmp_path}/a.txt",
        f"solve {tmp_path}/problem.npz -o {tmp_path}/s.npz --max-steps 2",
        "models list",
    ]
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache"), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", DENIED, "|".join(lines)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "done"
    assert (tmp_path / "out/run.rrd").stat().st_size > 0
