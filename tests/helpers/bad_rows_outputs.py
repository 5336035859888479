"""Rows of the table of bad inputs: where a run is to write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bad_files as bad
from bad_row import good, nothing, rows, run_with
from bad_rows_results import write

from vggtgeo.results.run_folder import open_run_folder


def output(make: Any, name: str) -> dict[str, Any]:
    """`vggtgeo run` on good images into something that is there already."""

    def both(folder: Path) -> Path:
        make(folder / name)
        return good(folder)

    return {"make": both, "argv": lambda made: ["run", made, "-o", made.parent / name]}


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


def locked(folder: Path) -> None:
    """A run into a folder that another run holds."""
    with open_run_folder(folder / "out"), open_run_folder(folder / "out"):
        pass


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
        ("the folder that is read", good, {"argv": lambda made: ["run", made, "-o", made]}),
        ("a folder that another run writes", nothing, {"call": locked}),
        ("a folder whose `.lock` is somebody's file", None, output(somebodys(".lock"), "things")),
        ("a folder with a state of a killed run that is none", good, {"argv": into_garbage}),
        ("a folder with a file that is called `unfinished`", None, output(somebodys("unfinished"), "things")),
        ("the root of the file system", good, {"argv": lambda made: ["run", made, "-o", "/"]}),
    ],
)
