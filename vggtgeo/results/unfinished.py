"""Checks of a run's folder that need no JAX, so that commands fail before its import, which takes seconds."""

from __future__ import annotations

from pathlib import Path

from vggtgeo.io.errors import InputError

UNFINISHED = "unfinished"
"""Subfolder for the files of a run that is still going on."""
SUMMARY = "summary.json"
EXPORTS = "export"
"""Default folder of `vggtgeo export` in the folder of a run, which no run writes or removes."""
CHECKPOINT = "checkpoint.npz"
"""In `unfinished/`: the state from which a killed run can be resumed."""
EVERY = 10.0
"""Seconds between two checkpoints."""


def unfinished_message(folder: Path) -> str | None:
    """Return a message if the run into `folder` is still going on or was killed, else None."""
    stage = folder / UNFINISHED
    if not stage.is_dir():
        return None
    older = "; the other files in the folder are from the previous run" if (folder / SUMMARY).is_file() else ""
    resume = "; `vggtgeo run --resume` continues it" if (stage / CHECKPOINT).is_file() else ""
    return f"the run into `{folder}` is unfinished (running or killed), its files are in `{stage}`{older}{resume}"


def check_is_run(folder: Path) -> None:
    """Raise InputError unless `folder` contains a finished run."""
    if not (folder / SUMMARY).is_file():
        raise InputError(
            unfinished_message(folder)
            or f"`{folder}` contains no run (`{SUMMARY}` is missing); give a folder that `vggtgeo run` wrote"
        )


def check_can_be_shown(folder: Path) -> None:
    """Raise InputError unless `folder` has the trajectory and the map of a run."""
    if not folder.is_dir():
        raise InputError(f"`{folder}` is not a folder; give the folder that `vggtgeo run -o` wrote")
    for name in ("trajectory.txt", "keyframes.txt", "map.ply"):
        if not (folder / name).is_file():
            raise InputError(
                unfinished_message(folder)
                or f"`{name}` is missing in `{folder}`; give the folder that `vggtgeo run -o` wrote"
            )


def check_may_be_folder(place: Path) -> None:
    """Raise InputError if `place` is an existing file."""
    if place.exists() and not place.is_dir():
        raise InputError(f"`{place}` is a file, expected a folder for the results; give another path with `-o`")
