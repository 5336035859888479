"""Rows of the table of bad inputs: trajectories and results that are compared, read back or exported."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_files as bad
import numpy as np
import tiny_sequences as tiny
from bad_row import good, line, nothing, rows

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


def folder_with_poses(summary: str) -> Any:
    """A run's folder of sixty poses, with this summary."""

    def make(folder: Path) -> Path:
        for name in ("trajectory.txt", "keyframes.txt"):
            bad.walk(folder / name, 0)
        return folder_of_run(summary)(folder)  # type: ignore[no-any-return]

    return make


def run_that_counts(poses: int) -> Any:
    """A run's folder of sixty poses, whose summary counts others."""
    counted = json.loads(summary_of("good")) | {"pieces": [{"poses": poses, "keyframes": 60}]}
    return folder_with_poses(json.dumps(counted))


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


def to_tum(made: Path) -> Any:
    """`vggtgeo export` of its poses."""
    return ["export", made, "--to", "tum", "-o", made / "tum"]


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
        ("columns in the order t q p", None, evaluated(write("0 1 0 0 0 2.5 1.5 3.5\n"), walk())),
        ("`--delta 0`", None, evaluated(walk(), walk(), "--delta", "0")),
        ("`--max-dt -1`", None, evaluated(walk(), walk(), "--max-dt", "-1")),
        ("times that never meet", None, evaluated(walk(), walk(start=1e6))),
        ("few times that meet", None, evaluated(walk(), walk(start=1.5))),
        ("the truth of another sequence", None, evaluated(walk(0), walk(1))),
        ("EuRoC's columns, out of order", None, evaluated(euroc_backwards, walk(start=1e9))),
        (
            "a dataset without truth",
            good,
            {"argv": lambda made: ["evaluate", bad.walk(made.parent / "e.txt", 0), made]},
        ),
        ("words", None, evaluated(write("a b c d e f g h\n"), walk())),
        ("seven columns", None, evaluated(write("0 0 0 0 0 0 1\n"), walk())),
        ("a NaN", None, evaluated(write("0 nan 0 0 0 0 0 1\n"), walk())),
        ("a quaternion of length zero", None, evaluated(write("0 0 0 0 0 0 0 0\n"), walk())),
        ("no pose", None, evaluated(write("# nothing\n"), walk())),
        ("20 GB of zeros", None, evaluated(bad.lengthened, walk())),
        ("binary data", None, evaluated(lambda path: path.write_bytes(bytes(range(256)) * 9), walk())),
        ("times out of order", None, evaluated(backwards, walk())),
        ("each pose twice", None, evaluated(twice, walk())),
        ("commas, a byte order mark and CR LF", None, evaluated(from_a_spreadsheet, walk())),
        (
            "a run whose summary is damaged",
            folder_with_poses("{"),
            {"argv": lambda made: ["evaluate", made, made / "trajectory.txt"]},
        ),
    ],
)


RESULTS = rows(
    "A run's folder that is read",
    [
        ("without a summary", nothing, {}),
        ("a summary that is no JSON", folder_of_run("{"), {}),
        ("a summary of 20 GB", lambda folder: bad.lengthened(folder / "summary.json").parent, {}),
        ("a summary that is a list", folder_of_run("[1, 2]"), {}),
        ("a summary that lacks the intrinsics", folder_of_run(summary_of("good")), {}),
        ("ten thousand brackets", folder_of_run("[" * 10_000), {}),
        ("a run that was killed", folder_of_run("{}", unfinished=True), {}),
        ("a trajectory that lost its last lines", run_that_counts(90), {"argv": to_tum}),
        ("a trajectory with more poses than the run had", run_that_counts(50), {"argv": to_tum}),
        ("poses of another run than its views", run_with_views(moved), {"argv": to_nerfstudio}),
        (
            "a picture that is cut off",
            run_with_views(lambda made: cut(made / "images/000001.jpg")),
            {"argv": to_nerfstudio},
        ),
        (
            "depth of another size than its pictures",
            run_with_views(lambda made: tiny.write_image(made / "depth/000001.depth.png", tiny.depth_codes(1)[:9])),
            {"argv": to_nerfstudio},
        ),
        (
            "depth that declares 60000 x 60000 pixels",
            run_with_views(lambda made: (made / "depth/000001.depth.png").write_bytes(bad.huge_png())),
            {"argv": to_nerfstudio},
        ),
        ("whole, with views, depth and poses", run_with_views(lambda made: None), {"argv": to_nerfstudio}),
    ],
    call=Result.load,
)
