"""Thresholds of the verdict, set on simulated runs and measured on those of `benchmarks/verdict_bank.py`.

Numbers of methods (windows, steps) are in the files that use them, plausible depths of rooms in `datasets/check.py`.
"""

import numpy as np

SIGNIFICANCE = 1e-6
"""Significance level of an alternative; seven are tried in each window."""
SIGMAS = 2.0
"""Standard deviations that a difference from the run must exceed: at 2, four fifths of the squared mean of both halves
of the tracks is common to them."""
MAX_PLACE_ERROR, MAX_PLACE_ERROR_SHARE = 0.05, 0.06
"""Largest error of places that does not matter, RMS over a window, or over the run where frames were lost or repeat a
picture: metres, and share of the path's extent for a map that is not metric."""
MAX_TURN_ERROR = np.deg2rad(0.45)
"""Largest difference of turns from frame to frame that does not matter, radians, RMS over a window."""
MIN_SECOND_MOTION_SHARE = 0.2
"""Minimum share of the observations that contradict the first motion, and that a second one explains, to accept it."""
MIN_INLIER_WEIGHT, MAX_UNPREDICTED = 0.5, 0.5
"""Minimum robust weight of an inlier, for a track the mean of its observations; maximum share of outliers in one half
of the tracks if a motion fitted to the other half is to be accepted."""
MAX_DEPTH_NOISE = 0.08
"""Maximum relative noise of depth of the same scene: sensors reach 4 % at the end of their range."""
MIN_SENSOR_DEPTH = 0.2
"""Smallest depth that sensors for rooms measure, metres."""
MAX_UNKNOWN = 0.55
"""Maximum median standard deviation of the places, as a share of their spread, of a path that is determined."""
ACCELERATION = 1.0
"""Standard deviation of a hand-held camera's acceleration, m/s^2."""
MAX_LOST, MIN_TRACKED = 0.10, 0.5
"""Maximum share of lost frames in a good run; minimum share of tracked frames, below which the run has failed."""
MAX_UNMOVED = 1e-3
"""Median motion of corners between frames with the same picture, pixels: rounding. Noise moves them by hundredths."""
MAX_REASONS = 3
"""Maximum number of reasons that corners give."""
MIN_VIEWS, MIN_COMMON = 3, 10
"""Minimum number of frames of a window that see a track, two of which determine its point; and of corners that link a
frame to the next: twenty numbers for six unknowns."""
MIN_PIXEL_NOISE, MIN_RELATIVE_DEPTH_NOISE = 0.05, 0.003
"""Smallest noise, pixels and relative: below, everything would be significant in a simulation without noise."""
