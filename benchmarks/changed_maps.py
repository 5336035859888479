"""Maps that somebody changed: one array or number of the file is another, and its checksums are right.

    .venv/bin/python benchmarks/changed_maps.py --count 200 --seed 1     # exit code 1 if a run ended in a crash

A simulated map is saved, changed at a place and in a way drawn by the seed (NaN, 1e30, the negative, zeros, any bits, a
row less, no row; for numbers of the header, among them which array stands where, others), and the next frames of
the walk are placed in it. Oracle: the run ends with a result, or an `InputError` says why not. Counted besides: results
that are called good and more than 5 cm off. A map whose places were changed is another map, which nothing can tell.
"""

from __future__ import annotations

import argparse
import copy
import io
import json
import random
import tempfile
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import vggtgeo as vg
from vggtgeo.io.errors import InputError

SMALL = vg.SlamSettings(window=vg.settings.WindowSettings(size=3, point_slots=64, line_slots=24))
MAPPED, FRAMES = 8, 14
FAR = 0.05
"""Metres: a result that is farther off is wrong."""
Place = tuple[Any, ...]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    walk = vg.simulate("room", FRAMES, size=(320, 240))
    rng, ends = random.Random(given.seed), Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        whole, changed = Path(folder) / "whole.map", Path(folder) / "changed.map"
        vg.reconstruct(walk, settings=SMALL, options=vg.RunOptions(end=MAPPED, dense="none")).save_map(whole)
        header, data = _read(whole)
        for _ in range(given.count):
            what = _write_changed(changed, header, data, rng)
            end = _tried(changed, walk)
            ends[end.split(":")[0]] += 1
            if end.startswith(("crash", "good, but")):
                print(f"{what}: {end}", flush=True)
    print(", ".join(f"{count} {end}" for end, count in ends.most_common()))
    return int(ends["crash"] > 0)


def _tried(file: Path, walk: vg.Sequence) -> str:
    """What came of a run in this map."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = vg.reconstruct(
                walk, settings=SMALL, known_map=vg.load_map(file), options=vg.RunOptions(start=MAPPED, dense="none")
            )
    except InputError:
        return "refused"
    except Exception as error:  # noqa: BLE001 - whatever it is, it is a finding
        own = [place for place in traceback.extract_tb(error.__traceback__) if "site-packages" not in place.filename]
        return f"crash: {error!r:.120} at {Path(own[-1].filename).name}:{own[-1].lineno}"
    error = result.summary["truth"]["ate_se3_m"]["rmse"] if "truth" in result.summary else float("nan")
    if result.verdict.level != "good":
        return "told"
    return "good" if error < FAR else f"good, but off: {100 * error:.1f} cm"


def _read(file: Path) -> tuple[dict[str, Any], np.ndarray]:
    with zipfile.ZipFile(file) as archive:
        header, data = (np.load(io.BytesIO(archive.read(f"{name}.npy"))) for name in ("header", "data"))
    return json.loads(header.tobytes()), data


def _write_changed(file: Path, header: dict[str, Any], data: np.ndarray, rng: random.Random) -> str:
    """Writes the file with one thing changed, and says what it is."""
    header, data = copy.deepcopy(header), data.copy()
    if rng.random() < 0.75:
        name = rng.choice(list(header["arrays"]))
        kind, first, shape, _ = header["arrays"][name]
        way = rng.choice(("nan", "huge", "negative", "zero", "any bits", "a row less", "no row"))
        what = f"array {name}, {kind} {shape}: {way}"
        if "row" in way:
            rows = max(shape[0] - 1, 0) if shape and way == "a row less" else 0
            header["arrays"][name][2] = [rows, *shape[1:]]
        else:
            size = int(np.prod(shape)) * np.dtype(kind).itemsize
            values = data[first : first + size].copy().view(kind)
            data[first : first + size] = np.ascontiguousarray(_changed(values, way, rng)).reshape(-1).view(np.uint8)
    else:
        place = rng.choice(list(_numbers(header["tree"])))
        inside = header["tree"]
        for step in place[:-1]:
            inside = inside[step]
        before = inside[place[-1]]
        inside[place[-1]] = rng.choice((-1, 10**9, 0, 1e300, before + 1, -before))
        what = f"number at {place}: {before} -> {inside[place[-1]]}"
    with zipfile.ZipFile(file, "w") as archive:
        for name, values in (("header", np.frombuffer(json.dumps(header).encode(), np.uint8)), ("data", data)):
            written = io.BytesIO()
            np.save(written, values)
            archive.writestr(f"{name}.npy", written.getvalue())
    return what


def _changed(values: np.ndarray, way: str, rng: random.Random) -> np.ndarray:
    is_float = values.dtype.kind == "f"
    with np.errstate(all="ignore"):
        match way:
            case "nan":
                return np.full_like(values, np.nan) if is_float else values[::-1]
            case "huge":
                return np.full_like(values, 1e30) if is_float else np.full_like(values, 127)
            case "negative":
                return -values if values.dtype.kind in "fi" else ~values
            case "zero":
                return np.zeros_like(values)
        bits = np.frombuffer(rng.randbytes(values.nbytes), np.uint8)
        return bits.view(values.dtype) if values.dtype.kind != "b" else bits % 2 == 0


def _numbers(tree: Any, place: Place = ()) -> Iterator[Place]:
    """Where numbers stand in a tree of JSON."""
    if isinstance(tree, dict | list):
        for key, part in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield from _numbers(part, (*place, key))
    elif isinstance(tree, int | float) and not isinstance(tree, bool):
        yield place


if __name__ == "__main__":
    raise SystemExit(main())
