"""Lens distortion that no calibration tells: estimated once in the last adjustment, then removed from the map.

A guessed camera is a pinhole until a whole map is adjusted: that of the calibration frames (`self_calibration.py`), or
of the run. So is a given one without distortion coefficients, in a map without measured depth. If the lens distorts,
the focal length absorbs the distortion and is wrong. So the map is adjusted once more with two radial coefficients free
(`benchmarks/no_calibration.py`). If that explains the matches significantly better and moves pixels by more than
`MIN_WARP`, then images, key points and segments of the keyframes are undistorted, and all later steps use the ideal
pinhole.

Poses of tracked frames are relative to keyframes, so they follow.
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
from vggtgeo.geometry.camera_models import RadialTangential, with_shared_focal
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors
from vggtgeo.models.roles import PointMatches
from vggtgeo.slam.camera.camera_gain import gain
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.keyframe_images import KeyframeImages
from vggtgeo.slam.sparse_map.map import Map

RADIAL = 0.3
"""Prior standard deviation of k1 and k2; it covers lenses of phones and action cameras."""
MIN_WARP = 0.5
"""Largest displacement by the lens, pixels, for which it is removed: the noise of a match."""

Solve = Callable[[Problem, State], State]


@dataclass(frozen=True, eq=False)
class FoundLens:
    """The result of an adjustment with free lens distortion.

    camera: with its distortion. state: the adjusted map; its camera is the ideal pinhole. gain: mean decrease of a
    match's robust energy; needed: the decrease that is significant. warp: largest displacement of a pixel, pixels;
    infinite if the distortion folds the image, as no lens does.
    """

    camera: Camera
    state: State
    gain: float
    needed: float
    warp: float

    @property
    def pays(self) -> bool:
        """Whether the distortion is significant and large enough to remove."""
        return self.gain > self.needed and MIN_WARP < self.warp < float("inf")


def find_lens(problem: Problem, state: State, size: tuple[int, int], solve: Solve) -> FoundLens | None:
    """Estimate the lens of a map that was adjusted without distortion; return None if the result is invalid.

    problem, state: that adjustment, its camera a `Pinhole`. size: height and width of the images.
    solve: adjusts any problem.
    """
    with_lens, shared = _with_lens(problem), problem.shared_focal
    pinhole = len(problem.camera.names)
    none = jnp.zeros(len(with_lens.camera.names) - pinhole)
    start = eqx.tree_at(lambda s: s.intrinsics, state, jnp.concatenate([state.intrinsics, none]))
    found = solve(with_lens, start)
    parameters = [float(value) for value in found.intrinsics]
    fx, fy, cx, cy, *distortion = [parameters[0], *parameters] if shared else parameters
    if not (min(fx, fy) > 0 and np.isfinite(parameters).all()):
        return None
    height, width = size
    camera = Camera((fx, fy, cx, cy), width, height, tuple(distortion), known=False)
    # No matches are held out: two parameters do not overfit thousands of matches.
    present = np.asarray(problem.points.present())
    better, needed = gain((problem, state), (with_lens, found), present, fitted=pinhole + 2)
    ideal = eqx.tree_at(lambda s: s.intrinsics, found, found.intrinsics[:pinhole])
    return FoundLens(camera, ideal, better, needed, largest_shift(camera))


def _with_lens(problem: Problem) -> Problem:
    """Return the problem with a camera whose radial distortion is free."""
    prior = problem.intrinsics_prior
    kind = with_shared_focal(RadialTangential) if problem.shared_focal else RadialTangential
    names, more = kind.names, len(kind.names) - len(problem.camera.names)
    wider = IntrinsicsPrior(
        index=jnp.arange(len(names)),
        mean=jnp.concatenate([prior.mean, jnp.zeros(more)]),
        weight=jnp.concatenate([prior.weight, jnp.full(more, 1 / RADIAL**2)]),
    )
    held = jnp.asarray([name in ("p1", "p2") for name in names])
    return replace(problem.with_term(wider), camera=kind, fixed_intrinsics=held)


def largest_shift(camera: Camera) -> float:
    """Return the largest displacement of a pixel by the lens, pixels; infinite if the distortion folds the image before
    the middle of its farthest side. A fold in the corners only loses the corners.
    """
    fx, fy, cx, cy = camera.intrinsics
    k1, k2, *_ = camera.distortion
    sides = max(cx, camera.width - cx) / fx, max(cy, camera.height - cy) / fy
    side, corner = max(sides), np.hypot(*sides)
    # Undistorted radii up to 1.5 times a corner's: barrel distortion draws corners inwards.
    radius = np.linspace(0.0, 1.5 * corner, 300)
    drawn = radius * (1 + k1 * radius**2 + k2 * radius**4)
    folds = np.append(np.diff(drawn) <= 0, True)
    before = np.arange(len(radius)) <= np.argmax(folds)
    if drawn[before].max() < side:
        return float("inf")
    return float(fx * np.abs(drawn - radius)[before & (drawn <= corner)].max())


def can_undistort(keyframes: Iterable[Keyframe]) -> bool:
    """Return whether the descriptors stay valid when pixels move; opaque ones that contain the image do not."""
    return all(
        isinstance(keyframe.features.descriptors, PixelDescriptors | np.ndarray | None) for keyframe in keyframes
    )


def undistorted_map(known: Map, lens: Camera) -> Map:
    """Return the map with undistorted keyframes and matches; poses and depths stay."""
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
    """Return the undistorted pixels, in their own dtype."""
    return lens.undistorted(pixels).astype(pixels.dtype)
