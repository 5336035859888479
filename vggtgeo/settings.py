"""The groups of `vggtgeo.SlamSettings`, one a stage of the pipeline; and the checkpoints of a run."""

from vggtgeo.results.checkpoints import Checkpoints as Checkpoints
from vggtgeo.slam.settings.groups import CameraSettings as CameraSettings
from vggtgeo.slam.settings.groups import DepthSettings as DepthSettings
from vggtgeo.slam.settings.groups import GlobalMapSettings as GlobalMapSettings
from vggtgeo.slam.settings.groups import KeyframeSettings as KeyframeSettings
from vggtgeo.slam.settings.groups import LineSettings as LineSettings
from vggtgeo.slam.settings.groups import WeightSettings as WeightSettings
from vggtgeo.slam.settings.groups import WindowSettings as WindowSettings
