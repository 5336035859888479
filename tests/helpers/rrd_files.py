"""Recordings for the Rerun viewer, read back by rerun itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def entities_of(path: Path) -> dict[str, set[str]]:
    """Paths in the recording `path`, each with the timelines it is logged on; read by rerun itself."""
    import rerun as rr

    found: dict[str, set[str]] = {}
    for chunk in rr.chunk.RrdReader(path).stream():
        found.setdefault(str(chunk.entity_path), set()).update(chunk.timeline_names)
    return found


def components_of(path: Path, entity: str, component: str) -> dict[int, list[Any]]:
    """What `entity` of the recording `path` holds as `component`, by frame, the last of each; rerun's own reader."""
    import rerun as rr

    found: dict[int, list[Any]] = {}
    for chunk in rr.chunk.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if str(chunk.entity_path) == entity and component in batch.schema.names:
            values = batch.column(component).to_pylist()
            frames = batch.column("frame").to_pylist()
            found |= {frame: value for frame, value in zip(frames, values, strict=True) if value is not None}
    return found
