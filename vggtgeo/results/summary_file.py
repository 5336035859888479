"""`summary.json` of a run's folder, read back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from vggtgeo.io.errors import InputError
from vggtgeo.io.text_files import whole_text
from vggtgeo.slam.trust.finding import Verdict


def read_summary(folder: Path) -> tuple[dict[str, Any], Verdict]:
    """The summary of the run in `folder`, and its verdict; InputError where the file is missing or no summary."""
    try:
        summary = json.loads(whole_text(folder / "summary.json", errors="strict"))
        return summary, Verdict.from_dict(summary["verdict"], summary["scale"] == "metric")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise unusable(folder, error) from None


def unusable(folder: Path, error: Exception) -> InputError:
    """What is said of a summary that lacks something."""
    return InputError(f"`{folder}` has no usable `summary.json` ({error}); give a folder that `vggtgeo run` wrote")
