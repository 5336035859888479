"""Alignment of a window in a model's own frame and scale with a known metric world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from vggtgeo.models.checks import check_array
from vggtgeo.models.roles import WindowGuess

from vggtgeo.geometry import rigid

_ENOUGH_PIXELS = 5000
"""Pixels of a view that determine its scale."""


def align_window(guess: WindowGuess, poses: np.ndarray, depths: Sequence[np.ndarray] = ()) -> WindowGuess | None:
    """Return the window in the world in which `poses` are, with metric translations and depths; None if that is
    undetermined.

    The scale s is the confidence-weighted median of `depths` / window depth where both are known; otherwise,
    unless the window is metric, the ratio of the spreads of the camera centres. Then X_window = R X_world + t is the
    rotation closest to all G_k^-1 P_k (chordal mean) and the translation that makes the mean centres coincide.

    poses: float [k, 4, 4], world -> camera, of the first k views of the window. depths: of those views, float [H, W]
    in metres, NaN = none.
    """
    check_array("poses", poses, (None, 4, 4))
    count = len(poses)
    if count > len(guess.poses):
        raise ValueError(f"`poses` must have at most the window's {len(guess.poses)} views, got {count}")
    use = np.flatnonzero(guess.found[:count])
    scale = _scale(guess, poses, depths, use)
    if not len(use) or scale is None:
        return None
    placed = guess.poses.copy()
    placed[:, :3, 3] *= scale
    between = np.swapaxes(placed[use, :3, :3], 1, 2) @ poses[use, :3, :3]
    rotation = Rotation.from_matrix(between).mean().as_matrix()
    to_window = np.eye(4)
    to_window[:3, :3] = rotation
    to_window[:3, 3] = (rigid.centres(placed[use]) - rigid.centres(poses[use]) @ rotation.T).mean(axis=0)
    depth = (guess.depth * np.float32(scale)).astype(np.float32)
    return replace(guess, poses=placed @ to_window, depth=depth, metric=True)


def _scale(guess: WindowGuess, poses: np.ndarray, depths: Sequence[np.ndarray], use: np.ndarray) -> float | None:
    by_depth = _depth_scale(guess, depths, use)
    if by_depth is not None:
        return by_depth
    if guess.metric:
        return 1.0
    spreads = [np.linalg.norm(centres - centres.mean(axis=0)) for centres in _two_centres(guess.poses, poses, use)]
    # Below 1 cm of motion the scale would be noise of the poses.
    return float(spreads[1] / spreads[0]) if len(use) > 1 and spreads[1] > 0.01 and spreads[0] > 1e-9 else None


def _two_centres(first: np.ndarray, second: np.ndarray, use: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return (rigid.centres(first[use]), rigid.centres(second[use])) if len(use) else (np.zeros((1, 3)), np.zeros((1, 3)))


def _depth_scale(guess: WindowGuess, depths: Sequence[np.ndarray], use: np.ndarray) -> float | None:
    ratios, weights = [], []
    for view in use[use < len(depths)]:
        check_array("depths", depths[view], guess.depth.shape[1:], finite=False)
        # The median of some thousand pixels is accurate enough.
        step = max(1, int(np.sqrt(depths[view].size / _ENOUGH_PIXELS)))
        own, known, confidence = (
            image[::step, ::step] for image in (guess.depth[view], depths[view], guess.confidence[view])
        )
        both = (own > 0) & (known > 0)
        ratios.append(known[both] / own[both])
        weights.append(confidence[both])
    if not ratios:
        return None
    ratio, weight = np.concatenate(ratios), np.concatenate(weights)
    return _weighted_median(ratio, weight) if weight.sum() > 0 else None


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order], dtype=np.float64)
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
