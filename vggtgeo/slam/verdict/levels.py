"""The numbers that decide. Those of methods (windows, iterations) stand where they are used.

They were set on simulated runs, and are measured on those of `benchmarks/verdict_bank.py`.
"""

import numpy as np

LEVEL = 1e-6
"""Significance of an alternative; seven are tried in each window."""
SIGMAS = 2.0
"""Standard deviations of a consequence: two halves of the tracks then agree on four fifths of its square."""
PLACES = 0.05
"""Metres, RMS over a window."""
SHARE = 0.06
"""Of the path's extent, in place of `PLACES` where lengths have no unit."""
TURN = np.deg2rad(0.45)
"""Radians from frame to frame of a window, RMS."""
MIN_SHARE = 0.15
"""Of the observations that must contradict the first motion before a second one is looked for, and that it explains."""
RIVAL = 0.2
"""Share of the explained corners that follow a second motion, beyond which it is not sure which one is the camera's."""
DEPTH_NOISE = 0.08
"""Relative noise of depth beyond which it says nothing of the scene: sensors reach 4 % at the end of their range."""
NEAREST = 0.2
"""Metres: sensors for rooms see nothing nearer."""
MAX_UNKNOWN = 0.55
"""Median standard deviation of the places over their spread, beyond which a path without depth has no shape."""
ACCELERATION = 1.0
"""m/s^2, of a hand-held camera."""
MAX_BRIDGED = 0.04
"""Metres, RMS over all frames, that frames without a picture of their own may cost."""
MAX_LOST = 0.10
"""Share of the frames that may be lost in a good run."""
MIN_TRACKED = 0.5
"""Share of the frames below which the run has failed."""
UNMOVED = 1e-3
"""Pixels: rounding. The noise of a new picture moves a corner by some hundredths."""
MAX_REASONS = 3
"""That corners give."""
