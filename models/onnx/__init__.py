"""The published networks behind ONNX: what their files must look like, one session for all, one adapter a role."""

import os

# From 1.31 on, onnxruntime numbers the device in a file of the home folder and tells its makers what is run, on Linux,
# too, unless this is set before it is imported (`disable_telemetry_events` comes too late for the number).
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
