"""Writes the published networks as the ONNX files that the adapters read (their names and shapes: `onnx.contracts`).

An exporter imports the network's own code from a checkout that the user has, loads a checkpoint strictly, changes the
loaded module where it could not be exported as it is, and checks the file against PyTorch. Nothing of that code is
part of this package; torch and onnx are imported only while exporting (extra `export`).

| file | holds |
|---|---|
| `recipes` | one entry for each network: its code, sizes, variants |
| `vggt`, `dinov3`, `moge2`, `line_detectors`, `point_matchers` | building a network, its changes |
| `network` | importing from a checkout; loading a checkpoint, or random weights |
| `attention` | changes that several of them need |
| `export` | writing, checking and comparing the file |
"""
