"""What commands ask of a folder before JAX is loaded, which takes seconds: whether it holds a run, whole or one that
has not ended, and whether one can be written there.
"""

from __future__ import annotations

from pathlib import Path

from vggtgeo.io.errors import InputError

UNFINISHED = "unfinished"
"""Folder, inside that of the run, of what a run has written before it is done."""
SUMMARY = "summary.json"
CHECKPOINT = "checkpoint.npz"
"""In `unfinished/`: the state that a killed run can go on from."""


def check_finished(folder: Path) -> str | None:
    """A sentence if a run into `folder` has not ended, or was killed; None for any other folder."""
    stage = folder / UNFINISHED
    if not stage.is_dir():
        return None
    older = ", and the files beside that are of the run before" if (folder / SUMMARY).is_file() else ""
    further = "; `vggtgeo run --resume` goes on with it" if (stage / CHECKPOINT).is_file() else ""
    return f"a run into `{folder}` goes on or was killed: what it has so far is in `{stage}`{older}{further}"


def check_is_run(folder: Path) -> None:
    """InputError unless `folder` is that of a run."""
    if not (folder / SUMMARY).is_file():
        raise InputError(
            check_finished(folder)
            or f"`{folder}` holds no run (no `{SUMMARY}`); give a folder that `vggtgeo run` wrote"
        )


def check_can_be_shown(folder: Path) -> None:
    """InputError unless `folder` has the path and the map of a run."""
    if not folder.is_dir():
        raise InputError(f"`{folder}` is no folder; give the folder that `vggtgeo run -o` wrote")
    for name in ("trajectory.txt", "keyframes.txt", "map.ply"):
        if not (folder / name).is_file():
            raise InputError(
                check_finished(folder) or f"`{folder}` has no `{name}`; give the folder that `vggtgeo run -o` wrote"
            )


def check_may_be_folder(place: Path) -> None:
    """InputError where a file lies in the place of a run's folder."""
    if place.exists() and not place.is_dir():
        raise InputError(f"`{place}` is a file; the results need a folder: give another name with `-o`")
