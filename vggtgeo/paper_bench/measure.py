"""One run of the system on a rendered walk, and its errors."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import asdict, dataclass
from typing import Any, Self

import cv2
import numpy as np

from vggtgeo.evaluation import depth_error, evaluate_trajectory
from vggtgeo.mapping.keyframe_depth import fused_depths
from vggtgeo.paper_bench.stage import Stage
from vggtgeo.paper_bench.variants import Variant
from vggtgeo.slam.run import finish, frame_trajectory, run
from vggtgeo.slam.state import Slam
from vggtgeo.slam.window import warm_up

_DEPTH_MAPS = 40  # keyframes whose dense depth is compared, evenly spaced: more changes the mean by little


@dataclass(frozen=True)
class Errors:
    """Errors of one run against the exact truth; simulated.

    ate_m: RMSE of the camera centres of all frames after SE(3) alignment, ate_sim3_m: after Sim(3), metres. rte_m,
    rre_deg: mean error of the motion over one second, metres and degrees. depth_rmse_m: dense depth of the keyframes
    over all pixels that have a surface, pooled; depth_prior_rmse_m: the same before the adjustment. scale: that of the
    Sim(3) alignment. path_m: length of the true path. frames, tracked, keyframes: counts. seconds: of the run, without
    rendering and compilation.
    """

    ate_m: float
    ate_sim3_m: float
    rte_m: float
    rre_deg: float
    depth_rmse_m: float
    depth_prior_rmse_m: float
    scale: float
    path_m: float
    frames: int
    tracked: int
    keyframes: int
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """The inverse of `as_dict`; TypeError where a number is missing or unknown."""
        return cls(**values)


def measure(stage: Stage, variant: Variant) -> Errors:
    """Run the system as `variant` on `stage`."""
    settings, roles = variant.settings(stage.course), stage.roles(variant)
    cv2.setRNGSeed(stage.seed)
    warm_up(settings)
    began = time.perf_counter()
    last = deque(run(stage, roles, settings), maxlen=1)
    slam = finish(last[0], roles, settings)
    seconds = time.perf_counter() - began
    return errors_of(slam, stage, seconds)


def errors_of(slam: Slam, stage: Stage, seconds: float) -> Errors:
    """The errors of a finished run."""
    truth = stage.ground_truth()
    second = min(max(round(stage.course.rate), 1), len(slam.frames) - 1)
    report = evaluate_trajectory(frame_trajectory(slam), truth, delta=second)
    depth, prior = _depth_errors(slam, stage)
    return Errors(
        ate_m=report.se3.statistics.rmse,
        ate_sim3_m=report.sim3.statistics.rmse,
        rte_m=report.relative.translation_statistics.mean,
        rre_deg=float(np.degrees(report.relative.rotation_statistics.mean)),
        depth_rmse_m=depth,
        depth_prior_rmse_m=prior,
        scale=report.sim3.alignment.scale,
        path_m=truth.length,
        frames=len(slam.frames),
        tracked=sum(record.tracked for record in slam.frames),
        keyframes=len(slam.keyframes),
        seconds=seconds,
    )


def _depth_errors(slam: Slam, stage: Stage) -> tuple[float, float]:
    """Pooled RMSE of the keyframes' dense depth, metres: after the adjustment, and of the prior alone."""
    chosen = np.unique(np.linspace(0, len(slam.keyframes) - 1, _DEPTH_MAPS).round().astype(int))
    fused = fused_depths(slam.keyframes, slam.intrinsics)
    squares, counts = np.zeros(2), np.zeros(2)
    for number in chosen:
        keyframe = slam.keyframes[number]
        truth = stage.oracle.depth(keyframe.frame)
        for kind, depth in enumerate((fused[number], keyframe.depth)):
            if depth is None:
                continue
            found = depth_error(depth.astype(np.float64), truth)
            if found.count:
                squares[kind] += found.rmse**2 * found.count
                counts[kind] += found.count
    after, before = np.sqrt(squares / np.maximum(counts, 1))
    return float(after), float(before)
