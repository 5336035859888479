"""Hand-held walks: a smooth closed path through a scene, walked at an uneven pace with swaying hands.

The path is a polygon through way points, resampled by arc length and smoothed with a periodic Gaussian; speed, sway
and tremor are sums of seeded sinusoids. So the pose is a smooth function of time alone: frame k is the same however
many frames are asked for, and poses between frames (motion blur, rolling exposure) are exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.ndimage import gaussian_filter1d

_STEP = 0.01  # metres between samples of the path


@dataclass(frozen=True)
class Walk:
    """Where a scene is walked through.

    way: float [n, 3], way points of the camera, metres; the walk returns from the last to the first. targets:
    float [n, 3], what is looked at from each, or None: look ahead along the path. speed: metres a second.
    corner, turn: length in metres over which a corner of the path, and of the gaze, is rounded. glance: amplitude in
    radians of slow looking left and right. pitch: radians, below the horizon negative (looking ahead only).
    """

    way: np.ndarray
    targets: np.ndarray | None = None
    speed: float = 0.4
    corner: float = 0.30
    turn: float = 0.35
    glance: float = 0.0
    pitch: float = -0.09


@dataclass(frozen=True, eq=False)
class HandheldMotion:
    """Pose as a function of time, seconds.

    path: float64 [m + 1, 5], (x, y, z, yaw, pitch) each `step` metres along the closed path; metres and radians, yaw
    unwrapped. The last row is the first one, one round later. speed: metres a second. waves: float64 [7, w, 3],
    (frequency in rad/s, phase, amplitude) of pace (s), sway x y z (metres) and tremor (radians) in yaw, pitch, roll.
    """

    path: np.ndarray
    step: float
    speed: float
    waves: np.ndarray

    @classmethod
    def along(cls, walk: Walk, seed: int) -> Self:
        """Return the motion of one person on `walk`."""
        corners = np.vstack([walk.way, walk.way[:1]])
        chords = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        at = np.concatenate([[0.0], np.cumsum(chords)])
        count = round(float(at[-1]) / _STEP)
        samples = np.arange(count) * at[-1] / count
        rough = np.stack([np.interp(samples, at, corners[:, k]) for k in range(3)], axis=1)
        positions = gaussian_filter1d(rough, walk.corner / _STEP, axis=0, mode="wrap")
        yaw, pitch = _gaze_ahead(positions, walk) if walk.targets is None else _gaze_at(samples, at, walk)
        yaw, winding = _smooth_angle(yaw, walk.turn / _STEP)
        pitch = gaussian_filter1d(pitch, walk.turn / _STEP, mode="wrap")
        path = np.column_stack([positions, yaw, pitch])
        path = np.vstack([path, path[0] + [0, 0, 0, winding, 0]])
        step = float(np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1).mean())
        return cls(path, step, walk.speed, _waves(np.random.default_rng([seed, 17])))

    @property
    def length(self) -> float:
        """Length of one round, metres, without the sway."""
        return self.step * (len(self.path) - 1)

    def camera_to_world(self, time: float) -> np.ndarray:
        """Return pose at `time` (seconds), camera -> world, float64 [4, 4]."""
        place = self.speed * (time + _integral(self.waves[0], time)) % self.length
        low = min(int(place / self.step), len(self.path) - 2)
        share = place / self.step - low
        x, y, z, yaw, pitch = (1 - share) * self.path[low] + share * self.path[low + 1]
        east, north, up, turn, nod, roll = (_value(wave, time) for wave in self.waves[1:])
        return _pose(np.array([x + east, y + north, z + up]), yaw + turn, pitch + nod, roll)


def _gaze_ahead(positions: np.ndarray, walk: Walk) -> tuple[np.ndarray, np.ndarray]:
    reach = int(0.6 / _STEP)
    ahead = np.roll(positions, -reach, axis=0) - positions
    flat = np.hypot(ahead[:, 0], ahead[:, 1])
    length = len(positions) * _STEP
    glances = max(1, round(length / 7.0))
    glance = walk.glance * np.sin(2 * np.pi * glances * np.arange(len(positions)) / len(positions))
    slope = np.arctan2(ahead[:, 2], np.maximum(flat, 0.3))
    return np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])) + glance, walk.pitch + 0.7 * slope


def _gaze_at(samples: np.ndarray, at: np.ndarray, walk: Walk) -> tuple[np.ndarray, np.ndarray]:
    assert walk.targets is not None
    towards = np.vstack([walk.targets - walk.way, (walk.targets - walk.way)[:1]])
    yaw = np.unwrap(np.arctan2(towards[:, 1], towards[:, 0]))
    pitch = np.arctan2(towards[:, 2], np.hypot(towards[:, 0], towards[:, 1]))
    return np.interp(samples, at, yaw), np.interp(samples, at, pitch)


def _smooth_angle(angle: np.ndarray, width: float) -> tuple[np.ndarray, float]:
    """Smooth an unwrapped angle periodically; return it and the whole turns it gains in one period."""
    winding = 2 * np.pi * np.round((angle[-1] - angle[0]) / (2 * np.pi))
    trend = winding * np.arange(len(angle)) / len(angle)
    return gaussian_filter1d(angle - trend, width, mode="wrap") + trend, float(winding)


def _waves(rng: np.random.Generator) -> np.ndarray:
    """Return seeded sinusoids; the vertical sway also has the 1.8 Hz bob of walking."""
    rms = np.array([0.22, 0.007, 0.007, 0.005, 0.009, 0.009, 0.010])
    highest = np.array([0.4, 1.5, 1.5, 1.5, 2.5, 2.5, 1.5])
    count = 10
    frequency = 2 * np.pi * np.exp(rng.uniform(np.log(0.1), np.log(highest)[:, None], (7, count)))
    phase = rng.uniform(0, 2 * np.pi, (7, count))
    share = rng.uniform(0.4, 1.0, (7, count)) / np.sqrt(frequency)
    amplitude = rms[:, None] * np.sqrt(2) * share / np.linalg.norm(share, axis=1, keepdims=True)
    waves = np.stack([frequency, phase, amplitude], axis=2)
    waves[3, 0] = 2 * np.pi * 1.8, phase[3, 0], 0.008
    return waves


def _value(wave: np.ndarray, time: float) -> float:
    return float(np.sum(wave[:, 2] * np.sin(wave[:, 0] * time + wave[:, 1])))


def _integral(wave: np.ndarray, time: float) -> float:
    angle = wave[:, 0] * time + wave[:, 1]
    return float(np.sum(wave[:, 2] / wave[:, 0] * (np.cos(wave[:, 1]) - np.cos(angle))))


def _pose(position: np.ndarray, yaw: float, pitch: float, roll: float) -> np.ndarray:
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    pose[:3, 1] = np.cos(roll) * down - np.sin(roll) * right
    pose[:3, 2] = forward
    pose[:3, 3] = position
    return pose
