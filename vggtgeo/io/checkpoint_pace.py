"""How often a run keeps its state. By itself, so that `vggtgeo run --help` can tell it without what writes states."""

EVERY = 10.0
"""Seconds between two states that are kept."""
SHARE = 0.025
"""Most of a run's time that keeping its state may take."""
