"""Make the summary of a run, as written to `summary.json`."""

from __future__ import annotations

import importlib.metadata
import json
import platform
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.evaluation import TrajectoryReport, evaluate_trajectory
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.camera_models import RadialTangential
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, warn
from vggtgeo.io.files import whole_text
from vggtgeo.io.process import peak_memory_gb
from vggtgeo.results.files import submap_file
from vggtgeo.slam.global_map.pose_uncertainty import frame_uncertainty
from vggtgeo.slam.run import frame_trajectory
from vggtgeo.slam.state import Slam, submaps_by_size
from vggtgeo.slam.verdict.findings import Verdict


def compare_with_truth(slam: Slam, truth: Trajectory | None) -> TrajectoryReport | None:
    """Return the errors against the ground truth.

    None without ground truth, with fewer than three poses, or, with a warning, if the times do not match.
    """
    estimate = frame_trajectory(slam)
    if truth is None or len(estimate) < 3:
        return None
    try:
        return evaluate_trajectory(estimate, truth)
    except InputError as error:
        warn(f"the ground truth is not evaluated: {error}")
        return None


def summarise(
    slam: Slam,
    verdict: Verdict,
    *,
    settings: Mapping[str, Any],
    seconds: Mapping[str, float],
    report: TrajectoryReport | None = None,
    truth_in_metres: bool = True,
    recorded: bool = False,
    **counts: Any,
) -> dict[str, Any]:
    """Return verdict, settings, versions, counts, time by stage, final intrinsics, and errors against the ground truth.

    truth_in_metres: whether lengths of the ground truth are metres; written as `in_metres` with the errors. recorded:
    whether recorded poses were used as a prior, whose unit is then that of a map without depth.
    """
    tracked = sum(record.tracked for record in slam.frames)
    values: dict[str, Any] = {
        "verdict": verdict.to_dict(),
        "settings": dict(settings),
        "versions": versions(),
        "frames": len(slam.frames),
        "frames_tracked": tracked,
        "keyframes": len(slam.keyframes),
        "pairs": len(slam.map.pairs),
        "submaps": list_submaps(slam),
        "peak_memory_gb": round(peak_memory_gb(), 3),
        "scale": scale_name(slam, verdict, recorded),
        **({"scale_basis": SCALE_BASIS} if slam.metric else {}),
        **_pose_sigma(slam),
        "intrinsics": dict(zip(("fx", "fy", "cx", "cy"), map(float, slam.intrinsics), strict=True)),
        **({} if slam.camera.lens is None else {"lens": lens_parameters(slam.camera.lens)}),
        **({} if slam.camera.readout is None else {"rolling_shutter": asdict(slam.camera.readout)}),
        "seconds_by_stage": {name: round(value, 3) for name, value in seconds.items()},
        "notes": list(slam.notes),
        **counts,
    }
    return values if report is None else {**values, "truth": {**report.to_dict(), "in_metres": truth_in_metres}}


def _pose_sigma(slam: Slam) -> dict[str, Any]:
    """Return median and largest standard deviation of the poses of the largest submap; empty if unknown."""
    sigma = frame_uncertainty(slam) if slam.keyframes else None
    if sigma is None or not np.isfinite(sigma.translation).any():
        return {}
    describe = lambda values: {"median": float(np.nanmedian(values)), "largest": float(np.nanmax(values))}
    unit = "m" if slam.metric else "unit"
    translation, rotation = describe(sigma.translation), describe(np.rad2deg(sigma.rotation))
    return {"pose_sigma": {f"translation_{unit}": translation, "rotation_deg": rotation}}


def list_submaps(slam: Slam) -> list[dict[str, Any]]:
    """Return file, first and last frame, number of poses and of keyframes of each submap, the largest first.

    Submaps are not connected by factors, so their relative poses and scales are unknown.
    """
    found = []
    for rank, numbers in enumerate(submaps_by_size(slam)):
        inside = set(numbers)
        own = [record.frame for record in slam.frames if record.tracked and record.reference in inside]
        ends = [min(own), max(own)] if own else []
        file = submap_file("trajectory", rank)
        found.append({"trajectory": file, "frames": ends, "poses": len(own), "keyframes": len(numbers)})
    return found


def add_writing_time(summary: Mapping[str, Any], seconds: float) -> dict[str, Any]:
    """Add the stage `write` of `seconds` to the summary, and the frames per second of the whole run.

    A summary without times is returned unchanged.
    """
    stages = dict(summary.get("seconds_by_stage", {}))
    if "all" not in stages:
        return dict(summary)
    whole = stages.pop("all") + seconds
    stages |= {"write": round(seconds, 3), "all": round(whole, 3)}
    return {**summary, "seconds_by_stage": stages, "frames_per_second_whole_run": round(summary["frames"] / whole, 2)}


def lens_parameters(lens: Camera) -> dict[str, float]:
    """Return the parameters of the distorted camera, OpenCV's model; `intrinsics` are of the undistorted images."""
    return dict(zip(RadialTangential.names, (*lens.intrinsics, *lens.distortion), strict=True))


SCALE_BASIS = "depth only: a constant factor on the depth cannot be observed in the images"


def scale_name(slam: Slam, verdict: Verdict, recorded: bool) -> str:
    """Return the kind of scale; it is "metric" only if no check of the verdict contradicts it."""
    if not slam.metric:
        unit = "lengths are in the unit of the recorded poses" if recorded else "lengths have no unit"
        return f"free (no metric depth): {unit}"
    return "metric" if verdict.metric else "doubtful (see the verdict): lengths may not be metres"


def versions() -> dict[str, str]:
    """Return the versions of the packages that a result depends on."""
    names = ("vggtgeo", "jax", "optimistix", "lineax", "equinox", "jaxlie", "numpy", "opencv-python-headless")
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed (source tree)"
    return found


def read_summary(folder: Path) -> tuple[dict[str, Any], Verdict]:
    """Return summary and verdict of the run in `folder`; raise InputError if the file is missing or invalid."""
    try:
        summary = json.loads(whole_text(folder / "summary.json", errors="strict"))
        summary["intrinsics"] = {name: float(summary["intrinsics"][name]) for name in ("fx", "fy", "cx", "cy")}
        return summary, Verdict.from_dict(summary["verdict"], summary["scale"] == "metric")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"`{folder / 'summary.json'}` is invalid ({reason}); give a folder of `vggtgeo run`") from None
