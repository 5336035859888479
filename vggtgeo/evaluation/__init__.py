"""Metrics of trajectories, depth and maps: functions on arrays and trajectories, without files or printing."""

from vggtgeo.evaluation.absolute import AbsoluteError, ErrorStatistics, absolute_error
from vggtgeo.evaluation.alignment import ALIGNMENTS, Alignment, Similarity, align, heading, umeyama
from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, associate, nearest_in_time
from vggtgeo.evaluation.comparability import Comparability, comparability
from vggtgeo.evaluation.consistency import Consistency, consistency, pose_consistency
from vggtgeo.evaluation.maps import CloudError, DepthError, cloud_error, depth_error, surface_points
from vggtgeo.evaluation.offsets import Offsets, estimate_offsets, shifted
from vggtgeo.evaluation.relative import UNITS, RelativeError, Unit, relative_error, rotation_angle
from vggtgeo.evaluation.report import TrajectoryReport, coverage, evaluate_trajectory, followed

__all__ = [
    "ALIGNMENTS",
    "MAX_TIME_DIFFERENCE",
    "UNITS",
    "AbsoluteError",
    "Alignment",
    "CloudError",
    "Comparability",
    "Consistency",
    "DepthError",
    "ErrorStatistics",
    "Offsets",
    "RelativeError",
    "Similarity",
    "TrajectoryReport",
    "Unit",
    "absolute_error",
    "align",
    "associate",
    "cloud_error",
    "comparability",
    "consistency",
    "coverage",
    "depth_error",
    "estimate_offsets",
    "evaluate_trajectory",
    "followed",
    "heading",
    "nearest_in_time",
    "pose_consistency",
    "relative_error",
    "rotation_angle",
    "shifted",
    "surface_points",
    "umeyama",
]
