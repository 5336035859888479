"""Compute metrics of trajectories, depth and maps, by functions on arrays and trajectories."""

from vggtgeo.evaluation.alignment import Similarity as Similarity
from vggtgeo.evaluation.alignment import align as align
from vggtgeo.evaluation.alignment import heading as heading
from vggtgeo.evaluation.alignment import umeyama as umeyama
from vggtgeo.evaluation.association import associate as associate
from vggtgeo.evaluation.association import nearest_in_time as nearest_in_time
from vggtgeo.evaluation.association import shifted as shifted
from vggtgeo.evaluation.comparability import comparability as comparability
from vggtgeo.evaluation.maps import CloudError as CloudError
from vggtgeo.evaluation.maps import cloud_error as cloud_error
from vggtgeo.evaluation.maps import depth_error as depth_error
from vggtgeo.evaluation.maps import surface_points as surface_points
from vggtgeo.evaluation.offsets import Offsets as Offsets
from vggtgeo.evaluation.offsets import estimate_offsets as estimate_offsets
from vggtgeo.evaluation.pose_errors import AbsoluteError as AbsoluteError
from vggtgeo.evaluation.pose_errors import ErrorStatistics as ErrorStatistics
from vggtgeo.evaluation.pose_errors import absolute_error as absolute_error
from vggtgeo.evaluation.pose_errors import pose_consistency as pose_consistency
from vggtgeo.evaluation.pose_errors import relative_error as relative_error
from vggtgeo.evaluation.pose_errors import rotation_angle as rotation_angle
from vggtgeo.evaluation.report import TrajectoryReport as TrajectoryReport
from vggtgeo.evaluation.report import coverage as coverage
from vggtgeo.evaluation.report import evaluate_trajectory as evaluate_trajectory
from vggtgeo.evaluation.report import followed as followed
