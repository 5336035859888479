"""Cameras, rigid motions, trajectories, point clouds: no optimisation."""
