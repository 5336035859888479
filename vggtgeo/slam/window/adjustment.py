"""Build bundle-adjustment problems from keyframes and matches, and write the results back.

Landmarks are those key points and line samples of each keyframe with the most matches (`Selection`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.padding import PaddedSize, SlotIndex
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import TINY
from vggtgeo.models.classical import line_coefficients
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.sparse_map.covisibility import Directed
from vggtgeo.slam.sparse_map.keyframe import (
    LINE_SPACING,
    MAX_DEPTH_ERROR,
    MIN_INVERSE_DEPTH,
    PIXEL_SIGMA,
    Keyframe,
    Slots,
)

LINE_GATE = 12.0
"""Largest distance of a line sample from its matched segment before an adjustment, pixels; the robust kernel handles
outliers within it."""


@dataclass(frozen=True, eq=False)
class CameraPrior:
    """Prior of the intrinsics. mean, sigma: float64 [4] of fx, fy, cx, cy, pixels.

    shared_focal: whether `fx = fy`; a guessed camera has square pixels.
    """

    mean: np.ndarray
    sigma: np.ndarray
    shared_focal: bool = False

    def parameters(self, intrinsics: np.ndarray) -> np.ndarray:
        """Return the parameters of the model from fx, fy, cx, cy (or from their standard deviations)."""
        return np.array([np.mean(intrinsics[:2]), *intrinsics[2:]]) if self.shared_focal else intrinsics


@dataclass(frozen=True, eq=False)
class Adjustment:
    """A packed problem, with host row and slot of each landmark (points, then line samples) to write results back."""

    keyframes: tuple[int, ...]
    """Numbers of the keyframes, in the order of the problem's."""
    problem: Problem
    initial: State
    index: SlotIndex
    host: np.ndarray
    slot: np.ndarray
    is_line: np.ndarray
    informed: np.ndarray
    """Whether the landmark's depth is constrained well enough to be used elsewhere, `[D]`."""
    estimate_sigma: np.ndarray
    """Standard deviation of its inverse depth by views of other keyframes, `[D]`, NaN where it has another source."""


@dataclass(frozen=True, eq=False)
class Selection:
    """Chosen slots, sorted by host, and a table from (host, slot) to landmark, -1 = not chosen.

    Hosts, and the ends of edges, are rows of the adjusted keyframes.
    """

    host: np.ndarray
    slot: np.ndarray
    table: tuple[np.ndarray, ...]

    def read(self, slots: Sequence[Slots], name: str) -> np.ndarray:
        """Return a field of the chosen slots, float64 [m, ...]; `slots` are those of each host."""
        ends = np.cumsum(np.bincount(self.host, minlength=len(slots)))
        own = np.split(self.slot, ends[:-1])
        return np.concatenate([getattr(of_host, name)[chosen] for of_host, chosen in zip(slots, own, strict=True)])

    def landmarks(self, edge: Directed) -> tuple[np.ndarray, np.ndarray]:
        """Return the landmarks of the chosen point matches of an edge, and which matches these are, bool [matches]."""
        landmark = self.table[edge.host][edge.slots]
        chosen = landmark >= 0
        return landmark[chosen], chosen

    @classmethod
    def of(cls, chosen: list[np.ndarray], sizes: list[int]) -> Selection:
        host = np.repeat(np.arange(len(chosen)), [len(c) for c in chosen])
        starts = np.cumsum([0, *(len(c) for c in chosen)])
        tables = []
        for size, slots, start in zip(sizes, chosen, starts[:-1], strict=True):
            table = np.full(size, -1)
            table[slots] = start + np.arange(len(slots))
            tables.append(table)
        return cls(host, np.concatenate([*chosen, np.zeros(0, int)]).astype(int), tuple(tables))

    @classmethod
    def points(cls, keyframes: Sequence[Keyframe], edges: Sequence[Directed], most: int) -> Selection:
        """Select at most so many key points of each keyframe."""
        counts = [np.zeros(len(keyframe.features)) for keyframe in keyframes]
        for edge in edges:
            counts[edge.host][edge.slots] += _rank(edge.confidence)
        chosen = []
        for count in counts:
            order = np.argsort(-count, kind="stable")[:most]
            # A slot without a match has only its prior, which is its optimum.
            chosen.append(np.sort(order[count[order] > 0]))
        return cls.of(chosen, [len(c) for c in counts])

    @classmethod
    def lines(cls, keyframes: Sequence[Keyframe], edges: Sequence[Directed], most: int) -> Selection:
        """Select at most so many line samples of each keyframe, of whole segments."""
        counts = [np.zeros(len(keyframe.lines)) for keyframe in keyframes]
        for edge in edges:
            counts[edge.host][edge.line_slots] += _rank(edge.line_confidence)
        chosen = []
        for keyframe, count in zip(keyframes, counts, strict=True):
            known = np.isfinite(keyframe.samples.inverse_depth)
            length = np.bincount(keyframe.sample_segment, minlength=len(count))
            order = np.argsort(-count, kind="stable")
            order = order[count[order] > 0]
            order = order[np.cumsum(length[order]) <= most]
            chosen.append(np.flatnonzero(np.isin(keyframe.sample_segment, order) & known))
        return cls.of(chosen, [len(keyframe.sample_segment) for keyframe in keyframes])


def build(
    keyframes: Sequence[Keyframe],
    edges: Sequence[Directed],
    intrinsics: np.ndarray,
    settings: SlamSettings,
    *,
    size: PaddedSize | None,
    camera: CameraPrior,
    fixed_pose: np.ndarray,
    terms: Sequence[AbstractTerm] = (),
) -> Adjustment:
    """Pack `keyframes` (at most `size.keyframes`) and the directed edges between them.

    At most `point_slots` key points (those with the most observations) and `line_slots` line samples of each host are
    used. terms: further terms on poses and pairs, by the position of a keyframe in `keyframes`. camera: prior of the
    intrinsics; they start from `intrinsics`, fx, fy, cx, cy.
    """
    row = {keyframe.number: i for i, keyframe in enumerate(keyframes)}
    edges = [replace(edge, host=row[edge.host], target=row[edge.target]) for edge in edges]
    points = Selection.points(keyframes, edges, settings.window.point_slots)
    lines = Selection.lines(keyframes, edges, settings.window.line_slots)
    observations, depths, informed, estimate_sigma = _observed(keyframes, edges, points, lines, intrinsics, settings)
    problem, initial, index = pack(
        observations,
        rigid.to_quaternion(np.array([keyframe.pose for keyframe in keyframes])),
        Intrinsics(
            camera.parameters(intrinsics),
            shared_focal=camera.shared_focal,
            prior_mean=camera.parameters(camera.mean),
            prior_sigma=camera.parameters(camera.sigma),
        ),
        np.maximum(depths, MIN_INVERSE_DEPTH),
        size=size,
        fixed_pose=fixed_pose,
        terms=terms,
    )
    return Adjustment(
        keyframes=tuple(keyframe.number for keyframe in keyframes),
        problem=problem,
        initial=initial,
        index=index,
        host=observations.host,
        slot=np.concatenate([points.slot, lines.slot]),
        is_line=np.arange(len(observations.host)) >= len(points.host),
        informed=informed,
        estimate_sigma=estimate_sigma,
    )


def write_back(
    keyframes: Sequence[Keyframe], adjustment: Adjustment, state: State
) -> tuple[tuple[Keyframe, ...], np.ndarray]:
    """Return the keyframes with adjusted poses and inverse depths, and the adjusted intrinsics."""
    poses = rigid.to_matrix(np.asarray(state.poses.wxyz_xyz, np.float64))
    depths = adjustment.index.gather(state.inverse_depth)
    updated = []
    for i, keyframe in enumerate(keyframes):
        # Landmarks that are not `informed` keep their depth: the adjustment moved them along an unobserved direction.
        here = (adjustment.host == i) & adjustment.informed
        points = _updated(keyframe.points, adjustment, depths, here & ~adjustment.is_line)
        samples = _updated(keyframe.samples, adjustment, depths, here & adjustment.is_line)
        updated.append(replace(keyframe, pose=poses[i], points=points, samples=samples))
    parameters = np.asarray(state.intrinsics, np.float64)
    shared = adjustment.problem.shared_focal
    return tuple(updated), np.array([parameters[0], *parameters]) if shared else parameters


def _updated(slots: Slots, adjustment: Adjustment, depths: np.ndarray, here: np.ndarray) -> Slots:
    inverse, estimate_sigma = slots.inverse_depth.copy(), slots.estimate_sigma.copy()
    inverse[adjustment.slot[here]] = np.maximum(depths[here], MIN_INVERSE_DEPTH)
    estimate_sigma[adjustment.slot[here]] = adjustment.estimate_sigma[here]
    return replace(slots, inverse_depth=inverse, estimate_sigma=estimate_sigma)


def _observed(
    keyframes: Sequence[Keyframe],
    edges: Sequence[Directed],
    points: Selection,
    lines: Selection,
    intrinsics: np.ndarray,
    settings: SlamSettings,
) -> tuple[Observations, np.ndarray, np.ndarray, np.ndarray]:
    """Return the observations of the selected points and line samples, their initial inverse depths, whether these are
    constrained, and the standard deviations by views. Edges: by rows of `keyframes`.
    """
    depths, informed, estimate_sigma = _initial_depths(keyframes, edges, points, intrinsics)
    key_points, samples = [keyframe.points for keyframe in keyframes], [keyframe.samples for keyframe in keyframes]
    read = lambda name: np.concatenate([points.read(key_points, name), lines.read(samples, name)])
    prior, sigma = read("prior_mean"), read("prior_sigma")
    has_prior = np.isfinite(prior) & np.isfinite(sigma)
    depths = np.concatenate([depths, read("inverse_depth")[len(points.host) :]])
    trust = depth_trust(read("prior_confidence"), read("confidence"), settings)
    # A slot without a prior needs finite placeholders; weight 0 removes its residual.
    weight = np.where(has_prior & (settings.depth_terms.depth_weight > 0), trust, 0.0)
    observations = Observations(
        edges=np.array([[edge.host, edge.target] for edge in edges], int).reshape(-1, 2),
        host=np.concatenate([points.host, lines.host]),
        pixel=read("pixels").reshape(-1, 2),
        **_point_rows(keyframes, edges, points, settings),
        **_line_rows(keyframes, edges, lines, len(points.host), intrinsics, settings),
        depth_mean=np.where(has_prior, prior, 1.0),
        depth_sigma=np.where(has_prior, sigma, 1.0),
        depth_weight=weight,
        alpha=settings.depth_terms.depth_weight,
        kernel=settings.window.kernel,
    )
    informed = np.concatenate([informed, np.ones(len(lines.host), bool)]) | has_prior
    estimate_sigma = np.concatenate([estimate_sigma, np.full(len(lines.host), np.nan)])
    return observations, depths, informed, np.where(has_prior, np.nan, estimate_sigma)


def depth_trust(own: np.ndarray, saliency: np.ndarray, settings: SlamSettings) -> np.ndarray:
    """Return the factor on the information of each depth, by the settings `depth_trust` and `confidence`."""
    if settings.weights.confidence == "none":
        return np.ones_like(own)
    return {"own": own, "saliency": saliency, "complement": 1.0 - saliency}[settings.depth_terms.depth_trust]


def _point_rows(
    keyframes: Sequence[Keyframe], edges: Sequence[Directed], points: Selection, settings: SlamSettings
) -> dict[str, np.ndarray]:
    rows = []
    for number, edge in enumerate(edges):
        # A slot has one match on an edge; of two targets the last is kept.
        landmark, chosen = points.landmarks(edge)
        omega = keyframes[edge.host].points.confidence[edge.slots[chosen]]
        weight = settings.weights.weight(edge.confidence[chosen] * omega)
        rows.append((np.full(len(landmark), number), landmark, edge.pixels[chosen], weight))
    none, nowhere = np.zeros(0, int), np.zeros((0, 2))
    return _columns(rows, point_edge=none, point_landmark=none, point_target=nowhere, point_weight=np.zeros(0))


def _line_rows(
    keyframes: Sequence[Keyframe],
    edges: Sequence[Directed],
    lines: Selection,
    offset: int,
    intrinsics: np.ndarray,
    settings: SlamSettings,
) -> dict[str, np.ndarray]:
    rows = []
    for number, edge in enumerate(edges):
        host, target = keyframes[edge.host], keyframes[edge.target]
        # All samples of a segment have the match of the segment.
        matched = np.full(len(host.lines), -1)
        matched[edge.line_slots] = np.arange(len(edge.line_slots))
        of_sample, landmark, samples = matched[host.sample_segment], lines.table[edge.host], host.samples
        chosen = np.flatnonzero((of_sample >= 0) & (landmark >= 0))
        if not len(chosen):
            continue
        match, ends = of_sample[chosen], target.lines.segments.endpoints
        places = rigid.unproject(samples.pixels[chosen], samples.inverse_depth[chosen], host.pose, intrinsics)
        near = supported(places, target.pose, ends[edge.line_targets[match]], intrinsics)
        weight = settings.weights.weight(edge.line_confidence[match] * samples.confidence[chosen])
        weight = np.where(near, weight * settings.line.line_weight, 0.0)
        coefficients = line_coefficients(ends)[edge.line_targets[match]]
        rows.append((np.full(len(chosen), number), offset + landmark[chosen], coefficients, weight))
    none, nothing = np.zeros(0, int), np.zeros((0, 3))
    return _columns(rows, line_edge=none, line_landmark=none, line_coefficients=nothing, line_weight=np.zeros(0))


def _columns(rows: Sequence[tuple[np.ndarray, ...]], **empty: np.ndarray) -> dict[str, np.ndarray]:
    """Return the concatenated columns of some rows by name. empty: columns without a row, for shape and type."""
    columns = zip(empty.values(), *rows, strict=True)
    return {name: np.concatenate(parts) for name, parts in zip(empty, columns, strict=True)}


def supported(points: np.ndarray, pose: np.ndarray, endpoints: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Return whether each world point [m, 3] projects next to its matched segment [m, 2, 2], pixels, bool [m].

    A segment constrains points along its own length: beyond its ends the error of its direction grows with the
    distance, and points behind the camera have no valid projection. pose: world -> camera of the view.
    """
    pixels = rigid.project(points, pose, intrinsics)
    along = endpoints[:, 1] - endpoints[:, 0]
    length = np.linalg.norm(along, axis=1)
    # Degenerate segments have a length of zero.
    direction = along / np.maximum(length, TINY)[:, None]
    offset = pixels - endpoints[:, 0]
    place = (offset * direction).sum(1)
    distance = np.abs(offset[:, 0] * direction[:, 1] - offset[:, 1] * direction[:, 0])
    # A comparison with NaN (behind the camera) is false.
    return (place > -LINE_SPACING) & (place < length + LINE_SPACING) & (distance < LINE_GATE)


def _initial_depths(
    keyframes: Sequence[Keyframe], edges: Sequence[Directed], points: Selection, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the inverse depth of each point (estimated, else triangulated), whether views constrain it, and its
    standard deviation by views.

    Points with parallel rays start far away. From a typical depth they would pull the cameras together until no
    parallax is left, and change the scale of a map without metric depth.
    """
    slots = [keyframe.points for keyframe in keyframes]
    current, before = points.read(slots, "inverse_depth"), points.read(slots, "estimate_sigma")
    triangulated, information, longest = _triangulated(keyframes, edges, points, intrinsics)
    seen = information > 0
    estimate_sigma = np.where(seen, 1.0 / np.sqrt(np.maximum(information, TINY)), np.nan)
    determined = seen & (triangulated > MIN_INVERSE_DEPTH) & (estimate_sigma < MAX_DEPTH_ERROR * triangulated)
    # Where a depth camera measures nothing there may be glass or a mirror: do not triangulate there.
    free = seen & ~np.array([np.isfinite(own.prior_mean).any() for own in slots])[points.host]
    # Far points whose depth is not determined still fix rotations, as long as their projection does not depend on
    # depth.
    # Known well enough for tracking: after a motion as long as its baseline, a point's projection is as certain as a
    # match. This excludes points in the direction of motion.
    steady = free & (estimate_sigma * longest * intrinsics[0] < PIXEL_SIGMA) & ~(estimate_sigma > before)
    known = np.isfinite(current)
    some = current[known] if known.any() else triangulated[determined]
    typical = np.median(some) if len(some) else 1.0
    depths = np.where(known, current, np.where(determined | free, triangulated, typical))
    return depths.astype(np.float64), determined | steady, estimate_sigma


def _triangulated(
    keyframes: Sequence[Keyframe], edges: Sequence[Directed], points: Selection, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean triangulated inverse depth of each point, its information, and its longest baseline."""
    weighted, information, longest = np.zeros((3, len(points.host)))
    for edge in edges:
        host, target = keyframes[edge.host], keyframes[edge.target]
        landmark, chosen = points.landmarks(edge)
        relative = target.pose @ rigid.invert(host.pose)
        pixels = host.features.pixels[edge.slots[chosen]], edge.pixels[chosen]
        value, weight = rigid.triangulate(*pixels, relative, intrinsics)
        np.add.at(weighted, landmark, weight * value)
        np.add.at(information, landmark, weight)
        np.maximum.at(longest, landmark, float(np.linalg.norm(relative[:3, 3])))
    # Mean by information in inverse depth, where the error of a triangulation is nearly Gaussian.
    return weighted / np.maximum(information, TINY), information, longest


def _rank(confidence: np.ndarray) -> np.ndarray:
    """Return what an observation adds to the rank of its landmark: confidence decides between equal numbers of them."""
    # Less than one observation, as long as there are no more than ten.
    return 1 + 0.1 * confidence
