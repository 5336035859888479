"""Write `report.html`, whose layout is in `page.html.j2`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.figures import map_view
from vggtgeo.figures.plots import trajectory_figure
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.files import write_text
from vggtgeo.mapping.dense import DenseMap
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.report import figures
from vggtgeo.report.map_scene import evenly_spaced
from vggtgeo.report.viewer import INSTALL, style, template
from vggtgeo.slam.callback import WindowRecord
from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.findings import Verdict

SAMPLES = 4
"""Number of keyframes whose image, depth and confidence are shown."""
VERDICT_LINES = {
    "good": "Good: no check contradicts this result.",
    "degraded": "Degraded: parts of this result are wrong or missing, as listed here. The rest can be used.",
    "failed": "Failed: do not use this result.",
}
_SAMPLE_WIDTH = 300
"""Pixels."""


@dataclass(frozen=True, eq=False)
class RunRecord:
    """The data of a run in memory, from which report and depth images are made.

    slam: the last state. dense: the dense map after the last adjustment. windows: one per adjustment of the window.
    truth: ground truth, camera -> world. warnings: about the input and the weights of networks. title: of the report.
    valid: bool [H, W], pixels of the undistorted images that the original images cover; None if all are.
    """

    slam: Slam
    dense: DenseMap
    windows: tuple[WindowRecord, ...] = ()
    truth: Trajectory | None = None
    warnings: tuple[str, ...] = ()
    title: str = "run"
    valid: np.ndarray | None = None


def write_page(
    path: Path,
    record: RunRecord,
    summary: Mapping[str, Any],
    verdict: Verdict,
    view: Callable[[], str | None] = lambda: None,
) -> None:
    """Write the report of a run, a self-contained HTML file, atomically.

    Args:
        path: of the file.
        record: of the run, with at least one frame.
        summary: content of `summary.json`.
        verdict: of the run; shown at the top of the page.
        view: returns the 3D view, None if it is not available; called last, since it waits for the mesh.

    """
    slam, cloud, truth = record.slam, record.dense.cloud, record.truth
    trajectory = frame_trajectory(slam)
    chosen = [
        (slam.keyframes[row], record.dense.depth_maps[row]) for row in evenly_spaced(len(slam.keyframes), SAMPLES)
    ]
    low, high = _depth_range([depth_map for _, depth_map in chosen if depth_map is not None])
    drawn = ""
    if len(trajectory):
        in_metres = summary.get("truth", {}).get("in_metres", True)
        drawn = figures.svg(
            trajectory_figure(trajectory, truth, keyframe_trajectory(slam), not slam.metric, None, 5.0, in_metres)
        )
    text = template("vggtgeo.report", "page.html.j2").render(
        style=style(),
        title=record.title,
        facts=_facts(slam, trajectory, cloud, summary),
        simulated=bool(summary.get("simulated")),
        interrupted=bool(summary.get("interrupted")),
        scale_is_unknown=not slam.metric,
        unit=" m" if slam.metric else "",
        no_uncertainty="pose_sigma" not in summary,
        verdict=verdict,
        verdict_line=VERDICT_LINES[verdict.level],
        timeline=_timeline(verdict),
        warnings=[*record.warnings, *slam.notes],
        trajectory=drawn,
        has_truth=truth is not None,
        residuals=figures.residuals_svg(record.windows) if record.windows else None,
        map_above=_map_picture(map_view.from_above, cloud, trajectory),
        map_inside=_map_picture(map_view.walk_in, cloud, trajectory),
        samples=[_sample(keyframe, depth_map, low, high) for keyframe, depth_map in chosen],
        depth_range=(low, high) if np.isfinite(low) else None,
        stages=_stages(summary["seconds_by_stage"]),
        total=summary["seconds_by_stage"].get("all"),
        settings=_flat(summary["settings"]),
        versions=summary["versions"],
        intrinsics=summary["intrinsics"],
        reduced=summary.get("images_reduced"),
        truth_table=_truth_table(summary.get("truth"), slam.metric),
        scale=summary["scale"],
        scale_basis=summary.get("scale_basis"),
        install=INSTALL,
        view=view(),
    )
    write_text(path, text)


def _facts(slam: Slam, trajectory: Trajectory, cloud: PointCloud, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    facts = [
        (f"{summary['frames_tracked']} / {summary['frames']}", "frames tracked"),
        (f"{summary['keyframes']}", "keyframes"),
    ]
    if "frames_per_second" in summary:
        facts.append((f"{summary['frames_per_second']:.1f}", "frames per second"))
    if summary["scale"] == "metric":
        facts.append((f"{trajectory.length:.2f} m", "path length"))
    if (truth := summary.get("truth")) is not None:
        aligned, name = ("ate_se3_m", "SE(3)") if slam.metric and truth["in_metres"] else ("ate_sim3_m", "Sim(3)")
        error = truth[aligned]["rmse"]
        shown = f"{100 * error:.2f} cm" if truth["in_metres"] else f"{error:.4g}"
        facts.append((shown, f"ATE after {name}" + ("" if truth["in_metres"] else ", in the unit of the ground truth")))
    facts.append((f"{len(cloud):,}".replace(",", "\u202f"), "points in the map"))
    facts.append((f"{summary['peak_memory_gb']:.2f} GB", "peak memory"))
    return facts


def _timeline(verdict: Verdict) -> list[tuple[str, float, str]]:
    """Return level, share of the run in percent, and description of each segment; empty for a single segment."""
    frames = sum(part.end - part.start + 1 for part in verdict.segments)
    if len(verdict.segments) < 2:
        return []
    return [
        (
            part.level,
            100 * (part.end - part.start + 1) / frames,
            f"frames {part.start} to {part.end}, {part.start_time:.2f} to {part.end_time:.2f} s: "
            + (", ".join(part.checks) or "no finding"),
        )
        for part in verdict.segments
    ]


def _truth_table(truth: Mapping[str, Any] | None, metric: bool) -> list[tuple[str, list[str]]]:
    """Return rows of RMSE, mean, median, maximum; with an unknown scale only after Sim(3) alignment."""
    if truth is None:
        return []
    metric = metric and truth["in_metres"]
    unit, factor = ("cm", 100.0) if truth["in_metres"] else ("unit of the ground truth", 1.0)
    translation = "rpe_translation_m" if metric else "rpe_translation_sim3_m"
    rows = (
        *([(f"ATE, SE(3) [{unit}]", truth["ate_se3_m"], factor)] if metric else []),
        (f"ATE, Sim(3) [{unit}]", truth["ate_sim3_m"], factor),
        (f"RPE translation{'' if metric else ', Sim(3)'} [{unit}]", truth[translation], factor),
        ("RPE rotation [deg]", truth["rpe_rotation_deg"], 1.0),
    )
    names = ("rmse", "mean", "median", "maximum")
    digits = "{:.2f}" if truth["in_metres"] else "{:.4g}"
    show = lambda value, by: "\u2013" if value is None else digits.format(by * value)
    return [(title, [show(errors[name], by) for name in names]) for title, errors, by in rows]


def _stages(seconds: Mapping[str, float]) -> list[tuple[str, float, float]]:
    """Return the name, the duration in seconds, and its ratio to the longest duration, of each stage."""
    shown = {name: value for name, value in seconds.items() if name != "all" and value >= 0.005}
    longest = max(shown.values(), default=1.0)
    return [(name, value, value / longest) for name, value in sorted(shown.items(), key=lambda item: -item[1])]


def _depth_range(depth_maps: Sequence[DepthMap]) -> tuple[float, float]:
    """Return the 2nd and 98th percentile of the samples' depth, metres; NaN without depth."""
    depths = [depth_map.depth[::8, ::8] for depth_map in depth_maps]
    known = np.concatenate([np.zeros(0, np.float32), *(depth[np.isfinite(depth)] for depth in depths)])
    if not len(known):
        return float("nan"), float("nan")
    return float(np.quantile(known, 0.02)), float(np.quantile(known, 0.98))


def _sample(keyframe: Keyframe, depth_map: DepthMap | None, low: float, high: float) -> dict[str, str | None]:
    image = figures.picture(keyframe.image, _SAMPLE_WIDTH)
    depth = confidence = None
    if depth_map is not None and np.isfinite(low):
        depth = figures.picture(figures.depth_colours(depth_map.depth, low, high), _SAMPLE_WIDTH)
        shades = figures.shades(np.rint(255 * depth_map.confidence).astype(np.uint8) / 255.0)
        confidence = figures.picture(shades, _SAMPLE_WIDTH)
    title = f"frame {keyframe.frame}, {keyframe.timestamp:.2f} s"
    if keyframe.recorded is not None:
        title = f"from the known map, recorded at {keyframe.recorded:.2f} s"
    return {"name": title, "image": image, "depth": depth, "confidence": confidence}


def _map_picture(view: Any, cloud: PointCloud, trajectory: Trajectory) -> str | None:
    return figures.picture(view(cloud, trajectory), 900) if len(cloud) > 100 and len(trajectory) else None


def _flat(settings: Mapping[str, Any]) -> dict[str, str]:
    rows: dict[str, Any] = {}
    for name, value in settings.items():
        rows |= {f"{name}.{key}": own for key, own in value.items()} if isinstance(value, Mapping) else {name: value}
    return {name: _plain(value) for name, value in rows.items()}


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "\u2013" if value is None else str(value)
