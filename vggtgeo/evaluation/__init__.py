"""Metrics as the field computes them: callables on arrays and trajectories, no files, no printing."""

from vggtgeo.evaluation.absolute import AbsoluteError, absolute_error
from vggtgeo.evaluation.alignment import Similarity, umeyama
from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, associate, nearest_in_time
from vggtgeo.evaluation.clouds import CloudError, cloud_error
from vggtgeo.evaluation.depth import DepthError, depth_error, depth_of_cloud
from vggtgeo.evaluation.relative import RelativeError, relative_error, rotation_angle
from vggtgeo.evaluation.report import TrajectoryReport, evaluate_trajectory
from vggtgeo.evaluation.statistics import ErrorStatistics

__all__ = [
    "MAX_TIME_DIFFERENCE",
    "AbsoluteError",
    "CloudError",
    "DepthError",
    "ErrorStatistics",
    "RelativeError",
    "Similarity",
    "TrajectoryReport",
    "absolute_error",
    "associate",
    "cloud_error",
    "depth_error",
    "depth_of_cloud",
    "evaluate_trajectory",
    "nearest_in_time",
    "relative_error",
    "rotation_angle",
    "umeyama",
]
