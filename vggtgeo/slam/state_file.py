"""Classes of a state in files (checkpoints, maps): `step` continues from a loaded state exactly as from the saved one.

Everything is stored, also what could be recomputed (the view of the reference, the last window's problem): that would
need the poses and the camera at the time of its computation, and costs more to compute than to read. For a pending
window adjustment the result is awaited and stored separately: it is used at the frame at which it is due.
"""

from __future__ import annotations

from pathlib import Path

import jaxlie

from vggtgeo.bundle.padding import SlotIndex
from vggtgeo.bundle.problem import Edges, Problem, State, Terms
from vggtgeo.bundle.terms.landmark import DepthPrior
from vggtgeo.bundle.terms.marginal import MarginalPrior
from vggtgeo.bundle.terms.measured_pose import BaselinePrior, RelativePose, RotationPrior, SurfaceAlignment
from vggtgeo.bundle.terms.node import IntrinsicsPrior
from vggtgeo.bundle.terms.reprojection import LineTerm, PointTerm
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.camera_models import Pinhole
from vggtgeo.io.errors import InputError
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors
from vggtgeo.models.onnx.fit import Fit
from vggtgeo.models.onnx.point_matchers import Mast3rView
from vggtgeo.models.roles import Features, LineFeatures, LineMatches, PointMatches, Segments
from vggtgeo.slam.camera.camera_estimate import CameraEstimate, Readout
from vggtgeo.slam.perception.rgbd_view import Points, RgbdView
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.factors import MeasuredBaseline, MeasuredRelativePose, MeasuredRotation
from vggtgeo.slam.sparse_map.keyframe import CompressedImage, Keyframe, KeyframeImages, Slots
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import PendingWindow, Slam
from vggtgeo.slam.tracking.pose_acceptance import TrackingQuality
from vggtgeo.slam.tracking.tracking_state import FramePose, SecondMotion, SeenPoints, Tracker, UnplacedFrame
from vggtgeo.slam.window.adjustment import Adjustment
from vggtgeo.slam.window.sliding_window import Window, WindowPrior
from vggtgeo.solvers.kernels import Barron, Cauchy, GemanMcClure, Huber, Square
from vggtgeo.solvers.levenberg_marquardt import IterationRecord

STATE_CLASSES: tuple[type, ...] = (
    *(Slam, Map, CameraEstimate, Readout, Camera, Keyframe, Slots, KeyframeImages, CompressedImage),
    *(Tracker, FramePose, SecondMotion, SeenPoints, UnplacedFrame, TrackingQuality, Window, WindowPrior, PendingWindow),
    *(Features, PixelDescriptors, Mast3rView, Fit, LineFeatures, Segments, Pair, PointMatches, LineMatches),
    *(MeasuredRotation, MeasuredBaseline, MeasuredRelativePose, MarginalPrior),
    *(Adjustment, Problem, Terms, State, Edges, SlotIndex, Pinhole, jaxlie.SE3, jaxlie.SO3),
    *(PointTerm, LineTerm, DepthPrior, IntrinsicsPrior, RelativePose, SurfaceAlignment, RotationPrior, BaselinePrior),
    *(Square, Huber, Cauchy, GemanMcClure, Barron, IterationRecord, RgbdView, Points),
)
"""All classes that a file may have; a state with any other (descriptors of a user's matcher) is not written."""
VERSION = 22
"""Of the content: a file of another one is refused."""


def checked_state(path: Path, found: object) -> Slam:
    """Return a loaded state; raise InputError for another value."""
    if not isinstance(found, Slam):
        raise InputError(f"`{path}` holds a {type(found).__name__}; expected the state of a run")
    return found
