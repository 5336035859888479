"""Camera models: how a point in front of a camera becomes a pixel."""

from vggtgeo.geometry.camera_models import AbstractCamera as AbstractCamera
from vggtgeo.geometry.camera_models import KannalaBrandt as KannalaBrandt
from vggtgeo.geometry.camera_models import Pinhole as Pinhole
from vggtgeo.geometry.camera_models import RadialTangential as RadialTangential
