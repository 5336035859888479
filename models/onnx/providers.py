"""Choice of the device: CUDA if this onnxruntime has it and can start it, else the CPU."""

from __future__ import annotations

import contextlib
import io
import warnings
from functools import cache
from importlib import metadata
from typing import Literal

import onnxruntime
from vggtgeo.models.onnx.file_checks import NetworkFileError

from vggtgeo.io.errors import install_hint, put_back_hint

GPU_PACKAGE = "onnxruntime-gpu"
Provider = Literal["auto", "cuda", "cpu"]
NAMES = {"cuda": "CUDAExecutionProvider", "cpu": "CPUExecutionProvider"}
"""Names in onnxruntime."""
CUDA_OPTIONS = {"arena_extend_strategy": "kSameAsRequested", "use_tf32": "0"}
"""The arena grows as needed, since several networks share one device. Products of float32 use float32, as on the CPU:
in TF32, the default of onnxruntime, maps of M-LSD differ by 3 % of their range, others by 1e-3.
"""
FATAL, WARNING = 4, 2
"""Levels of onnxruntime's log; the second is its default."""


def choose_provider(provider: Provider) -> str:
    """Return the device, "cuda" or "cpu"; raise `NetworkFileError` if CUDA is requested and not available.

    Warns if the package for CUDA is installed but not in use.
    """
    if provider == "cpu" or NAMES["cuda"] in onnxruntime.get_available_providers():
        return "cpu" if provider == "cpu" else "cuda"
    covered = _covered()
    if provider == "cuda":
        why = covered or f"this onnxruntime runs on the CPU only; {install_hint('gpu')}"
        raise NetworkFileError(f"`provider` is cuda, but {why}")
    if covered:
        warn_once(covered)
    return "cpu"


def _covered() -> str:
    """Return a message if `onnxruntime` was installed over `onnxruntime-gpu`, else "".

    Both packages have the same module, and an installer may write either last.
    """
    try:
        found = metadata.version(GPU_PACKAGE)
    except metadata.PackageNotFoundError:
        return ""
    return (
        f"{GPU_PACKAGE} {found} is installed, but its files are overwritten by those of the package onnxruntime; "
        f"{put_back_hint(GPU_PACKAGE, found)}"
    )


@cache
def load_cuda_libraries() -> str:
    """Load CUDA's libraries from pip's folders, which the system's loader does not search; return what is missing."""
    said = io.StringIO()
    if hasattr(onnxruntime, "preload_dlls"):  # from 1.21 on
        with contextlib.redirect_stdout(said):
            onnxruntime.preload_dlls()
    return " ".join(said.getvalue().split())


def check_started(provider: Provider, device: str, used: str) -> None:
    """Report that CUDA did not start: onnxruntime falls back silently.

    Raises `NetworkFileError` if CUDA was requested, else warns.

    Args:
        provider: the requested one.
        device: result of `choose_provider`.
        used: device of the network.

    """
    if device != "cuda" or used == "cuda":
        return
    missing = load_cuda_libraries()
    why = f"onnxruntime could not start CUDA: {missing or 'is there a GPU and its driver?'}"
    if provider == "cuda":
        raise NetworkFileError(f"`provider` is cuda, but {why}")
    warn_once(f"networks run on the CPU: {why}")


@cache
def warn_once(text: str) -> None:
    """Issue a UserWarning, only the first time."""
    warnings.warn(text, stacklevel=3)
