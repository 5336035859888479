"""Rows of the table of bad inputs: files of networks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bad_files as bad
from bad_row import nothing, rows


def network(content: bytes | None, *words: Any) -> dict[str, Any]:
    """`vggtgeo models verify` of a file."""
    make = nothing if content is None else bad.file("net.onnx", content)
    return {
        "make": make,
        "argv": lambda made: ["models", "verify", made if content is not None else made / "net.onnx", *words],
    }


def verify(made: Path) -> Any:
    """`vggtgeo models verify`."""
    return ["models", "verify", made]


NETWORKS = rows(
    "Network files",
    [
        ("a file that is not there", None, network(None)),
        ("a folder", nothing, {"argv": lambda made: ["models", "verify", made]}),
        ("an empty file", None, network(b"")),
        ("a PyTorch checkpoint", None, network(b"PK\x03\x04" + b"\0" * 99)),
        ("a pickle", None, network(b"\x80\x02}q\0." + b"\0" * 99)),
        ("a Git LFS pointer", None, network(b"version https://git-lfs.github.com/spec/v1\n")),
    ],
    slack=3.0,
)
