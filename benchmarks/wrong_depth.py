"""Depth that is not what it seems: what it costs, and whether it is told.

    D=../shared/data
    .venv/bin/python benchmarks/wrong_depth.py $D/building-walk $D/corridor-office $D/redkitchen $D/icl-office

The first 40 frames of each clip with the faults that programs and people make: turned images, distances along the
ray in place of depth, the inverse, files paired by names sorted as text, a lower rate, a filter over time, each image
scaled to one range, answers of a network (another scale in each image, smooth errors), other resolutions and ranges,
a wall in place of the scene, an offset, a power. ATE after SE(3) and Sim(3), cm; the share of matches that agree with
the poses, in the median pair of keyframes 1, 2, 3 and 5 apart; by how much of the way from depth to distance the
depth is longer than the motion's (`share_of_distance` in `vggtgeo/slam/trust/depth_agreement.py`). Oracle: what was
done. No image tells of a factor on all depth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import cv2
import numpy as np
from degraded_clips import evidence, judged, print_table

from vggtgeo.datasets import Frame
from vggtgeo.datasets.views import SequenceView
from vggtgeo.simulation.degradations import Degradation, Recording, as_it_is, with_depths
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.contradicted import median_shares
from vggtgeo.slam.trust.depth_agreement import depth_ratios, share_of_distance
from vggtgeo.slam.trust.estimate import Estimate

COLUMNS = ("SE(3) cm", "Sim(3) cm", "agreeing matches", "distance", "verdict", "reasons")


def of_depth(change: Callable[[np.ndarray], np.ndarray]) -> Degradation:
    """Each depth image, float32 [H, W], metres, NaN = none, changed by itself."""
    return lambda recording, rng: with_depths(recording, lambda depth, row: change(depth))


def of_frames(
    change: Callable[[Sequence[Frame], tuple[float, ...], np.random.Generator], Sequence[np.ndarray]],
) -> Degradation:
    """The depth images of all frames, given those, fx, fy, cx, cy, and a generator."""

    def changed(recording: Recording, rng: np.random.Generator) -> Recording:
        depths = change(recording.frames, recording.camera.intrinsics, rng)
        return with_depths(recording, lambda depth, row: depths[row])

    return changed


def along_the_ray(frames: Sequence[Frame], camera: tuple[float, ...], _: np.random.Generator) -> list[np.ndarray]:
    """The distance from the camera's centre."""
    fx, fy, cx, cy = camera
    y, x = np.mgrid[: frames[0].depth.shape[0], : frames[0].depth.shape[1]]
    longer = np.sqrt(1 + ((x - cx) / fx) ** 2 + ((y - cy) / fy) ** 2)
    return [frame.depth * longer for frame in frames]


def taken_from(order: Callable[[int], Sequence[int]]) -> Degradation:
    """The depth of other frames. order: their numbers, given how many there are."""
    return of_frames(lambda frames, camera, rng: [frames[number].depth for number in order(len(frames))])


def smeared(frames: Sequence[Frame], camera: tuple[float, ...], _: np.random.Generator) -> list[np.ndarray]:
    """The mean over six frames, as depth cameras filter it."""
    known = [np.nan_to_num(frame.depth) for frame in frames]
    count = [np.isfinite(frame.depth) for frame in frames]
    rows = [slice(max(0, row - 5), row + 1) for row in range(len(frames))]
    with np.errstate(invalid="ignore"):
        return [np.sum(known[part], 0) / np.sum(count[part], 0) for part in rows]


def scaled_each(sigma: float) -> Degradation:
    """Another scale in each image."""
    return of_frames(lambda frames, camera, rng: [f.depth * np.exp(rng.normal(0, sigma)) for f in frames])


def smooth_errors(frames: Sequence[Frame], camera: tuple[float, ...], rng: np.random.Generator) -> list[np.ndarray]:
    """Errors of 10 % over a quarter of each image."""
    size = frames[0].depth.shape[::-1]
    field = lambda: cv2.resize(rng.normal(0, 0.1, (4, 5)).astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
    return [frame.depth * np.exp(field()) for frame in frames]


def wall(metres: float) -> Degradation:
    """The same depth everywhere and always, with 1 % of noise: a sensor before glass, a network that says one thing."""
    return of_frames(
        lambda frames, camera, rng: [metres * (1 + rng.normal(0, 0.01, frame.depth.shape)) for frame in frames]
    )


def from_an_eighth(depth: np.ndarray) -> np.ndarray:
    """Of an eighth of the resolution, jumps smoothed; none as zero, as an interpolation takes it."""
    small = cv2.resize(np.nan_to_num(depth), None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA)
    whole = cv2.resize(small, depth.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(whole > 0, whole, np.nan)


CHANGES: dict[str, Degradation] = {
    "base": as_it_is,
    "mirrored": of_depth(lambda depth: depth[:, ::-1]),
    "upside down": of_depth(lambda depth: depth[::-1]),
    "inverse": of_depth(lambda depth: 3.0 / np.maximum(depth, 0.1)),
    "along the ray": of_frames(along_the_ray),
    "sorted as text": taken_from(lambda count: [int(text) for text in sorted(map(str, range(count)))]),
    "later and later": taken_from(lambda count: [int(0.85 * number) for number in range(count)]),
    "mean of six": of_frames(smeared),
    "scaled to 5 m": of_depth(lambda depth: depth / np.nanmax(depth) * 5.0),
    "scale 3 %": scaled_each(0.03),
    "scale 10 %": scaled_each(0.1),
    "smooth 10 %": of_frames(smooth_errors),
    "from an eighth": of_depth(from_an_eighth),
    "up to 2 m": of_depth(lambda depth: np.where(depth < 2.0, depth, np.nan)),
    "a wall at 1 m": wall(1.0),
    "a wall at 2 m": wall(2.0),
    "middle of each": of_depth(lambda depth: np.where(np.isfinite(depth), np.nanmedian(depth), np.nan)),
    "30 cm more": of_depth(lambda depth: depth + 0.3),
    "power 1.15": of_depth(lambda depth: depth**1.15),
}


def distance(sequence: SequenceView, slam: Slam) -> str:
    """The share of distance in the depth, and its standard deviation; nothing where too few corners have parallax."""
    ratios = depth_ratios(Estimate.of(slam), evidence(sequence))
    return "{:.2f} +- {:.2f}".format(*share_of_distance(ratios)) if ratios.enough else ""


def cells(sequence: SequenceView) -> Iterator[str]:
    """What came of it."""
    result, metric = judged(sequence)
    truth = result.summary.get("truth")
    free = truth["ate_sim3_m"]["rmse"] if truth else float("nan")
    assert result.record is not None
    shares = median_shares(result.record.slam.keyframes, result.record.slam.intrinsics)
    yield from (f"{100 * metric:.1f}", f"{100 * free:.1f}", shares, distance(sequence, result.record.slam))
    yield from (result.verdict.level, "; ".join(result.verdict.reasons))


if __name__ == "__main__":
    print_table(__doc__, CHANGES, COLUMNS, cells, depth_alone=True)
