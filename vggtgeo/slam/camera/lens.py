"""The lens of a camera that nobody calibrated: found once in the last adjustment, and taken out of the map.

A guessed camera is a pinhole until the whole map is adjusted: that of the calibration frames (`self_calibration.py`),
or of the run.
Where its lens distorts, the focal length takes that up, and comes out wrong: redkitchen, images alone, ends at 539 and
550 px (COLMAP: 522 and 520, with k1 -0.007 and k2 -0.043). So the map is adjusted once more with the two radial
coefficients of the lens free (520 px, -0.006, -0.047).
Where that explains the matches better by more than chance, and moves pixels by more than `MIN_WARP`, images, key
points and segments of the keyframes are resampled to those of the ideal pinhole, and everything after sees only that.

What every tracked frame was placed by hangs on keyframes, and moves with them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.intrinsics import IntrinsicsPrior
from vggtgeo.geometry.camera import Camera, Undistorter
from vggtgeo.geometry.camera_models import RadialTangential, SquarePinhole, SquareRadialTangential
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors
from vggtgeo.models.roles import PointMatches
from vggtgeo.slam.camera.camera_gain import gain
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.keyframe_images import KeyframeImages
from vggtgeo.slam.sparse_map.map import Map

RADIAL = 0.3
"""Standard deviation of k1 and k2 before anything is seen: lenses of phones and action cameras are within."""
MIN_WARP = 1.0
"""Pixels, the most that the lens moves any pixel: below, images would lose more by being resampled."""

Solve = Callable[[Problem, State], State]


@dataclass(frozen=True, eq=False)
class FoundLens:
    """A lens as the whole map sees it.

    camera: with its distortion. state: the map that was adjusted with it; its camera is the ideal pinhole. gain: how
    much the mean robust energy of a match falls by it, and needed: how much it has to fall to be no chance. warp: the
    most that it moves a pixel, pixels; infinite where it folds the image, as no lens does.
    """

    camera: Camera
    state: State
    gain: float
    needed: float
    warp: float

    @property
    def pays(self) -> bool:
        """Whether it is there, and worth to be taken out."""
        return self.gain > self.needed and MIN_WARP < self.warp < float("inf")


def find_lens(problem: Problem, state: State, size: tuple[int, int], solve: Solve) -> FoundLens | None:
    """The lens, from a map that was adjusted without distortion; None where what comes out is no camera.

    problem, state: that adjustment, its camera a `SquarePinhole` or a `Pinhole`. size: height and width of the images.
    solve: adjusts any problem.
    """
    with_lens, square = _with_lens(problem), problem.camera is SquarePinhole
    pinhole = len(problem.camera.names)
    none = jnp.zeros(len(with_lens.camera.names) - pinhole)
    start = eqx.tree_at(lambda s: s.intrinsics, state, jnp.concatenate([state.intrinsics, none]))
    found = solve(with_lens, start)
    parameters = [float(value) for value in found.intrinsics]
    fx, fy, cx, cy, *distortion = [parameters[0], *parameters] if square else parameters
    if not (min(fx, fy) > 0 and np.isfinite(parameters).all()):
        return None
    height, width = size
    camera = Camera((fx, fy, cx, cy), width, height, tuple(distortion), known=False)
    # Both cameras have seen all matches: two numbers for thousands of them are no reason to set some aside.
    present = np.asarray(problem.points.present())
    better, needed = gain((problem, state), (with_lens, found), present, fitted=pinhole + 2)
    ideal = eqx.tree_at(lambda s: s.intrinsics, found, found.intrinsics[:pinhole])
    return FoundLens(camera, ideal, better, needed, largest_shift(camera))


def _with_lens(problem: Problem) -> Problem:
    """The same problem with a camera whose radial distortion is free."""
    prior = problem.intrinsics_prior
    kind = SquareRadialTangential if problem.camera is SquarePinhole else RadialTangential
    names, more = kind.names, len(kind.names) - len(problem.camera.names)
    wider = IntrinsicsPrior(
        index=jnp.arange(len(names)),
        mean=jnp.concatenate([prior.mean, jnp.zeros(more)]),
        weight=jnp.concatenate([prior.weight, jnp.full(more, 1 / RADIAL**2)]),
    )
    held = jnp.asarray([name in ("p1", "p2") for name in names])
    return replace(problem.with_term(wider), camera=kind, fixed_intrinsics=held)


def largest_shift(camera: Camera) -> float:
    """The most that the lens moves a pixel of its images, pixels; infinite where it folds them before the middle of
    their farthest side. A fold in the corners costs no more than those: k1 = -0.25 does that to redkitchen.
    """
    fx, fy, cx, cy = camera.intrinsics
    k1, k2, *_ = camera.distortion
    sides = max(cx, camera.width - cx) / fx, max(cy, camera.height - cy) / fy
    side, corner = max(sides), np.hypot(*sides)
    # Ideal radii up to a corner's, and half as far again: a barrel's corner is farther out than it looks.
    radius = np.linspace(0.0, 1.5 * corner, 300)
    drawn = radius * (1 + k1 * radius**2 + k2 * radius**4)
    folds = np.append(np.diff(drawn) <= 0, True)
    before = np.arange(len(radius)) <= np.argmax(folds)
    if drawn[before].max() < side:
        return float("inf")
    return float(fx * np.abs(drawn - radius)[before & (drawn <= corner)].max())


def can_undistort(keyframes: Iterable[Keyframe]) -> bool:
    """Whether descriptors stay true when pixels move; those that hold their image in a form of their own do not."""
    return all(
        isinstance(keyframe.features.descriptors, PixelDescriptors | np.ndarray | None) for keyframe in keyframes
    )


def undistorted_map(known: Map, lens: Camera) -> Map:
    """The map as the ideal pinhole of `lens` sees it; its poses and depths stay."""
    undistorter = lens.undistorter()
    keyframes = tuple(_keyframe(keyframe, lens, undistorter) for keyframe in known.keyframes)
    return replace(known, keyframes=keyframes, pairs=tuple(_pair(pair, lens) for pair in known.pairs))


def _keyframe(keyframe: Keyframe, lens: Camera, undistorter: Undistorter) -> Keyframe:
    features, segments = keyframe.features, keyframe.lines.segments
    descriptors = features.descriptors
    if isinstance(descriptors, PixelDescriptors):
        descriptors = replace(descriptors, gray=undistorter.image(descriptors.gray))
    moved = replace(
        keyframe,
        images=_images(keyframe, undistorter),
        features=replace(features, pixels=undistorted_pixels(features.pixels, lens), descriptors=descriptors),
        lines=replace(
            keyframe.lines, segments=replace(segments, endpoints=undistorted_pixels(segments.endpoints, lens))
        ),
        points=replace(keyframe.points, pixels=undistorted_pixels(keyframe.points.pixels, lens)),
        samples=replace(keyframe.samples, pixels=undistorted_pixels(keyframe.samples.pixels, lens)),
    )
    return moved.compressed() if keyframe.images.small else moved


def _images(keyframe: Keyframe, undistorter: Undistorter) -> KeyframeImages:
    nearest = lambda image: undistorter.depth(image.astype(np.float32))
    trust = np.nan_to_num(nearest(keyframe.depth_confidence)).astype(np.uint8)
    depth, sigma = (nearest(image).astype(np.float16) for image in (keyframe.depth, keyframe.depth_sigma))
    return KeyframeImages(undistorter.image(keyframe.image), depth, sigma, trust)


def _pair(pair: Pair, lens: Camera) -> Pair:
    points = pair.points
    moved: PointMatches = replace(
        points, pixels_i=undistorted_pixels(points.pixels_i, lens), pixels_j=undistorted_pixels(points.pixels_j, lens)
    )
    return replace(pair, points=moved)


def undistorted_pixels(pixels: Float[np.ndarray, "*m 2"], lens: Camera) -> Float[np.ndarray, "*m 2"]:
    """The undistorted pixels, of the type that they had."""
    return lens.undistorted(pixels).astype(pixels.dtype)
