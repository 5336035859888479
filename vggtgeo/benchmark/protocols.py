"""Evaluation protocols of the literature: which frames are used, and which poses are evaluated.

With any protocol, errors are reported after SE(3) and after Sim(3), with the scale: Sim(3) alone hides the scale error,
which for monocular systems is 2 to 10 times as large as the error it shows.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Protocol:
    """stride: take every n-th frame. poses: evaluate "all" frames or "keyframes". about: source and description."""

    stride: int
    poses: str
    about: str


PROTOCOLS: dict[str, Protocol] = {
    "every-frame": Protocol(1, "all", "a pose for every frame, metric"),
    "every-frame-sim3": Protocol(1, "all", "a pose for every frame, scale free"),
    "mast3r-slam": Protocol(
        2, "keyframes", "MASt3R-SLAM: every second frame, keyframes only, `evo_ape tum GT EST -as`"
    ),
    "droid-slam": Protocol(2, "all", "DROID-SLAM: every second frame, a pose for each of them"),
    "dpvo": Protocol(1, "all", "DPVO: every frame; its own tables print the median of the trials, these the mean"),
    "vggt-slam": Protocol(1, "keyframes", "VGGT-SLAM: keyframes by the flow of the image"),
}
