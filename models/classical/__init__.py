"""Classical implementations of the five perception roles: OpenCV and numpy, no weights."""

from vggtgeo.models.classical.flow import PatchFlow
from vggtgeo.models.classical.guided_search import can_search, search_around, search_near, search_tree
from vggtgeo.models.classical.line_geometry import line_coefficients, sample_segments, segment_depths
from vggtgeo.models.classical.lines import BandLineMatcher, LsdDetector
from vggtgeo.models.classical.manhattan import ManhattanEstimator, ManhattanView, nearest_frame
from vggtgeo.models.classical.pixel_matcher import OrbMatcher, SiftMatcher, match_pixels
from vggtgeo.models.classical.place import place_vector
from vggtgeo.models.classical.pnp import ConstantVelocity, PnpGeometry, pose_information
from vggtgeo.models.classical.sample_order import SampleOrder, in_order
from vggtgeo.models.classical.sensor_depth import NoDepth, SensorDepth
from vggtgeo.models.classical.structure_tensor import StructureTensor
from vggtgeo.models.classical.sub_pixel import PatchAlignment
from vggtgeo.models.classical.two_view import TwoViewStart
from vggtgeo.models.classical.verification import EpipolarVerifier

__all__ = [
    "BandLineMatcher",
    "ConstantVelocity",
    "EpipolarVerifier",
    "LsdDetector",
    "ManhattanEstimator",
    "ManhattanView",
    "NoDepth",
    "OrbMatcher",
    "PatchAlignment",
    "PatchFlow",
    "PnpGeometry",
    "SampleOrder",
    "SensorDepth",
    "SiftMatcher",
    "StructureTensor",
    "TwoViewStart",
    "can_search",
    "in_order",
    "line_coefficients",
    "match_pixels",
    "nearest_frame",
    "place_vector",
    "pose_information",
    "sample_segments",
    "search_around",
    "search_near",
    "search_tree",
    "segment_depths",
]
