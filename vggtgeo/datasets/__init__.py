"""Readers: sequences of frames from folders and videos. `open_sequence` finds the right one."""

from vggtgeo.datasets.frame import Frame as Frame
from vggtgeo.datasets.frame import Sequence as Sequence
from vggtgeo.datasets.images import ImageFolder as ImageFolder
from vggtgeo.datasets.intrinsics import parse_intrinsics as parse_intrinsics
from vggtgeo.datasets.opening import KINDS as KINDS
from vggtgeo.datasets.opening import open_sequence as open_sequence
from vggtgeo.datasets.seven_scenes import SevenScenes as SevenScenes
from vggtgeo.datasets.tum import TumRgbd as TumRgbd
from vggtgeo.datasets.video import VideoFile as VideoFile
from vggtgeo.datasets.views import SequenceView as SequenceView
from vggtgeo.datasets.views import with_depth_scale as with_depth_scale
from vggtgeo.datasets.views import with_intrinsics as with_intrinsics
from vggtgeo.datasets.views import with_rate as with_rate
from vggtgeo.datasets.views import without_depth as without_depth
