"""How often a run writes checkpoints; apart, so that `vggtgeo run --help` need not import what writes them."""

EVERY = 10.0
"""Seconds between two checkpoints."""
SHARE = 0.025
"""Maximum share of a run's time for checkpoints."""
