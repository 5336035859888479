"""What recordings and simulations are made of."""

from vggtgeo.datasets import Frame as Frame
from vggtgeo.simulation import SimulatedWindow as SimulatedWindow
