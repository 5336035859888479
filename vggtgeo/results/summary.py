"""The numbers of a run, as `summary.json` holds them."""

from __future__ import annotations

import importlib.metadata
import platform
import resource
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from vggtgeo.evaluation import TrajectoryReport, evaluate_trajectory
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.cameras import RadialTangential
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.results.files import piece_file
from vggtgeo.slam.global_map.pose_uncertainty import frame_uncertainty
from vggtgeo.slam.run import frame_trajectory
from vggtgeo.slam.state import Slam
from vggtgeo.slam.submaps import pieces_by_size
from vggtgeo.slam.trust.finding import Verdict


def compare(slam: Slam, truth: Trajectory | None) -> TrajectoryReport | None:
    """Errors against the truth; None where there is none, for fewer than three poses and, with a warning, where the
    truth does not match them in time.
    """
    estimate = frame_trajectory(slam)
    if truth is None or len(estimate) < 3:
        return None
    try:
        return evaluate_trajectory(estimate, truth)
    except InputError as error:
        warnings.warn(f"there is no comparison with the truth: {error}", InputWarning, stacklevel=2)
        return None


OWN = frozenset(
    {
        *("verdict", "settings", "versions", "frames", "frames_tracked", "keyframes", "pairs", "pieces"),
        *("peak_memory_gb", "scale", "scale_basis", "pose_sigma", "intrinsics", "lens", "rolling_shutter"),
        *("seconds_by_stage", "notes", "map_points", "dense", "frames_per_second", "interrupted", "images_reduced"),
        *("still_parts", "truth", "frames_per_second_whole_run"),
    }
)
"""What a summary says of every run by itself; no fact of a caller may have such a name."""


def summarise(
    slam: Slam,
    verdict: Verdict,
    *,
    settings: Mapping[str, Any],
    seconds: Mapping[str, float],
    report: TrajectoryReport | None = None,
    truth_in_metres: bool = True,
    **counts: Any,
) -> dict[str, Any]:
    """Verdict, settings, versions, counts, time by stage, final intrinsics, errors where the truth is known.

    truth_in_metres: whether those errors are metres, as their names say; `in_metres` beside them.
    """
    tracked = sum(record.tracked for record in slam.frames)
    values = {
        "verdict": verdict.to_dict(),
        "settings": dict(settings),
        "versions": versions(),
        "frames": len(slam.frames),
        "frames_tracked": tracked,
        "keyframes": len(slam.keyframes),
        "pairs": len(slam.map.pairs),
        "pieces": pieces(slam),
        "peak_memory_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 3),
        "scale": scale_name(slam, verdict),
        **({"scale_basis": SCALE_BASIS} if slam.metric else {}),
        **stated_uncertainty(slam),
        "intrinsics": dict(zip(("fx", "fy", "cx", "cy"), map(float, slam.intrinsics), strict=True)),
        **({} if slam.camera.lens is None else {"lens": lens_of(slam.camera.lens)}),
        **({} if slam.camera.readout is None else {"rolling_shutter": asdict(slam.camera.readout)}),
        "seconds_by_stage": {name: round(value, 3) for name, value in seconds.items()},
        "notes": list(slam.notes),
        **counts,
    }
    return values if report is None else {**values, "truth": {**report.as_dict(), "in_metres": truth_in_metres}}


def stated_uncertainty(slam: Slam) -> dict[str, Any]:
    """Median and largest standard deviation of the poses of the largest piece; nothing where it is not known."""
    found = frame_uncertainty(slam) if slam.keyframes else None
    if found is None or not np.isfinite(found.translation).any():
        return {}
    ends = lambda values: {"median": float(np.nanmedian(values)), "largest": float(np.nanmax(values))}
    unit = "m" if slam.metric else "unit"
    moved, turned = ends(found.translation), ends(np.rad2deg(found.rotation))
    return {"pose_sigma": {f"translation_{unit}": moved, "rotation_deg": turned}}


def pieces(slam: Slam) -> list[dict[str, Any]]:
    """The pieces of the map, the one of most frames first: their file, first and last frame, poses, keyframes.

    Nothing ties pieces to each other; of a map in one piece this is one entry.
    """
    found = []
    for piece, numbers in enumerate(pieces_by_size(slam)):
        inside = set(numbers)
        own = [record.frame for record in slam.frames if record.tracked and record.reference in inside]
        ends = [min(own), max(own)] if own else []
        file = piece_file("trajectory", piece)
        found.append({"trajectory": file, "frames": ends, "poses": len(own), "keyframes": len(numbers)})
    return found


def with_writing(summary: Mapping[str, Any], seconds: float) -> dict[str, Any]:
    """The summary of a run whose files took `seconds` to write: with that stage, and the frames a second of the whole,
    from compilation to the last file. One without times stays as it is.
    """
    stages = dict(summary.get("seconds_by_stage", {}))
    if "all" not in stages:
        return dict(summary)
    whole = stages.pop("all") + seconds
    stages |= {"write": round(seconds, 3), "all": round(whole, 3)}
    return {**summary, "seconds_by_stage": stages, "frames_per_second_whole_run": round(summary["frames"] / whole, 2)}


def lens_of(lens: Camera) -> dict[str, float]:
    """The camera of the images as they were read, OpenCV's model; `intrinsics` are those of the undistorted ones."""
    return dict(zip(RadialTangential.names, (*lens.intrinsics, *lens.distortion), strict=True))


SCALE_BASIS = "the depth alone: images do not tell a constant factor on it"


def scale_name(slam: Slam, verdict: Verdict) -> str:
    """What lengths are: "metric" only where nothing speaks against it."""
    if not slam.metric:
        return "free (no metric depth): lengths have no unit"
    return "metric" if verdict.metric else "doubtful (see the verdict): lengths may be no metres"


def versions() -> dict[str, str]:
    """The versions that a result depends on."""
    names = ("vggtgeo", "jax", "optimistix", "lineax", "equinox", "jaxlie", "numpy", "opencv-python-headless")
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed (source tree)"
    return found
