"""Camera models: how a point in front of a camera becomes a pixel.

`Pinhole` (fx, fy, cx, cy), `RadialTangential` (with k1, k2, p1, p2), `KannalaBrandt` (fisheye); your own is a
subclass of `AbstractCamera`. `Intrinsics` are those of a problem, with their prior.
"""

from vggtgeo.bundle.intrinsics import Intrinsics as Intrinsics
from vggtgeo.geometry.camera_models import AbstractCamera as AbstractCamera
from vggtgeo.geometry.camera_models import KannalaBrandt as KannalaBrandt
from vggtgeo.geometry.camera_models import Pinhole as Pinhole
from vggtgeo.geometry.camera_models import RadialTangential as RadialTangential
