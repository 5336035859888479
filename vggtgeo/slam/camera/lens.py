"""Lens distortion that no calibration tells: estimated once in the last adjustment, then removed from the map.

A guessed camera is a pinhole until a whole map is adjusted: that of the calibration frames (`self_calibration.py`), or
of the run. So is a given one without distortion coefficients, in a map without measured depth. If the lens distorts,
the focal length absorbs the distortion and is wrong. So two radial coefficients `k` are estimated
(`benchmarks/no_calibration.py`). If they explain the matches significantly better and move pixels by more than
`MIN_WARP`, then images, key points and segments of the keyframes are undistorted, and all later steps use the ideal
pinhole. The last adjustment of a self-calibrated run searches what its first guess of the lens left.

The estimate minimises the energy of the adjusted map, `E(k) = min_x e(x, k)`, where `e` is that of the pinhole for
undistorted pixels. Its gradient needs no other adjustment: it is the partial derivative of `e` at the adjusted map
(envelope theorem). Two adjustments with a small distortion give the second derivatives of `E` as differences of
gradients, which include how the map follows. Newton's method with bounded steps and updated second derivatives then
takes a few adjustments. All are of the same program as the map's other adjustments.

Noise is in the pixels as the lens draws them. Undistorting scales it, so the weight of a match is divided by the
determinant of the undistortion's derivative; otherwise a lens that shrinks the image would be favoured.

Poses of tracked frames are relative to keyframes, so they follow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera, Undistorter
from vggtgeo.geometry.robust import TINY
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors
from vggtgeo.models.roles import PointMatches
from vggtgeo.slam.camera.camera_comparison import Shifts, carried, gain, match_energies, pinhole_of, shifted_problem
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.keyframe import Keyframe, KeyframeImages
from vggtgeo.slam.sparse_map.map import Map

RADIAL = 0.3
"""Prior standard deviation of k1 and k2; it covers lenses of phones and action cameras."""
MIN_WARP = 0.5
"""Largest displacement by the lens, pixels, for which it is removed: the noise of a match."""
FIRST_WARP, PROBE = 1.0, 0.02
"""Displacements of a corner by a coefficient, pixels: of the adjustments for second derivatives, larger than what one
leaves unconverged; of the finite differences for first ones, small against the noise of a match."""
MAX_STEP = 10.0
"""Displacement of a corner by a step, pixels."""
PROMISE = 0.05
"""Decrease of the energy that a step must promise: a tenth of what a standard deviation of a coefficient costs."""
MAX_STEPS = 8
"""Iteration limit of Newton's method; first steps may be cut at the largest distortion."""
DIRECTIONS = np.array([[1.0, 0.0], [-1.2, 1.0]])
"""Two distortions, as displacements of a corner by either coefficient, of which none looks like the other, or like a
focal length: Zernike's radial polynomials `3 r^3 - 2 r` and `10 r^5 - 12 r^3 + 3 r`."""

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
    def is_significant(self) -> bool:
        """Whether the distortion is significant and large enough to remove."""
        return self.gain > self.needed and MIN_WARP < self.warp < float("inf")


def find_lens(problem: Problem, state: State, size: tuple[int, int], solve: Solve) -> FoundLens | None:
    """Estimate the lens of a map that was adjusted without distortion; return None if the result is invalid.

    problem, state: that adjustment, its camera a `Pinhole`. size: height and width of the images.
    solve: adjusts any problem of the same shape.
    """
    bent = _Undistorted.of(problem, state, size)
    warp, found, gradient = np.zeros(2), state, bent.gradient(np.zeros(2), state)
    first = DIRECTIONS * FIRST_WARP
    probes = [solve(bent.at(warp), state) for warp in first]
    if not all(_is_camera(pinhole_of(problem, probe)) for probe in probes):
        return None
    changes = [bent.gradient(warp, probe) - gradient for warp, probe in zip(first, probes, strict=True)]
    hessian = np.linalg.solve(first, np.array(changes))
    hessian, largest = (hessian + hessian.T) / 2, MAX_STEP
    if not np.isfinite(hessian).all():
        return None
    # Not `gauss_newton`: the energy of an adjusted map is no sum of squares in two unknowns. Each evaluation is an
    # adjustment, so second derivatives are updated instead.
    for _ in range(MAX_STEPS):
        step = _step(hessian, gradient, largest)
        if -gradient @ step / 2 < PROMISE:
            break
        moved = solve(bent.at(warp + step), found)
        if not _is_camera(pinhole_of(problem, moved)):
            return None
        change = bent.gradient(warp + step, moved) - gradient
        hessian = _updated(hessian, step, change)
        if bent.energy(warp + step, moved) > bent.energy(warp, found):
            largest = np.abs(step).max() / 4
        else:
            warp, found, gradient = warp + step, moved, gradient + change
            bent = replace(bent, pinhole=pinhole_of(problem, found))
    camera = bent.camera(warp)
    # No matches are held out: two parameters do not overfit thousands of matches.
    present = np.asarray(problem.terms["points"].present())
    better, needed = gain((problem, state), (bent.at(warp), found), present, fitted=len(problem.camera.names) + 2)
    return FoundLens(camera, found, better, needed, largest_shift(camera))


def _is_camera(pinhole: np.ndarray) -> bool:
    return bool(np.isfinite(pinhole).all() and pinhole[:2].min() > 0)


def _step(hessian: np.ndarray, gradient: np.ndarray, largest: float) -> np.ndarray:
    """Return the step of Newton's method, downhill also where the energy curves down, not longer than `largest`."""
    curvature, directions = np.linalg.eigh(hessian)
    bounded = np.maximum(np.abs(curvature), TINY)
    step: np.ndarray = -directions @ ((directions.T @ gradient) / bounded)
    return step * min(1.0, largest / np.abs(step).max(initial=TINY))


def _updated(hessian: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the Hessian after the symmetric rank-one update by a change of the gradient."""
    left = change - hessian @ step
    along = float(left @ step)
    if abs(along) < 1e-3 * np.linalg.norm(left) * np.linalg.norm(step):
        return hessian
    return np.asarray(hessian + np.outer(left, left) / along)


@dataclass(frozen=True, eq=False)
class _Undistorted:
    """A problem whose pixels are undistorted; `warp` has the displacements of a corner by k1 and k2, pixels.

    pinhole: fx, fy, cx, cy, float64 [4]. size: height and width. lines: where the map projects its line samples,
    pixels of the ideal camera [e, l, 2].
    """

    problem: Problem
    pinhole: np.ndarray
    size: tuple[int, int]
    lines: np.ndarray

    @classmethod
    def of(cls, problem: Problem, state: State, size: tuple[int, int]) -> _Undistorted:
        camera, count = pinhole_of(problem, state), problem.terms["points"].weight.shape[1]
        poses = rigid.to_matrix(np.asarray(state.poses.wxyz_xyz, np.float64))
        host, target = np.asarray(problem.edges.source), np.asarray(problem.edges.target)
        pixels, inverse = (
            np.asarray(values, np.float64)[:, count:] for values in (problem.pixels, state.inverse_depth)
        )
        lines, _ = carried(pixels[host], inverse[host], poses[target] @ rigid.invert(poses[host]), camera)
        inside = np.all((lines > 0) & (lines < size[::-1]), -1, keepdims=True)
        return cls(problem, camera, size, np.where(inside, lines, camera[2:]))

    def coefficients(self, warp: np.ndarray) -> np.ndarray:
        """Return k1 and k2, float64 [2], of displacements of a corner; these stay if the focal length changes."""
        focal = float(np.sqrt(np.prod(self.pinhole[:2])))
        corner = np.hypot(*self.size) / 2 / focal
        return np.asarray(warp / (focal * corner ** np.array([3.0, 5.0])))

    def camera(self, warp: np.ndarray) -> Camera:
        """Return the camera with these displacements of a corner."""
        height, width = self.size
        distortion = (*self.coefficients(warp).tolist(), 0.0, 0.0)
        return Camera(tuple(self.pinhole.tolist()), width, height, distortion, known=False)

    def at(self, warp: np.ndarray) -> Problem:
        """Return the problem for undistorted pixels, each match with the weight of its noise in the distorted image."""
        camera, present = self.camera(warp), np.asarray(self.problem.terms["points"].present())
        slots = np.asarray(self.problem.pixels, np.float64)
        matched = np.asarray(self.problem.terms["points"].target, np.float64)[present]
        ideal, points = camera.undistorted(matched), np.zeros((*present.shape, 2))
        points[present] = matched - ideal
        lines = (self._scales(warp, self.lines)[0] - 1)[..., None] * (self.lines - self.pinhole[2:])
        shifts = Shifts(slots - camera.undistorted(slots), points, lines)
        weight = np.array(self.problem.terms["points"].weight)
        weight[present] *= np.maximum(np.prod(self._scales(warp, ideal), axis=0), 0.0)
        weighted = self.problem.with_term(self.problem.terms["points"].reweighted(jnp.asarray(weight)))
        return shifted_problem(weighted, shifts, 1.0, max(self.size) / 2)

    def _scales(self, warp: np.ndarray, ideal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tangential and the radial scale of the distortion at pixels [..., 2] of the ideal camera."""
        k1, k2 = self.coefficients(warp)
        square = np.sum(((ideal - self.pinhole[2:]) / self.pinhole[:2]) ** 2, -1)
        return 1 + k1 * square + k2 * square**2, 1 + 3 * k1 * square + 5 * k2 * square**2

    def energy(self, warp: np.ndarray, state: State) -> float:
        """Return the energy of the matches and of the prior of the coefficients."""
        matches = np.sum(match_energies(self.at(warp), state), where=np.asarray(self.problem.terms["points"].present()))
        return float(matches + np.sum(self.coefficients(warp) ** 2) / (2 * RADIAL**2))

    def gradient(self, warp: np.ndarray, state: State) -> np.ndarray:
        """Return the derivative of the energy at an adjusted map, float64 [2]."""
        steps = PROBE * np.eye(2)
        changes = [self.energy(warp + step, state) - self.energy(warp - step, state) for step in steps]
        return np.array(changes) / (2 * PROBE)


def largest_shift(camera: Camera) -> float:
    """Return the largest displacement of a pixel by the lens, pixels; infinite if the distortion folds the image before
    the middle of its farthest side. A fold in the corners only loses the corners.
    """
    fx, fy, cx, cy = camera.intrinsics
    k1, k2, *_ = camera.distortion
    sides = max(cx, camera.width - cx) / fx, max(cy, camera.height - cy) / fy
    side, corner = max(sides), np.hypot(*sides)
    # Undistorted radii up to 1.5 times a corner's: barrel distortion draws corners inwards.
    # 300 are a pixel or two apart.
    radius = np.linspace(0.0, 1.5 * corner, 300)
    drawn = radius * (1 + k1 * radius**2 + k2 * radius**4)
    folds = np.append(np.diff(drawn) <= 0, True)
    before = np.arange(len(radius)) <= np.argmax(folds)
    if drawn[before].max() < side:
        return float("inf")
    return float(fx * np.abs(drawn - radius)[before & (drawn <= corner)].max())


def composed(first: Camera, second: Camera) -> Camera:
    """Return the camera of both lenses in a row: `second` is that of images that were undistorted by `first`.

    Its distortion (k1, k2, p1, p2) is the least-squares fit to both at a grid of 400 pixels; p1 and p2 are of the
    principal point, which the second may have elsewhere.
    """
    across, down = np.meshgrid(*(np.linspace(0, side - 1, 20) for side in (second.width, second.height)))
    ideal = np.column_stack([across.ravel(), down.ravel()])
    fx, fy, cx, cy = second.intrinsics
    rays, drawn = ((pixels - [cx, cy]) / [fx, fy] for pixels in (ideal, first.distorted(second.distorted(ideal))))
    x, y = rays.T
    square = x**2 + y**2
    along_x = np.column_stack([x * square, x * square**2, 2 * x * y, square + 2 * x**2])
    along_y = np.column_stack([y * square, y * square**2, square + 2 * y**2, 2 * x * y])
    distortion, *_ = np.linalg.lstsq(np.vstack([along_x, along_y]), (drawn - rays).T.ravel(), rcond=None)
    return replace(second, distortion=tuple(distortion.tolist()))


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
