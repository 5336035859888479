"""Perception: measurements in one image or between two, without a map."""
