"""Every parser on files that were damaged at random: it reads them, or says in a sentence why not; nothing else.

`VGGTGEO_FUZZ=20000 make test ARGS=tests/test_mutated_files.py` runs so many of each kind; a finding becomes a row of
docs/bad-inputs.md.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bad_files as bad
import cv2
import jax
import numpy as np
import pytest
import tiny_sequences as tiny
import tomli_w

from vggtgeo.bundle.problem_file import load_problem
from vggtgeo.cli.settings_file import _read as read_settings
from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.image_files import FIVE_THOUSANDTHS, read_depth, read_image
from vggtgeo.datasets.intrinsics import camera_from_folder
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.results import Result
from vggtgeo.slam.state import Slam
from vggtgeo.slam.state_file import load_state, save_state

COUNT = int(os.environ.get("VGGTGEO_FUZZ", "0"))
WORDS = (b"nan", b"inf", b"-1", b"1e400", b"99999999999999999999", b"\0", b"\xff\xfe", b"\n", b",", b"[", b"{", b'"')


@dataclass(frozen=True)
class Kind:
    """A whole file, what reads it, and how many damaged ones are tried."""

    name: str
    file: str
    content: Callable[[Path], bytes]
    read: Callable[[Path], Any]
    count: int = 150


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Bytes changed, taken out, put in or repeated, at one to four places."""
    changed = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        place = int(rng.integers(0, len(changed) + 1))
        end = min(place + int(rng.integers(1, 40)), len(changed))
        kind = rng.integers(0, 6)
        if kind == 0 and place < len(changed):
            changed[place] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            del changed[place:end]
        elif kind == 2:
            changed[place:end] = rng.bytes(end - place)
        elif kind == 3:
            changed[place:place] = WORDS[int(rng.integers(0, len(WORDS)))]
        elif kind == 4:
            changed[place:place] = changed[place:end] * 3
        else:
            del changed[place:]
    return bytes(changed)


def _cloud(folder: Path) -> bytes:
    rng = np.random.default_rng(0)
    PointCloud(rng.normal(size=(20, 3)), rng.integers(0, 255, (20, 3)).astype(np.uint8)).save_ply(folder / "good.ply")
    return (folder / "good.ply").read_bytes()


def _list(folder: Path) -> bytes:
    tiny.tum(folder, 3)
    return (folder / "rgb.txt").read_bytes()


def _summary(folder: Path) -> bytes:
    return b'{"intrinsics": {"fx": 1, "fy": 1, "cx": 1, "cy": 1}, "scale": "metric", "verdict": {"level": "good"}}'


def _all_frames(file: Path) -> None:
    for _ in open_sequence(file.parent).frames():
        pass


def _saved(folder: Path) -> bytes:
    return bad.saved(lambda old: None)(folder).read_bytes()


def _camera(file: Path) -> Any:
    return camera_from_folder(file.parent, 64, 48)


def _settings(_: Path) -> bytes:
    return tomli_w.dumps({"path": "a", "stride": 2, "tracking": {"x": [1, 2]}}).encode()


def _depth(file: Path) -> Any:
    return read_depth(file, FIVE_THOUSANDTHS)


def _state(folder: Path) -> bytes:
    four = np.array([50.0, 50.0, 31.5, 23.5])
    save_state(folder / "good.npz", Slam(four, four, np.ones(4), metric=True, notes=("a note",)))
    return (folder / "good.npz").read_bytes()


def _finite_problem(file: Path) -> None:
    problem, state, _ = load_problem(file)
    for leaf in jax.tree.leaves((problem.terms, state)):
        assert not np.isnan(np.asarray(leaf)).any()


KINDS = (
    Kind("trajectory", "t.txt", lambda folder: bad.walk(folder / "g.txt", 0, 6).read_bytes(), Trajectory.load_tum, 300),
    Kind("calibration", "calibration.txt", lambda _: b"55 55 31.5 23.5 0.1 0.1 0 0\n", _camera, 300),
    Kind("PNG", "i.png", lambda _: bad.encoded(".png"), read_image),
    Kind("JPEG", "i.jpg", lambda _: bad.encoded(".jpg"), read_image),
    Kind("progressive JPEG", "i.jpg", lambda _: bad.encoded(".jpg", None, cv2.IMWRITE_JPEG_PROGRESSIVE, 1), read_image),
    Kind("turned JPEG", "i.jpg", lambda _: bad.turned_jpeg(), read_image),
    Kind("depth", "d.png", lambda _: bad.encoded(".png", tiny.depth_codes(1)), _depth),
    Kind("list", "rgb.txt", _list, _all_frames),
    Kind("point cloud", "map.ply", _cloud, PointCloud.load_ply),
    Kind("settings", "s.toml", _settings, read_settings),
    Kind("summary", "summary.json", _summary, lambda file: Result.load(file.parent)),
    Kind("problem", "p.npz", lambda folder: bad.problem()(folder).read_bytes(), _finite_problem, 60),
    Kind("saved problem", "p.npz", _saved, _finite_problem, 60),
    Kind("state", "s.npz", _state, load_state),
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_damaged_file_is_read_or_refused(kind: Kind, tmp_path: Path) -> None:
    """No exception but InputError, and no NaN that gets through; oracle: the kinds of exceptions that there are."""
    whole, rng = kind.content(tmp_path), np.random.default_rng(0)
    file = tmp_path / kind.file
    refused = 0
    for number in range(COUNT or kind.count):
        content = damaged(whole, rng)
        file.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                kind.read(file)
        except InputError as error:
            refused += bool(str(error))
        except BaseException:
            (tmp_path / f"finding-{number}").write_bytes(content)
            raise
    assert refused > 0


@pytest.mark.parametrize(
    "name", ["edges", "pt_weight", "pt_target", "d_prior", "T_init", "k_init", "ln_abc", "d_sigma"]
)
def test_an_array_with_one_strange_value_is_refused_or_harmless(name: str, tmp_path: Path) -> None:
    """One value of one array becomes NaN, infinite, negative or huge: the file is refused, or nothing in the problem is
    NaN; oracle: the leaves.
    """
    rng, refused = np.random.default_rng(0), 0
    for value in (np.nan, np.inf, -1.0, 0.0, 1e300):
        change = lambda old, value=value: _with(old, value, rng)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                _finite_problem(bad.problem(**{name: change})(tmp_path))
        except InputError as error:
            refused += "problem.npz" in str(error)
    assert refused > 0


def _with(array: np.ndarray, value: float, rng: np.random.Generator) -> np.ndarray:
    changed = array if array.dtype.kind == "f" or not np.isfinite(value) else array.astype(array.dtype)
    if changed.dtype.kind in "iu":
        value = -1 if not np.isfinite(value) or value < 0 else min(value, 10**6)
    changed.reshape(-1)[int(rng.integers(0, changed.size))] = value
    return changed
