"""The terms of a problem: what observations say about poses, landmarks and cameras, and how to write your own.

Base classes for your own residual, by what one observation touches: `ImageTerm` (the pixel of a landmark in
another image), `EdgeTerm` (a landmark and two poses), `SlotTerm` (the inverse depth of a landmark),
`PoseTerm` (a pose and its camera), `PairTerm` (two poses, `first` and `second`), `CameraTerm` (the parameters of the
camera), `DenseTerm` (all poses and the camera). `FlatTerm` holds rows before packing; `View` is the argument of an
`EdgeTerm`.

Ready terms: `PointTerm`, `LineTerm`, `DepthPrior`, `HostPixel`, `BaselinePrior` (distance of two cameras),
`RelativePose`, `RotationPrior`, `IntrinsicsPrior`, `MarginalPrior`.
"""

from vggtgeo.bundle.observations import FlatTerm as FlatTerm
from vggtgeo.bundle.terms.landmark import DepthPrior as DepthPrior
from vggtgeo.bundle.terms.landmark import HostPixel as HostPixel
from vggtgeo.bundle.terms.landmark import SlotTerm as SlotTerm
from vggtgeo.bundle.terms.landmark_edge import EdgeTerm as EdgeTerm
from vggtgeo.bundle.terms.landmark_edge import View as View
from vggtgeo.bundle.terms.marginal import MarginalPrior as MarginalPrior
from vggtgeo.bundle.terms.measured_pose import BaselinePrior as BaselinePrior
from vggtgeo.bundle.terms.measured_pose import RelativePose as RelativePose
from vggtgeo.bundle.terms.measured_pose import RotationPrior as RotationPrior
from vggtgeo.bundle.terms.node import CameraTerm as CameraTerm
from vggtgeo.bundle.terms.node import DenseTerm as DenseTerm
from vggtgeo.bundle.terms.node import IntrinsicsPrior as IntrinsicsPrior
from vggtgeo.bundle.terms.node import PairTerm as PairTerm
from vggtgeo.bundle.terms.node import PoseTerm as PoseTerm
from vggtgeo.bundle.terms.reprojection import ImageTerm as ImageTerm
from vggtgeo.bundle.terms.reprojection import LineTerm as LineTerm
from vggtgeo.bundle.terms.reprojection import PointTerm as PointTerm
from vggtgeo.bundle.terms.term import AbstractTerm as AbstractTerm
from vggtgeo.bundle.terms.term import shared_field as shared_field
