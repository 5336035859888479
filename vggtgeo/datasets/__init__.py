"""Readers: sequences of frames from folders and videos. `open_sequence` finds the right one."""

from vggtgeo.datasets.frame import Frame, Sequence
from vggtgeo.datasets.images import ImageFolder
from vggtgeo.datasets.intrinsics import parse_intrinsics
from vggtgeo.datasets.opening import KINDS, open_sequence
from vggtgeo.datasets.seven_scenes import SevenScenes
from vggtgeo.datasets.tum import TumRgbd
from vggtgeo.datasets.video import VideoFile
from vggtgeo.datasets.views import SequenceView, with_depth_scale, with_intrinsics, with_rate, without_depth

__all__ = [
    "KINDS",
    "Frame",
    "ImageFolder",
    "Sequence",
    "SequenceView",
    "SevenScenes",
    "TumRgbd",
    "VideoFile",
    "open_sequence",
    "parse_intrinsics",
    "with_depth_scale",
    "with_intrinsics",
    "with_rate",
    "without_depth",
]
