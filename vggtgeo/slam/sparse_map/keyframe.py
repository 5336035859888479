"""A keyframe: an image with its measurements and estimates.

Its images are compressed in memory after it has left the window. At 640 x 480 the colour image and the three images of
depth take 2.4 MB, compressed 0.3 MB: colours as JPEG of quality 95 59 to 75 kB (1 ms to read; the loss is below the
noise of a camera, and colours of an old keyframe are used for coarse alignment and the map only), depth and its
deviation as PNG, without loss, 70 to 177 kB each.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import cv2
import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import pinhole
from vggtgeo.models.classical import global_descriptor, sample_segments, segment_depths
from vggtgeo.models.roles import DepthEstimate, Features, LineFeatures, Segments
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings, check_answer, check_size

LINE_SPACING = 10.0
"""Pixels between the samples of a segment: closer ones would observe the same part of an edge again."""
MIN_INVERSE_DEPTH = 1e-3
"""Smallest initial inverse depth, 1/m."""
PIXEL_SIGMA = 2.0
"""Standard deviation of a match, pixels: 0.5 px of the key point, the rest from the keyframe's depth at that one pixel.
"""
MAX_DEPTH_ERROR = 0.2
"""Largest relative standard deviation of a depth that is used as a depth: five from infinity, so that it is surely
finite."""
LINE_SIGMA, LINE_CONFIDENCE = 0.02, 0.3
"""Smallest relative standard deviation and confidence of a depth on a fitted line: its samples share the errors of the
fit, and at a depth edge, where single pixels are not trusted, a line of many still is."""
JPEG = (".jpg", ())
"""OpenCV's own quality, 95: its loss is below the noise of a camera."""
PNG = (".png", (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP))
"""One filter for all rows: choosing it row by row takes a third of the time and makes these files no smaller."""


@dataclass(frozen=True, eq=False)
class CompressedImage:
    """An encoded image. shape, dtype: those of the array."""

    data: bytes
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @classmethod
    def of(cls, image: np.ndarray) -> Self:
        """Encode uint8 [H, W, 3] as JPEG, else uint8 or float16 [H, W] as PNG, bit by bit."""
        kind, options = JPEG if image.ndim == 3 else PNG
        bits = image.view(np.uint16) if image.dtype == np.float16 else image
        _, data = cv2.imencode(kind, np.ascontiguousarray(bits), options)
        return cls(data.tobytes(), image.shape, image.dtype)

    def array(self) -> np.ndarray:
        """Return the decoded image."""
        # Colours are as they were given: encoded and decoded without a change of their order.
        image = cv2.imdecode(np.frombuffer(self.data, np.uint8), cv2.IMREAD_UNCHANGED)
        return image.view(self.dtype).reshape(self.shape)


@dataclass(frozen=True, eq=False)
class KeyframeImages:
    """Images of a keyframe.

    colour: uint8 [H, W, 3] RGB. depth: float16 [H, W] metres, NaN = unknown (its rounding, 0.5 mm at 1 m, is below the
    noise of any sensor). depth_sigma: float16 [H, W], its relative standard deviation as stated by the role.
    depth_confidence: uint8 [H, W], 255 is 1.
    """

    colour: np.ndarray | CompressedImage
    depth: np.ndarray | CompressedImage
    depth_sigma: np.ndarray | CompressedImage
    depth_confidence: np.ndarray | CompressedImage

    @property
    def small(self) -> bool:
        """Whether they are compressed."""
        return isinstance(self.colour, CompressedImage)

    @cached_property
    def has_depth(self) -> bool:
        """Whether any pixel has a depth; decoded once for that."""
        return bool(np.isfinite(array_of(self.depth)).any())

    def compressed(self) -> KeyframeImages:
        """Return the images compressed; each access decodes one."""
        return KeyframeImages(*(CompressedImage.of(array_of(image)) for image in self._every()))

    def expanded(self) -> KeyframeImages:
        """Return the images as arrays."""
        return KeyframeImages(*(array_of(image) for image in self._every()))

    def _every(self) -> tuple[np.ndarray | CompressedImage, ...]:
        return self.colour, self.depth, self.depth_sigma, self.depth_confidence


def array_of(image: np.ndarray | CompressedImage) -> np.ndarray:
    """Return the image as an array."""
    return image if isinstance(image, np.ndarray) else image.array()


@dataclass(frozen=True, eq=False)
class Slots:
    """Pixels of one keyframe with an inverse depth: key points, or samples of its segments.

    pixels: float [m, 2]. inverse_depth: float [m], 1/m, NaN = unknown. prior_mean, prior_sigma: float [m], metric
    inverse depth and its standard deviation, 1/m, NaN = unknown; a triangulated segment has no mean, but the standard
    deviation of its triangulation. prior_confidence: float [m] in [0, 1]. confidence: float [m] in [0, 1], reliability
    of the image there. estimate_sigma: float [m], 1/m, standard deviation of `inverse_depth` from views of other
    keyframes, NaN elsewhere. For a distant point it is as large as its inverse depth; such a point still constrains the
    rotation of a frame, see `determined`.
    """

    pixels: np.ndarray
    inverse_depth: np.ndarray
    prior_mean: np.ndarray
    prior_sigma: np.ndarray
    prior_confidence: np.ndarray
    confidence: np.ndarray
    estimate_sigma: np.ndarray

    @property
    def determined(self) -> np.ndarray:
        """Whether the depth itself is known, bool [m]: its relative standard deviation is at most `MAX_DEPTH_ERROR`."""
        return np.isfinite(self.inverse_depth) & ~(self.estimate_sigma > MAX_DEPTH_ERROR * self.inverse_depth)

    def known_for(self, length: float, focal: float, pixels: float) -> np.ndarray:
        """Return whether the depth predicts the projection within `pixels` after a motion of `length`, bool [m].

        Determined depths always count.
        """
        return self.determined | (self.estimate_sigma * length * focal < pixels)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A keyframe.

    Fields: number, counted from 0 in the run; frame; timestamp, s; pose float64 [4, 4], world -> camera; its images;
    the results of the perception roles; the slots of its points and line samples (`sample_segment` int [m]: segment of
    each sample); global_descriptor: float32 [n] of unit length, None = unknown; recorded: of a keyframe of a known map
    its time stamp in the run that made it, s, by the clock of that run.

    All keyframes stay in memory during the run, so images are compressed: see `KeyframeImages`.

    """

    number: int
    frame: int
    timestamp: float
    pose: np.ndarray
    images: KeyframeImages
    features: Features
    lines: LineFeatures
    line_depths: np.ndarray
    points: Slots
    samples: Slots
    sample_segment: np.ndarray
    global_descriptor: np.ndarray | None = None
    recorded: float | None = None

    @property
    def image(self) -> np.ndarray:
        """uint8 [H, W, 3] RGB."""
        return array_of(self.images.colour)

    @property
    def depth(self) -> np.ndarray:
        """float16 [H, W], metres, NaN = none."""
        return array_of(self.images.depth)

    @property
    def depth_sigma(self) -> np.ndarray:
        """float16 [H, W], relative standard deviation of the depth."""
        return array_of(self.images.depth_sigma)

    @property
    def depth_confidence(self) -> np.ndarray:
        """uint8 [H, W], 255 is 1."""
        return array_of(self.images.depth_confidence)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the image, pixels."""
        height, width = self.images.colour.shape[:2]
        return height, width

    def compressed(self) -> Keyframe:
        """Return the keyframe with compressed images."""
        return self if self.images.small else replace(self, images=self.images.compressed())

    def expanded(self) -> Keyframe:
        """Return the keyframe with images as arrays, for repeated access."""
        return replace(self, images=self.images.expanded()) if self.images.small else self


def make_keyframe(
    number: int,
    frame: Frame,
    pose: np.ndarray,
    description: Description,
    roles: Roles,
    settings: SlamSettings,
    intrinsics: np.ndarray,
    lines: LineFeatures | None = None,
) -> Keyframe:
    """Run the roles that only keyframes need, and read depth and confidence at key points and line samples.

    lines: the frame's segments, where tracking has found them already.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="describe") as pool:
        described = pool.submit(lambda: description.features)  # beside the rest: it takes as long as all of that
        depth = roles.depth.estimate(frame.image, frame.depth, tuple(intrinsics))
        check_answer("depth.estimate", depth, DepthEstimate)
        confidence = roles.confidence.confidence(frame.image)
        for method, found in (("depth.estimate", depth.depth), ("confidence.confidence", confidence)):
            check_size(method, found, frame.image)
        lines = find_lines(frame.image, roles, settings) if lines is None else lines
        features = described.result()
    ends = lines.segments.endpoints
    line_depths = segment_depths(ends, depth.depth) if len(ends) else np.zeros((0, 2))
    segment, pixels, fraction = sample_segments(ends, LINE_SPACING)
    samples = _slots_at(pixels, depth, confidence)
    return Keyframe(
        number=number,
        frame=frame.index,
        timestamp=frame.timestamp,
        pose=pose,
        images=KeyframeImages(
            frame.image,
            depth.depth.astype(np.float16),
            depth.sigma_rel.astype(np.float16),
            np.rint(255 * depth.confidence).astype(np.uint8),
        ),
        features=features,
        lines=lines,
        line_depths=line_depths,
        points=_slots_at(features.pixels, depth, confidence),
        samples=_with_line_depth(samples, along_segments(1.0 / line_depths, segment, fraction)),
        sample_segment=segment,
        global_descriptor=global_descriptor(features),
    )


def find_lines(image: np.ndarray, roles: Roles, settings: SlamSettings) -> LineFeatures:
    """Return the described segments of an image; none if the settings disable lines."""
    if not settings.line.use_lines:
        return roles.line_matches.describe(image, Segments(np.zeros((0, 2, 2)), np.zeros(0)))
    found = roles.lines.detect(image)
    check_answer("lines.detect", found, Segments)
    if roles.static_overlay is not None:
        found = roles.static_overlay.without_segments(found)
    return roles.line_matches.describe(image, found)


def _slots_at(pixels: np.ndarray, depth: DepthEstimate, confidence: np.ndarray) -> Slots:
    measured = depth.depth, depth.sigma_rel, depth.confidence
    z, sigma_rel, trust = (pinhole.at_pixels(image, pixels).astype(np.float64) for image in measured)
    inverse, seen = 1.0 / z, pinhole.at_pixels(confidence, pixels).astype(np.float64)
    nothing = np.full(len(pixels), np.nan)
    return Slots(pixels, inverse, inverse, sigma_rel * inverse, np.nan_to_num(trust), seen, nothing)


def along_segments(inverse: np.ndarray, segment: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Return the inverse depth of each sample from those of its segment's ends [l, 2].

    Inverse depth is affine in the pixel along the image of a straight line.
    """
    ends = inverse[segment]
    return ends[:, 0] + fraction * (ends[:, 1] - ends[:, 0])


def _with_line_depth(samples: Slots, on_line: np.ndarray) -> Slots:
    """Return the samples with depths of the line fit: at a depth edge a single pixel may be on either surface."""
    known = np.isfinite(on_line)
    inverse = np.where(known, on_line, np.nan)
    return replace(
        samples,
        inverse_depth=inverse,
        prior_mean=inverse,
        prior_sigma=np.where(known, np.fmax(np.nan_to_num(samples.prior_sigma), LINE_SIGMA * on_line), np.nan),
        prior_confidence=np.where(known, np.maximum(samples.prior_confidence, LINE_CONFIDENCE), 0.0),
    )
