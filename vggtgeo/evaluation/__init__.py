"""Metrics of trajectories, depth and maps: functions on arrays and trajectories, without files or printing."""

from vggtgeo.evaluation.absolute import AbsoluteError, absolute_error
from vggtgeo.evaluation.alignment import ALIGNMENTS, Alignment, Similarity, align, heading, umeyama
from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, associate, nearest_in_time
from vggtgeo.evaluation.calibration import focal_error, scale_error
from vggtgeo.evaluation.clouds import CloudError, cloud_error
from vggtgeo.evaluation.comparability import Comparability, comparability
from vggtgeo.evaluation.consistency import Consistency, consistency, pose_consistency
from vggtgeo.evaluation.depth import DepthError, depth_error, depth_of_cloud
from vggtgeo.evaluation.meshes import Mesh, mesh_error, surface_points
from vggtgeo.evaluation.offsets import Offsets, estimate_offsets, shifted
from vggtgeo.evaluation.relative import UNITS, RelativeError, Unit, relative_error, rotation_angle
from vggtgeo.evaluation.report import TrajectoryReport, coverage, evaluate_trajectory, followed
from vggtgeo.evaluation.statistics import ErrorStatistics

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
    "Mesh",
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
    "depth_of_cloud",
    "estimate_offsets",
    "evaluate_trajectory",
    "focal_error",
    "followed",
    "heading",
    "mesh_error",
    "nearest_in_time",
    "pose_consistency",
    "relative_error",
    "rotation_angle",
    "scale_error",
    "shifted",
    "surface_points",
    "umeyama",
]
