"""Camera models: how a point in front of a camera becomes a pixel."""

from vggtgeo.geometry.cameras import AbstractCamera as AbstractCamera
from vggtgeo.geometry.cameras import KannalaBrandt as KannalaBrandt
from vggtgeo.geometry.cameras import Pinhole as Pinhole
from vggtgeo.geometry.cameras import RadialTangential as RadialTangential
from vggtgeo.geometry.cameras import SquareKannalaBrandt as SquareKannalaBrandt
from vggtgeo.geometry.cameras import SquarePinhole as SquarePinhole
from vggtgeo.geometry.cameras import SquarePixels as SquarePixels
from vggtgeo.geometry.cameras import SquareRadialTangential as SquareRadialTangential
