"""The rolling shutter of a camera: found in the last adjustment, and taken out of it.

Cameras of phones and the colour cameras of depth cameras read an image row by row, over 5 to 30 ms, in which the camera
moves on: a match in row `v` of `H` is where its landmark was `(v / H - 1/2) T` after the middle of the image. The
motion of each keyframe is known from the frames beside it, so that the map is adjusted once more with every match where
it would have been at the middle, for the readout time `T` that explains matches best. Sought down the slope of the
energy, whose derivative at an adjusted map needs no other adjustment (the envelope theorem), by the secant method.

A phone that is held upright reads columns of what is shown; the direction whose slope is surer is taken.

Without measured depth the map bends to explain such images, and fits them: 240 frames of building-walk, whose camera
takes 10 ms, were 7.5 cm off, and are 5.0. Frames were
matched and tracked as if each were of one moment, and where they move by 10 px in that time a map may be lost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.stats import t as student_t

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera_models import SquarePinhole
from vggtgeo.slam.camera.camera_estimate import Readout
from vggtgeo.slam.camera.camera_gain import MIN_HOSTS, gain, match_energies
from vggtgeo.slam.threads import map_in_threads

FIRST_SHIFT, SETTLED = 1.0, 0.05
"""Pixels, median of the matches: the first step of the search, and the one at which it ends."""
FASTEST = 1e6
"""Pixels a second: what seems faster is a landmark in the camera."""
PROBE = 0.05
"""Pixels, the same: for derivatives."""
SOLVES = 6
AT_ONCE = 128
"""Edges that are looked at together, by a thread: a building's 15,000 would take gigabytes."""
LONGEST = 2.0
"""Of a step, in the one before."""
WORTH_A_TRIAL = 0.05
"""Chance of a slope as sure as this without a rolling shutter (Student's t over keyframes): a search takes seconds."""
USUAL_LARGEST = 90
"""Percentile of the matches whose shift is told."""

Solve = Callable[[Problem, State], State]


class Shifts(NamedTuple):
    """Pixels a second of readout time by which pixels are off: of slots [n, s, 2], of points [e, p, 2] in the target,
    and of lines [e, l, 2] where their sample is seen.
    """

    slots: np.ndarray
    points: np.ndarray
    lines: np.ndarray


@dataclass(frozen=True, eq=False)
class FoundReadout:
    """The outcome of a search: the readout, the problem without it, the map adjusted to that; and how much the mean
    robust energy of a match falls by it, and has to fall to be no chance.
    """

    readout: Readout
    problem: Problem
    state: State
    gain: float
    needed: float

    @property
    def pays(self) -> bool:
        """Whether it is there."""
        return self.gain > self.needed


def row_shifts(problem: Problem, state: State, motions: np.ndarray, size: tuple[int, int], columns: bool) -> Shifts:
    """What a readout of one second would shift. size: height and width of the images; columns: they are read column by
    column.
    """
    camera = _pinhole(problem, state)
    poses = rigid.to_matrix(np.asarray(state.poses.wxyz_xyz, np.float64))
    pixels, inverse = np.asarray(problem.pixels, np.float64), np.asarray(state.inverse_depth, np.float64)
    shift = lambda at, depth, motion: image_shift(at, depth, motion, camera, size, columns)
    count = problem.points.weight.shape[1]
    edges = np.stack([np.asarray(problem.edges.source), np.asarray(problem.edges.target)], 1)
    matched = np.asarray(problem.points.target, np.float64)

    def of_edges(part: slice) -> tuple[np.ndarray, np.ndarray]:
        host, target = edges[part].T
        seen, depth = carried(pixels[host], inverse[host], poses[target] @ rigid.invert(poses[host]), camera)
        points = shift(matched[part], depth[:, :count], motions[target])
        lines = shift(seen[:, count:], depth[:, count:], motions[target])
        return points.astype(np.float32), lines.astype(np.float32)

    parts = map_in_threads(of_edges, (slice(first, first + AT_ONCE) for first in range(0, len(edges), AT_ONCE)))
    points, lines = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Shifts(shift(pixels, inverse, motions), points, lines)


def carried(
    pixels: np.ndarray, inverse: np.ndarray, relative: np.ndarray, camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [a, b, 2] and inverse depths [a, b] of landmarks as other cameras see them; relative: [a, 4, 4]."""
    rays = _rays(pixels, camera)
    there = np.einsum("aij,abj->abi", relative[:, :3, :3], rays) + relative[:, None, :3, 3] * inverse[..., None]
    with np.errstate(all="ignore"):
        return there[..., :2] / there[..., 2:] * camera[:2] + camera[2:], inverse / there[..., 2]


def _rays(pixels: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """With a depth of one, [..., 3]."""
    return np.concatenate([(pixels - camera[2:]) / camera[:2], np.ones((*pixels.shape[:-1], 1))], -1)


def _pinhole(problem: Problem, state: State) -> np.ndarray:
    """fx, fy, cx, cy of the camera."""
    parameters = np.asarray(state.intrinsics, np.float64)
    return np.array([parameters[0], *parameters]) if problem.camera is SquarePinhole else parameters[:4]


def image_shift(
    pixels: np.ndarray,
    inverse: np.ndarray,
    motion: np.ndarray,
    camera: np.ndarray,
    size: tuple[int, int],
    columns: bool,
) -> np.ndarray:
    """Velocity in the image [a, b, 2], of pixels [a, b, 2] at inverse depths [a, b] under motions [a, 6], by the time
    of their row; zero where they are not in front of the camera.
    """
    rays = _rays(pixels, camera)
    with np.errstate(all="ignore"):
        moved = motion[:, None, :3] * inverse[..., None] + np.cross(motion[:, None, 3:], rays)
        velocity = (moved[..., :2] - rays[..., :2] * moved[..., 2:]) * camera[:2]
        axis = 0 if columns else 1
        moment = (pixels[..., axis] + 0.5) / size[1 - axis] - 0.5
        shift = moment[..., None] * velocity
    known = np.isfinite(shift).all(-1, keepdims=True) & (inverse > 0)[..., None]
    return np.clip(np.where(known, shift, 0.0), -FASTEST, FASTEST)


def at_once(
    pixels: np.ndarray,
    inverse: np.ndarray,
    motion: np.ndarray,
    camera: np.ndarray,
    size: tuple[int, int],
    readout: Readout,
) -> np.ndarray:
    """Pixels [m, 2] of one image, where they would be at the middle of its readout; see `image_shift`."""
    there = np.asarray(pixels, np.float64)
    shift = image_shift(there[None], inverse[None], motion[None], camera, size, readout.columns)[0]
    return np.asarray(there - readout.seconds * shift)


def pair_at_once(
    before: np.ndarray,
    after: np.ndarray,
    depth: np.ndarray,
    relative: np.ndarray,
    motions: tuple[np.ndarray, np.ndarray],
    camera: np.ndarray,
    size: tuple[int, int],
    readout: Readout,
) -> tuple[np.ndarray, np.ndarray]:
    """Matches [m, 2] of two images without the readout of either. depth: [m], in the first; relative: [4, 4], first
    camera -> second; motions: [6] of each, see `camera_motions`.
    """
    inverse = 1.0 / depth
    _, there = carried(before[None], inverse[None], relative[None], camera)
    return (
        at_once(before, inverse, motions[0], camera, size, readout),
        at_once(after, there[0], motions[1], camera, size, readout),
    )


def read_at_once(problem: Problem, shifts: Shifts, seconds: float, most: float) -> Problem:
    """The problem with every match where it would have been at the middle of its image's readout. most: pixels, of a
    shift: beyond are landmarks that have run into the camera.
    """
    slots, points, lines = (np.clip(seconds * shift, -most, most) for shift in shifts)
    coefficients = np.asarray(problem.lines.coefficients, np.float64)
    offset = coefficients[..., 2] + np.sum(coefficients[..., :2] * lines, -1)
    like = lambda values: jnp.asarray(values, problem.pixels.dtype)
    return eqx.tree_at(
        lambda p: (p.pixels, p.points.target, p.lines.coefficients),
        problem,
        (
            like(np.asarray(problem.pixels) - slots),
            like(np.asarray(problem.points.target) - points),
            like(np.concatenate([coefficients[..., :2], offset[..., None]], -1)),
        ),
    )


def without_readout(
    problem: Problem, state: State, motions: np.ndarray, size: tuple[int, int], readout: Readout
) -> Problem:
    """The problem without a readout that is known; state: about where its map is."""
    shifts = row_shifts(problem, state, motions, size, readout.columns)
    return read_at_once(problem, shifts, readout.seconds, max(size) / 2)


@dataclass(frozen=True, eq=False)
class _Search:
    """A map, and what a readout does to it."""

    problem: Problem
    shifts: Shifts
    most: float

    @cached_property
    def usual(self) -> float:
        """Median shift of the matches, pixels a second."""
        return float(np.median(self.sizes)) if len(self.sizes) else 0.0

    @cached_property
    def sizes(self) -> np.ndarray:
        """Of every match, in host and target together, pixels a second."""
        source = np.asarray(self.problem.edges.source)
        points = self.shifts.points.shape[1]
        both = np.stack([self.shifts.slots[source][:, :points], self.shifts.points], -2)
        return np.asarray(np.linalg.norm(both, axis=-1).max(-1)[np.asarray(self.problem.points.present())])

    def at(self, seconds: float) -> Problem:
        """The problem without this readout."""
        return read_at_once(self.problem, self.shifts, seconds, self.most)

    def slopes(self, seconds: float, state: State) -> np.ndarray:
        """Derivative of the energy of each keyframe's matches by the readout time, float64 [n], at an adjusted map."""
        step = PROBE / self.usual
        later, earlier = (match_energies(self.at(seconds + sign * step), state) for sign in (1, -1))
        each = np.where(np.asarray(self.problem.points.present()), later - earlier, 0.0).sum(1) / (2 * step)
        sums = np.zeros(self.problem.num_keyframes)
        np.add.at(sums, np.asarray(self.problem.edges.source), each)
        return sums


def find_readout(
    problem: Problem, state: State, motions: np.ndarray, size: tuple[int, int], longest: float, solve: Solve
) -> FoundReadout | None:
    """The readout that explains the matches of a map best; None where none is to be seen.

    problem, state: an adjustment as if each image were of one moment. motions: see `camera_motions`. longest: seconds
    that it can last, the time from frame to frame. solve: adjusts any problem of its shape.
    """
    chosen, surest = None, 0.0
    for columns in (False, True):
        shifts = row_shifts(problem, state, motions, size, columns)
        search = _Search(problem, shifts, max(size) / 2)
        if search.usual * longest < SETTLED:
            continue
        slopes = search.slopes(0.0, state)
        slopes = slopes[slopes != 0]
        if len(slopes) < MIN_HOSTS:
            continue
        sure = abs(slopes.sum()) / np.sqrt(np.sum(slopes**2)) / student_t.isf(WORTH_A_TRIAL, len(slopes) - 1)
        if sure > max(surest, 1.0):
            chosen, surest = (columns, search, float(slopes.sum())), sure
    if chosen is None:
        return None
    columns, search, slope = chosen
    seconds, moved = _descend(search, state, slope, longest, solve)
    without = search.at(seconds)
    better, needed = gain((problem, state), (without, moved), np.asarray(problem.points.present()), fitted=2)
    shift = float(np.percentile(search.sizes, USUAL_LARGEST)) * abs(seconds)
    return FoundReadout(Readout(seconds, columns, shift), without, moved, better, needed)


def _descend(search: _Search, state: State, slope: float, longest: float, solve: Solve) -> tuple[float, State]:
    """The readout at which the energy has no slope, or the longest there can be, and the map adjusted to it."""
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
        if abs(following - seconds) * search.usual < SETTLED:
            break
        seconds = float(following)
    else:
        state = solve(search.at(seconds), state)
    return float(seconds), state


def _zero(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Where a line through two slopes is zero; not finite of equal ones."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.divide(one[0] * other[1] - other[0] * one[1], other[1] - one[1]))
