"""Whether a folder holds a run that has not ended; asked by commands that are done before JAX would be loaded."""

from __future__ import annotations

from pathlib import Path

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
