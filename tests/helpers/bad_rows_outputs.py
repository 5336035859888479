"""Rows of the table of bad inputs: where a run is to write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bad_files as bad
import tiny_sequences as tiny
from bad_row import good, nothing, rows, run_with
from bad_rows_results import folder_of_run, write

from vggtgeo.results.run_folder import open_run_folder


def output(make: Any, name: str) -> dict[str, Any]:
    """`vggtgeo run` on good images into something that is there already."""

    def both(folder: Path) -> Path:
        make(folder / name)
        return good(folder)

    return {"make": both, "argv": lambda made: ["run", made, "-o", made.parent / name]}


def somebodys_map(folder: Path) -> None:
    """A folder with a file that a run would replace."""
    folder.mkdir()
    (folder / "map.ply").write_text("of the user")


def somebodys(name: str, link: bool = False) -> Any:
    """A folder with a file, or a link to one, where a run puts something of its own."""

    def make(folder: Path) -> None:
        place = folder / name
        place.parent.mkdir(parents=True)
        if link:
            (folder / "diary.txt").write_text("of the user")
            place.symlink_to(folder / "diary.txt")
        else:
            place.write_text("of the user")

    return make


def into_garbage(made: Path) -> Any:
    """A run into the folder of one that was killed, whose state is something else."""
    (made.parent / "out/unfinished").mkdir(parents=True)
    (made.parent / "out/unfinished/checkpoint.npz").write_text("no state")
    return run_with("--resume")(made)


def result_with_images(folder: Path) -> Path:
    """A run's folder whose pictures are the input of the next."""
    bad.frames(folder / "r/images")
    return folder_of_run("{}")(folder / "r")


def locked(folder: Path) -> None:
    """A run into a folder that another run holds."""
    with open_run_folder(folder / "out"), open_run_folder(folder / "out"):
        pass


def laid_in(folder: Path) -> None:
    """A run in whose `unfinished` somebody lays a file; it is still there behind it."""
    with open_run_folder(folder / "out") as run:
        (run.stage / "trajectory.txt").write_text("")
        (run.stage / "mine.txt").write_text("of the user")
        run.publish()
    assert (folder / "out/mine.txt").read_text() == "of the user"


def linked_to_itself(name: str) -> Any:
    """Good images, and beside them a link to itself."""

    def make(folder: Path) -> Path:
        (folder / name).symlink_to(name)
        return good(folder)

    return make


OUTPUT = rows(
    "The output folder",
    [
        ("a file", None, output(write(""), "out")),
        ("a folder of images", None, output(bad.frames, "pictures")),
        ("a TUM folder", None, output(tiny.tum, "desk")),
        ("the folder that is read", good, {"argv": lambda made: ["run", made, "-o", made]}),
        ("a folder with a `map.ply`, and no run's summary", None, output(somebodys_map, "things")),
        (
            "a folder in whose `images` the images that are read lie",
            result_with_images,
            {"argv": lambda made: ["run", made / "images", "-o", made]},
        ),
        ("a folder that another run writes", nothing, {"call": locked}),
        ("a folder whose `.lock` is a link to somebody's file", None, output(somebodys(".lock", link=True), "things")),
        ("a folder whose `.lock` is somebody's file", None, output(somebodys(".lock"), "things")),
        ("a folder with a state of a killed run that is none", good, {"argv": into_garbage}),
        ("a folder with a file that is called `unfinished`", None, output(somebodys("unfinished"), "things")),
        ("a folder with somebody's files in `unfinished`", None, output(somebodys("unfinished/mine.txt"), "things")),
        ("somebody's file in `unfinished`, laid there while a run goes on", nothing, {"call": laid_in}),
        ("the root of the file system", good, {"argv": lambda made: ["run", made, "-o", "/"]}),
        ("a link to itself", linked_to_itself("out"), {"argv": lambda made: ["run", made, "-o", made.parent / "out"]}),
        (
            "a folder below a link to itself",
            linked_to_itself("out"),
            {"argv": lambda made: ["run", made, "-o", made.parent / "out/deeper"]},
        ),
        ("of `solve`: a folder", bad.problem(), {"argv": lambda made: ["solve", made, "-o", made.parent]}),
        ("of `solve`: a device", bad.problem(), {"argv": lambda made: ["solve", made, "-o", "/dev/full"]}),
        ("of `solve`: the problem", bad.problem(), {"argv": lambda made: ["solve", made, "-o", made]}),
        (
            "of `simulate`: a link that leads nowhere",
            lambda folder: (folder / "out").symlink_to(folder / "nowhere") or folder / "out",
            {"argv": lambda made: ["simulate", "room", "-o", made]},
        ),
        ("of `simulate`: a folder with files", good, {"argv": lambda made: ["simulate", "room", "-o", made]}),
    ],
)
