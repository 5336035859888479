"""Estimation of an unknown or uncertain camera: focal length, lens distortion, rolling shutter, pixel aspect."""
