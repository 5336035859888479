"""Tracking: the pose of a frame from keyframes and map, its acceptance by evidence, and relocalization."""
