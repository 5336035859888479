"""The sensor's depth against the depth that the motion gives: a wrong unit, a frozen image, a delay, another camera's.

For corners seen `GAPS` frames apart (as many times that as the camera is slow, `pace.py`), with enough parallax
(standard deviation of the triangulated inverse depth below 5 %), `x = log(z_sensor / z_triangulated)`. For all corners,
`y = log(z carried by the poses / z_sensor there)`.

Measured on corridor-office and building-walk with their own depth: the median of |x| within a run is 0.03, the share of
|x| > 0.15 is 0.05 to 0.10 (corners on depth edges), the medians of single frames spread by 0.01 to 0.03, and the share
of |y| > 0.15 is 0.00 to 0.02.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence, common
from vggtgeo.slam.trust.finding import Finding, spans

GAPS = (1, 3, 6)
PART = 40
"""Frames (as many times that as the camera is slow): what the bars below were measured on. One begins in each quarter
of one."""
MUCH = 0.15
SURE, FAR_OFF = 20.0, 3.0
"""Inverse relative standard deviation of a triangulated corner that counts; a factor on the depth that parallax by the
sensor's own depth leaves room for."""
LEAST_SHARE = 0.2
"""Of the corners of a pair that have parallax, if the pair is to say anything: where the camera hardly moved, those
that slipped are all that have some. With 60 degrees a second and hardly a step (TUM freiburg1/rpy) 2 % of the pairs had
any such corner; without this rule the sensor's depth seemed 11 % off there, with it 3 %."""
LEAST_COMMON = 10
"""Corners whose depth both frames know, if they are to be compared: where a sensor sees nearly nothing, those few lie
at the border of what it sees. Clips have 20 to 70; icl-office cut off at 2 m has 3, two thirds of them off, and is
right."""
LEAST = 30
"""Corners in a run below which nothing is said: of those with parallax different ones, since one that is seen for long
counts once. Sixteen in 40 noisy frames of icl-office, slow ones, were off in 31 % of what was compared."""
MOST_OFF = 0.25
"""Share of triangulated corners that may be off. Where the sensor's depths agree with each other (`y`), two standard
errors more: a corner is seen in many frames, and 40 frames have some hundred, so that 26 % were off in stretches of
redkitchen and building-walk whose depth is good, 5 % of that by chance; 38 to 69 % are where depth is frozen or that of
something that passes. In 40 frames of building-walk whose depth is three frames late it is 27 %, and 13 % of `y`."""
HEALTHY_OFF = 0.15
MOST_SURFACES_OFF = 0.15
"""Share of |y| > 0.15 that is too much. It is 0.00 to 0.02 on the HoloLens clips and 0.09 on icl-office, whose corners
lie on the edges of furniture; with 3 % of noise in the depth 0.18 and 0.33, with a frozen depth image 0.16."""
HEALTHY_SURFACES_OFF = 0.04
MOST_SCALE = 0.08
"""Largest median of `x`. The poses of a metric run come from the same depth, so that a sane run has 0.00 to 0.02."""
MOST_SPREAD = 0.10
"""Largest spread of the medians of single frames."""
DISTANCE, DISTANCE_SIGMAS = 0.5, 3.0
"""Of `x` over the logarithm of a corner's distance from the camera's centre over its depth along the axis: 0 for depth,
1 for distances; what is nearer to 1, and not by chance. Six pieces of 40 to 120 frames of three clips have -0.30
(redkitchen, whose lens bends) to 0.08, and 0.64 or more with distances in place of depth, which cost 2.5 cm and a tenth
of the scale; each known to 0.07 to 0.15. Two of them: `benchmarks/wrong_depth.py --changes base "along the ray"`."""
ROBUST, ITERATIONS, SMALLEST = 1.5, 20, 1e-12
"""Standard deviations: Huber's width over corners."""


@dataclass(frozen=True, eq=False)
class DepthRatios:
    """Log ratios with the row of the frame they belong to: triangulated float64 [m], with the numbers of their tracks
    int [m] and the logarithm of their distance over their depth float64 [m]; carried float64 [k]. slow: how many times
    as far apart as `GAPS` the frames are.
    """

    rows: np.ndarray
    tracks: np.ndarray
    triangulated: np.ndarray
    oblique: np.ndarray
    carried_rows: np.ndarray
    carried: np.ndarray
    slow: int = 1

    def between(self, first: int, last: int) -> DepthRatios:
        """Those of rows `first` to `last`."""
        own, carried = (np.flatnonzero((rows >= first) & (rows <= last)) for rows in (self.rows, self.carried_rows))
        return replace(
            self,
            rows=self.rows[own],
            tracks=self.tracks[own],
            triangulated=self.triangulated[own],
            oblique=self.oblique[own],
            carried_rows=self.carried_rows[carried],
            carried=self.carried[carried],
        )

    @property
    def enough(self) -> bool:
        """Whether there are corners enough to say anything of depth and motion."""
        return len(np.unique(self.tracks)) >= LEAST

    def frame_medians(self, least: int = 5) -> np.ndarray:
        """Median of the triangulated ratios of each frame that has at least `least`."""
        groups = [self.triangulated[self.rows == row] for row in np.unique(self.rows)]
        return np.array([np.median(group) for group in groups if len(group) >= least])


def depth_ratios(estimate: Estimate, evidence: Evidence, slow: int = 1) -> DepthRatios:
    """All corners of tracked frames, `GAPS` times `slow` apart."""
    rows, tracks, seen, oblique = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0)], [np.zeros(0)]
    carried_rows, carried = [np.zeros(0, int)], [np.zeros(0)]
    for gap in (slow * frames for frames in GAPS):
        for row in range(len(evidence) - gap):
            if not (estimate.tracked[row] and estimate.tracked[row + gap]):
                continue
            relative = estimate.poses[row + gap] @ rigid.invert(estimate.poses[row])
            x, own, aside, y = _pair(evidence, row, row + gap, relative, estimate.intrinsics)
            seen.append(x)
            oblique.append(aside)
            tracks.append(own)
            rows.append(np.full(len(x), row))
            carried.append(y)
            carried_rows.append(np.full(len(y), row))
    join = np.concatenate
    return DepthRatios(join(rows), join(tracks), join(seen), join(oblique), join(carried_rows), join(carried), slow)


def agree(ratios: DepthRatios, first: int, last: int) -> bool:
    """Whether depth and motion agree as well as on undisturbed clips, from enough corners to say so.

    It is asked in the `PART` around these rows, and in all of the run where too little is seen there. Depth that froze
    for 25 of 125 frames of corridor-office, 5 cm off, has 0.20 of |x| > 0.15 around there, and agrees over all.
    """
    around = max(PART * ratios.slow - (last - first), 0) // 2
    part = ratios.between(first - around, last + around)
    part = part if part.enough else ratios
    x, y = part.triangulated, part.carried
    return (
        part.enough
        and len(y) >= LEAST
        and bool(np.mean(np.abs(x) > MUCH) < HEALTHY_OFF and np.mean(np.abs(y) > MUCH) < HEALTHY_SURFACES_OFF)
    )


def check_depth(estimate: Estimate, ratios: DepthRatios) -> Iterator[Finding]:
    """Whether the sensor's depth and the geometry of the run are those of one world, in all of it and in each part."""
    if not estimate.metric:  # the depth was not used, and the poses have another unit
        return
    length = PART * ratios.slow
    starts = range(0, max(len(estimate) - length, 0) + 1, max(length // 4, 1))
    parts = [ratios.between(start, start + length - 1) for start in starts]
    for check, contradiction in CONTRADICTIONS:
        text = contradiction(ratios)
        if text is not None:
            yield Finding(check, "degraded", text, scale=True)
            continue
        texts = [contradiction(part) for part in parts]
        for first, last in spans(np.array([text is not None for text in texts])):
            start = int(estimate.frames[starts[first]])
            end = int(estimate.frames[min(starts[last] + length, len(estimate)) - 1])
            text = f"frames {start} to {end}: {texts[(first + last) // 2]}"
            yield Finding(check, "degraded", text, start, end, scale=True)
    share, sigma = share_of_distance(ratios) if ratios.enough else (0.0, 0.0)
    if share > max(DISTANCE, DISTANCE_SIGMAS * sigma):
        text = (
            "the sensor's depth looks like distances from the camera's centre, not like depth along its axis: divide "
            "it by the length of each pixel's ray, ((x - cx) / fx, (y - cy) / fy, 1)"
        )
        yield Finding("depth scale", "degraded", text, scale=True)


def share_of_distance(ratios: DepthRatios) -> tuple[float, float]:
    """By how much of the way from depth to distance the sensor's depth is longer than the motion's, and the standard
    deviation of that: least squares over the tracks, of Huber weights.
    """
    tracks, own = np.unique(ratios.tracks, return_inverse=True)
    longer, oblique = (ndimage.median(of, own, range(len(tracks))) for of in (ratios.triangulated, ratios.oblique))
    weight, share, aside, off = np.ones(len(tracks)), 0.0, oblique, longer
    for _ in range(ITERATIONS):
        aside = oblique - np.average(oblique, weights=weight)
        spread = max(float(np.sum(weight * aside**2)), SMALLEST)
        share = float(np.sum(weight * aside * longer)) / spread
        off = longer - np.average(longer, weights=weight) - share * aside
        width = ROBUST * max(1.48 * float(np.median(np.abs(off))), SMALLEST)
        weight = np.minimum(1.0, width / np.maximum(np.abs(off), SMALLEST))
    # Of Huber's estimate (Huber, Robust Statistics, 1981, section 7.6).
    variance = np.mean((weight * off) ** 2) / np.mean(weight == 1.0) ** 2
    return share, float(np.sqrt(variance / max(np.sum(aside**2), SMALLEST)))


def _other_scale(ratios: DepthRatios) -> str | None:
    middle = float(np.median(ratios.triangulated)) if ratios.enough else 0.0
    if abs(middle) <= MOST_SCALE:
        return None
    return f"the sensor's depth is {np.exp(middle):.2f} times what the motion between the images gives"


def _other_depths(ratios: DepthRatios) -> str | None:
    if not ratios.enough:
        return None
    x, y = ratios.triangulated, ratios.carried
    wrong = np.abs(x - np.median(x)) > MUCH
    off = float(np.mean(wrong))
    apart = len(y) >= LEAST and np.mean(np.abs(y) > MUCH) > HEALTHY_SURFACES_OFF
    if off - (0.0 if apart else 2.0) * _standard_error(wrong, ratios.tracks) <= MOST_OFF:
        return None
    return (
        f"{100 * off:.0f} % of the sensor's depths differ by more than {100 * MUCH:.0f} % from what the motion "
        "between the images gives (5 to 10 % do with good depth): depth and images do not belong together"
    )


def _other_scales(ratios: DepthRatios) -> str | None:
    medians = ratios.frame_medians() if ratios.enough else np.zeros(0)
    spread = float(1.48 * np.median(np.abs(medians - np.median(medians)))) if len(medians) >= 5 else 0.0
    if spread <= MOST_SPREAD:
        return None
    return f"depth and motion disagree by another factor in each frame (spread {100 * spread:.0f} %)"


def _other_surfaces(ratios: DepthRatios) -> str | None:
    y = ratios.carried
    off = float(np.mean(np.abs(y) > MUCH)) if len(y) >= LEAST else 0.0
    if off <= MOST_SURFACES_OFF:
        return None
    return (
        f"{100 * off:.0f} % of the sensor's depths contradict those of the frames beside them by more than "
        f"{100 * MUCH:.0f} %"
    )


CONTRADICTIONS: tuple[tuple[str, Callable[[DepthRatios], str | None]], ...] = (
    ("depth scale", _other_scale),
    ("depth and motion", _other_depths),
    ("depth scale", _other_scales),
    ("depth and depth", _other_surfaces),
)


def _standard_error(wrong: np.ndarray, tracks: np.ndarray) -> float:
    """Of the share of bool [m] that is true, where what is of one track int [m] goes together (Liang, Zeger, 1986)."""
    apart = wrong - wrong.mean()
    return float(np.sqrt(np.sum(np.bincount(tracks, apart) ** 2)) / len(wrong))


def _pair(
    evidence: Evidence, row: int, other: int, relative: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Triangulated log ratios, the numbers of their tracks, the logarithms of distance over depth, and carried log
    ratios.
    """
    first, second = evidence[row], evidence[other]
    rows, others = common(first, second)
    before, after = first.pixels[rows].astype(np.float64), second.pixels[others].astype(np.float64)
    depth, there = first.depth[rows].astype(np.float64), second.depth[others].astype(np.float64)
    depth, there = (np.where(z > 0, z, np.nan) for z in (depth, there))
    inverse, information = rigid.triangulate(before, after, relative, intrinsics)
    # Errors of the pose move corners along their lines as far as they do across.
    least = SURE * max(1.0, _across(before, after, relative, intrinsics))
    # By the sensor's depth, too: where the camera only turns, noise alone triangulates to something near and sure.
    sure = (inverse * np.sqrt(information) > least) & (np.sqrt(information) / depth > least / FAR_OFF)
    carried = rigid.unproject(before, 1 / depth, np.eye(4), intrinsics) @ relative[:3, :3].T + relative[:3, 3]
    both = np.isfinite(carried[:, 2]) & (carried[:, 2] > 0) & np.isfinite(there)
    both &= np.count_nonzero(both) >= LEAST_COMMON
    sure &= np.count_nonzero(sure) >= LEAST_SHARE * len(sure)
    oblique = np.log(np.linalg.norm(pinhole.rays(before[sure], intrinsics), axis=1))
    return np.log(inverse[sure] * depth[sure]), first.ids[rows][sure], oblique, np.log(carried[both, 2] / there[both])


def _across(before: np.ndarray, after: np.ndarray, relative: np.ndarray, intrinsics: np.ndarray) -> float:
    """Standard deviation of the corners from their epipolar lines, pixels; robust, 0 without corners."""
    if not len(before):
        return 0.0
    plane = rigid.cross(relative[:3, 3], pinhole.rays(before, intrinsics) @ relative[:3, :3].T)
    normal = plane[:, :2] / np.asarray(intrinsics, np.float64)[:2]
    off = (plane * pinhole.rays(after, intrinsics)).sum(1) / np.maximum(np.linalg.norm(normal, axis=1), 1e-18)
    return 1.48 * float(np.median(np.abs(off)))
