"""Rows of the table of bad inputs: trajectories and results that are compared, read back or exported."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_files as bad
import numpy as np
import tiny_sequences as tiny
from bad_row import line, nothing, rows

from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.mapping.tracks import Tracks
from vggtgeo.results.result import Result
from vggtgeo.results.scene import SCENE, Scene


def evaluated(estimate: Any, reference: Any, *words: Any) -> dict[str, Any]:
    """`vggtgeo evaluate` of two trajectories."""

    def make(folder: Path) -> Path:
        estimate(folder / "estimate.txt")
        reference(folder / "truth.txt")
        return folder

    return {"make": make, "argv": lambda made: ["evaluate", made / "estimate.txt", made / "truth.txt", *words]}


def walk(seed: int = 0, **options: Any) -> Any:
    """Makes a trajectory file."""
    return lambda path: bad.walk(path, seed, **options)


def write(content: str) -> Any:
    """Makes a file."""
    return lambda path: path.write_text(content)


def scalar_first(path: Path) -> None:
    """The same walk, the real part of its quaternions before the others."""
    rows = np.loadtxt(bad.walk(path, 0))
    np.savetxt(path, rows[:, [0, 1, 2, 3, 7, 4, 5, 6]])


def euroc_backwards(path: Path) -> None:
    """A trajectory of 17 columns, times in nanoseconds, its last line the first."""
    lines = [f"{10**18 + number * 10**9 // 30},{number % 7},{number % 3},0,1" + ",0" * 12 for number in range(60)]
    path.write_text("\n".join(reversed(lines)) + "\n")


def folder_of_run(summary: str, unfinished: bool = False) -> Any:
    """A run's folder with this summary."""

    def make(folder: Path) -> Path:
        (folder / "summary.json").write_text(summary)
        if unfinished:
            (folder / "unfinished").mkdir()
        return folder

    return make


def run_with_views(change: Callable[[Path], Any]) -> Any:
    """A run's folder of two views of one point, with depth, in which `change` has changed something."""

    def make(folder: Path) -> Path:
        folder_of_run(summary_of("good"))(folder)
        path = Trajectory(np.arange(2.0), np.stack([tiny.pose(0), tiny.pose(1)]))
        for name in ("trajectory.txt", "keyframes.txt"):
            path.save_tum(folder / name)
        scene = Scene(
            np.arange(2),
            path.timestamps,
            np.linalg.inv(path.poses),
            np.array(tiny.INTRINSICS),
            (tiny.WIDTH, tiny.HEIGHT),
            Tracks(
                points=np.array([[0.0, 0.0, 2.0]]),
                colours=np.zeros((1, 3), np.uint8),
                point=np.zeros(2, int),
                view=np.arange(2),
                pixel=np.full((2, 2), 15.0),
            ),
            metric=True,
        )
        SCENE.write(folder / "scene.npz", scene)
        for number in range(2):
            tiny.write_image(folder / f"images/{number:06d}.jpg", tiny.image(number))
            tiny.write_image(folder / f"depth/{number:06d}.depth.png", tiny.depth_codes(number))
        PointCloud(np.zeros((1, 3)), np.zeros((1, 3), np.uint8)).save_ply(folder / "map.ply")
        change(folder)
        return folder

    return make


def to_nerfstudio(made: Path) -> Any:
    """`vggtgeo export` of its pictures and depth."""
    return ["export", made, "--to", "nerfstudio", "-o", made / "nerfstudio"]


def cut(path: Path) -> None:
    """The first half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def moved(folder: Path) -> None:
    """The poses of another run."""
    for name in ("trajectory.txt", "keyframes.txt"):
        Trajectory(np.arange(2.0), np.stack([tiny.pose(0), tiny.pose(3)])).save_tum(folder / name)


def backwards(path: Path) -> None:
    """A trajectory whose last pose comes first."""
    path.write_text("\n".join(bad.walk(path, 0).read_text().splitlines()[::-1]))


def twice(path: Path) -> None:
    """A trajectory in which each pose stands twice."""
    path.write_text("\n".join(line for line in bad.walk(path, 0).read_text().splitlines() for _ in range(2)))


def from_a_spreadsheet(path: Path) -> None:
    """A trajectory as other programs write text."""
    path.write_bytes(b"\xef\xbb\xbf" + bad.walk(path, 0).read_bytes().replace(b" ", b",").replace(b"\n", b"\r\n"))


def summary_of(level: str, *reasons: str) -> str:
    """A run's summary with this verdict."""
    return json.dumps({"verdict": {"level": level, "reasons": reasons, "segments": []}, "scale": "metric"})


TRAJECTORIES = rows(
    "`vggtgeo evaluate`",
    [
        ("a file that is not there", nothing, {"argv": line("evaluate", "no.txt", "no.txt")}),
        ("`--delta inf`", None, evaluated(walk(), walk(), "--delta", "inf")),
        ("quaternions in the order w x y z", None, evaluated(scalar_first, walk())),
        ("`--delta 0`", None, evaluated(walk(), walk(), "--delta", "0")),
        ("times that never meet", None, evaluated(walk(), walk(start=1e6))),
        ("the truth of another sequence", None, evaluated(walk(0), walk(1))),
        ("EuRoC's columns, out of order", None, evaluated(euroc_backwards, walk(start=1e9))),
        ("seven columns", None, evaluated(write("0 0 0 0 0 0 1\n"), walk())),
        ("a NaN", None, evaluated(write("0 nan 0 0 0 0 0 1\n"), walk())),
        ("20 GB of zeros", None, evaluated(bad.lengthened, walk())),
        ("times out of order", None, evaluated(backwards, walk())),
        ("commas, a byte order mark and CR LF", None, evaluated(from_a_spreadsheet, walk())),
    ],
)


RESULTS = rows(
    "A run's folder that is read",
    [
        ("without a summary", nothing, {}),
        ("a summary that is no JSON", folder_of_run("{"), {}),
        ("a run that was killed", folder_of_run("{}", unfinished=True), {}),
        ("poses of another run than its views", run_with_views(moved), {"argv": to_nerfstudio}),
        (
            "a picture that is cut off",
            run_with_views(lambda made: cut(made / "images/000001.jpg")),
            {"argv": to_nerfstudio},
        ),
        ("whole, with views, depth and poses", run_with_views(lambda made: None), {"argv": to_nerfstudio}),
    ],
    call=Result.load,
)
