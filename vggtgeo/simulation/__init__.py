"""Synthetic indoor worlds: rendered RGB and depth along hand-held walks, with exact truth for everything.

A number measured here is a simulated number and is always called so.
"""

from vggtgeo.simulation.oracle import SimulatedOracle as SimulatedOracle
from vggtgeo.simulation.render import Picture as Picture
from vggtgeo.simulation.render import render as render
from vggtgeo.simulation.scene import Scene as Scene
from vggtgeo.simulation.sequence import IDEAL as IDEAL
from vggtgeo.simulation.sequence import WORLDS as WORLDS
from vggtgeo.simulation.sequence import Sensor as Sensor
from vggtgeo.simulation.sequence import SyntheticSequence as SyntheticSequence
from vggtgeo.simulation.sequence import simulate as simulate
from vggtgeo.simulation.sequence import write_tum_folder as write_tum_folder
from vggtgeo.simulation.small_window import SimulatedWindow as SimulatedWindow
from vggtgeo.simulation.small_window import simulate_window as simulate_window
