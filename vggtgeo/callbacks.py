"""Callbacks that collect something from a run: see `vggtgeo.Callback`."""

from vggtgeo.mapping.depth_fusion import SurfaceFusion as SurfaceFusion
from vggtgeo.slam.verdict.corner_recorder import CornerRecorder as CornerRecorder
