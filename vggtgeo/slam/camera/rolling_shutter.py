"""The rolling shutter: estimated in the last adjustment and removed from it.

Cameras of phones and depth cameras read an image row by row, over 5 to 30 ms, while the camera moves: a match in row
`v` of `H` shows its landmark `(v / H - 1/2) T` after the middle of the image. The velocity of each keyframe is known
from the neighbouring frames. So matches are moved to where they would be at the middle of the image, and the map is
adjusted again, for the readout time `T` with the least energy. The secant method finds the zero of the energy's
derivative, which at an adjusted map needs no other adjustment (envelope theorem).

A phone held upright reads columns of the displayed image; the direction with the more significant slope is used.

Without measured depth the map deforms to explain a rolling shutter (`benchmarks/rolling_shutter.py`). Matching and
tracking still treat each image as one moment, and may fail if pixels move by 10 px during the readout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import stdtrit

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.geometry import pinhole, rigid
from vggtgeo.slam.camera.camera_comparison import (
    MIN_HOSTS,
    Shifts,
    carried,
    gain,
    match_energies,
    pinhole_of,
    shifted_problem,
)
from vggtgeo.slam.camera.camera_estimate import Readout
from vggtgeo.slam.threads import BATCH, map_in_threads

FIRST_SHIFT, CONVERGED = 1.0, 0.05
"""Median displacement of matches, pixels: the first step of the search, and the step that ends it, a tenth of the noise
of a key point."""
FASTEST = 1e6
"""Pixels a second: larger velocities come from landmarks at the camera's centre."""
PROBE = CONVERGED
"""Step of the finite difference, in the same unit."""
SOLVES = 6
"""Largest number of adjustments, in which a secant method finds the readout time."""
LONGEST = 2.0
"""Largest step relative to the previous one."""
WORTH_A_TRIAL = 0.05
"""Significance level of the slope (Student's t over keyframes) below which no search is made: one in twenty is in vain,
and takes seconds."""
USUAL_LARGEST = 90
"""Percentile of the displacements that is reported: the largest but for outliers and the nearest points."""

Solve = Callable[[Problem, State], State]


@dataclass(frozen=True, eq=False)
class FoundReadout:
    """The result of a search: the readout, the corrected problem and its adjusted map, the mean decrease of a match's
    robust energy, and the decrease that is significant.
    """

    readout: Readout
    problem: Problem
    state: State
    gain: float
    needed: float

    @property
    def is_significant(self) -> bool:
        """Whether the rolling shutter is significant."""
        return self.gain > self.needed


def row_shifts(problem: Problem, state: State, motions: np.ndarray, size: tuple[int, int], columns: bool) -> Shifts:
    """Return the displacements by a readout of one second, pixels a second.

    size: height and width of the images. columns: images are read column by column.
    """
    camera = pinhole_of(problem, state)
    poses = rigid.to_matrix(np.asarray(state.poses.wxyz_xyz, np.float64))
    pixels, inverse = np.asarray(problem.pixels, np.float64), np.asarray(state.inverse_depth, np.float64)
    shift = lambda at, depth, motion: image_shift(at, depth, motion, camera, size, columns)
    count = problem.terms["points"].weight.shape[1]
    edges = np.stack([np.asarray(problem.edges.source), np.asarray(problem.edges.target)], 1)
    matched = np.asarray(problem.terms["points"].target, np.float64)

    def of_edges(part: slice) -> tuple[np.ndarray, np.ndarray]:
        host, target = edges[part].T
        seen, depth = carried(pixels[host], inverse[host], poses[target] @ rigid.invert(poses[host]), camera)
        points = shift(matched[part], depth[:, :count], motions[target])
        lines = shift(seen[:, count:], depth[:, count:], motions[target])
        return points.astype(np.float32), lines.astype(np.float32)

    parts = map_in_threads(of_edges, (slice(first, first + BATCH) for first in range(0, len(edges), BATCH)))
    points, lines = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Shifts(shift(pixels, inverse, motions), points, lines)


def image_shift(
    pixels: np.ndarray,
    inverse: np.ndarray,
    motion: np.ndarray,
    camera: np.ndarray,
    size: tuple[int, int],
    columns: bool,
) -> np.ndarray:
    """Return the velocity in the image [a, b, 2] of pixels [a, b, 2] at inverse depths [a, b] under motions [a, 6],
    times the relative time of their row; zero for points that are not in front of the camera.
    """
    ray = pinhole.rays(pixels, camera)
    with np.errstate(all="ignore"):
        moved = motion[:, None, :3] * inverse[..., None] + np.cross(motion[:, None, 3:], ray)
        velocity = (moved[..., :2] - ray[..., :2] * moved[..., 2:]) * camera[:2]
        axis = 0 if columns else 1
        moment = (pixels[..., axis] + 0.5) / size[1 - axis] - 0.5
        shift = moment[..., None] * velocity
    known = np.isfinite(shift).all(-1, keepdims=True) & (inverse > 0)[..., None]
    return np.clip(np.where(known, shift, 0.0), -FASTEST, FASTEST)


def to_global_shutter(
    pixels: np.ndarray,
    inverse: np.ndarray,
    motion: np.ndarray,
    camera: np.ndarray,
    size: tuple[int, int],
    readout: Readout,
) -> np.ndarray:
    """Return pixels [m, 2] of one image as at the middle of its readout; see `image_shift`."""
    there = np.asarray(pixels, np.float64)
    shift = image_shift(there[None], inverse[None], motion[None], camera, size, readout.columns)[0]
    return np.asarray(there - readout.seconds * shift)


def pair_to_global_shutter(
    matches: tuple[np.ndarray, np.ndarray],
    depth: np.ndarray,
    relative: np.ndarray,
    motions: tuple[np.ndarray, np.ndarray],
    camera: np.ndarray,
    size: tuple[int, int],
    readout: Readout,
) -> tuple[np.ndarray, np.ndarray]:
    """Return matches, [m, 2] in either image, as by global shutters. depth: [m], in the first; relative: [4, 4], first
    camera -> second; motions: [6] of each, see `camera_motions`.
    """
    (before, after), inverse = matches, 1.0 / depth
    _, there = carried(before[None], inverse[None], relative[None], camera)
    return (
        to_global_shutter(before, inverse, motions[0], camera, size, readout),
        to_global_shutter(after, there[0], motions[1], camera, size, readout),
    )


def problem_to_global_shutter(
    problem: Problem, state: State, motions: np.ndarray, size: tuple[int, int], readout: Readout
) -> Problem:
    """Return the problem corrected for a known readout; state: an estimate of the map."""
    shifts = row_shifts(problem, state, motions, size, readout.columns)
    return shifted_problem(problem, shifts, readout.seconds, max(size) / 2)


@dataclass(frozen=True, eq=False)
class _Search:
    """A problem and the displacements of its matches per second of readout time."""

    problem: Problem
    shifts: Shifts
    most: float

    @cached_property
    def usual(self) -> float:
        """Median displacement of the matches, pixels a second."""
        return float(np.median(self.sizes)) if len(self.sizes) else 0.0

    @cached_property
    def sizes(self) -> np.ndarray:
        """Displacement of each match, the larger of host and target, pixels a second."""
        source = np.asarray(self.problem.edges.source)
        points = self.shifts.points.shape[1]
        both = np.stack([self.shifts.slots[source][:, :points], self.shifts.points], -2)
        return np.asarray(np.linalg.norm(both, axis=-1).max(-1)[np.asarray(self.problem.terms["points"].present())])

    def at(self, seconds: float) -> Problem:
        """Return the problem corrected for this readout time."""
        return shifted_problem(self.problem, self.shifts, seconds, self.most)

    def slopes(self, seconds: float, state: State) -> np.ndarray:
        """Return the derivative of the energy of each keyframe's matches by the readout time, float64 [n]."""
        step = PROBE / self.usual
        later, earlier = (match_energies(self.at(seconds + sign * step), state) for sign in (1, -1))
        each = np.where(np.asarray(self.problem.terms["points"].present()), later - earlier, 0.0).sum(1) / (2 * step)
        sums = np.zeros(self.problem.num_keyframes)
        np.add.at(sums, np.asarray(self.problem.edges.source), each)
        return sums


def find_readout(
    problem: Problem, state: State, motions: np.ndarray, size: tuple[int, int], longest: float, solve: Solve
) -> FoundReadout | None:
    """Estimate the readout time of a map; return None if no rolling shutter is significant.

    problem, state: an adjustment that assumes global shutters. motions: see `camera_motions`. longest: upper bound of
    the readout time, s: the time between frames. solve: adjusts any problem of the same shape.
    """
    chosen, surest = None, 0.0
    for columns in (False, True):
        shifts = row_shifts(problem, state, motions, size, columns)
        search = _Search(problem, shifts, max(size) / 2)
        if search.usual * longest < CONVERGED:
            continue
        slopes = search.slopes(0.0, state)
        slopes = slopes[slopes != 0]
        if len(slopes) < MIN_HOSTS:
            continue
        sure = abs(slopes.sum()) / np.sqrt(np.sum(slopes**2)) / -stdtrit(len(slopes) - 1, WORTH_A_TRIAL)
        if sure > max(surest, 1.0):
            chosen, surest = (columns, search, float(slopes.sum())), sure
    if chosen is None:
        return None
    columns, search, slope = chosen
    seconds, moved = _descend(search, state, slope, longest, solve)
    without = search.at(seconds)
    better, needed = gain((problem, state), (without, moved), np.asarray(problem.terms["points"].present()), fitted=2)
    shift = float(np.percentile(search.sizes, USUAL_LARGEST)) * abs(seconds)
    return FoundReadout(Readout(seconds, columns, shift), without, moved, better, needed)


def _descend(search: _Search, state: State, slope: float, longest: float, solve: Solve) -> tuple[float, State]:
    """Return the readout time with zero slope, or the upper bound, and the map adjusted to it."""
    lower, upper = (0.0, slope), None
    seconds = -np.sign(slope) * min(FIRST_SHIFT / search.usual, longest)
    for _ in range(SOLVES):
        state = solve(search.at(seconds), state)
        here = seconds, float(search.slopes(seconds, state).sum())
        if not np.isfinite(here[1]):
            break
        step = here[0] - lower[0]
        farthest = here[0] + LONGEST * step
        sought = _zero(lower, here)
        lower, upper = (lower, here) if here[1] * slope <= 0 else (here, upper)
        if upper is None:
            ahead = np.isfinite(sought) and (sought - here[0]) * step > 0
            following = np.clip(min(sought, farthest, key=abs) if ahead else farthest, -longest, longest)
        else:
            following = _zero(lower, upper)
        if abs(following - seconds) * search.usual < CONVERGED:
            break
        seconds = float(following)
    else:
        state = solve(search.at(seconds), state)
    return float(seconds), state


def _zero(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Return the zero of the line through two slopes; not finite if they are equal."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.divide(one[0] * other[1] - other[0] * one[1], other[1] - one[1]))
