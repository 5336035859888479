"""Files of `vggtgeo.io.persistence` with another header or other arrays than were written."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.io.persistence import DATA, HEADER


def write(path: Path, header: Any, data: bytes) -> Path:
    """Write a header and all bytes."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in ((HEADER, json.dumps(header).encode()), (DATA, data)):
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.frombuffer(content, np.uint8))
    return path


def with_header(path: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    """Change the header in place; a list or text that `change` returns replaces it."""
    with np.load(path) as file:
        header, data = json.loads(file[HEADER].tobytes()), file[DATA].tobytes()
    changed = change(header)
    return write(path, changed if isinstance(changed, list | str) else header, data)
