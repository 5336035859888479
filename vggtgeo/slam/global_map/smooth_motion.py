"""Places of frames between keyframes: what their points leave open is filled in by a smooth motion.

Points that are far away determine how a camera turned, and hardly where it was: of a view from a balcony, metres may
fit all matches. The camera of such a frame is where its neighbours in time let it be. With `d_k` the displacement of
frame `k`, `L_k` the information of its points about it, and `a_k` the acceleration in three consecutive frames,
minimise

    sum_k rho(d_k' L_k d_k) + sum_k rho(|a_k(d)|^2 / sigma^2)

over the displacements of all frames but those of keyframes. `sigma` is the run's own: a robust deviation of all `a_k`,
which includes the noise of the places and so is rather too large. `rho` is Cauchy's kernel. The rotation of a frame
follows its place, as its points ask. Where points determine a place the motion hardly counts.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int
from scipy.sparse.linalg import spsolve

from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import REGULARISER, sigma_by_median
from vggtgeo.slam.global_map.propagated_poses import MAX_GAP

ROUNDS, WIDTH = 10, 3.0
"""Reweighted solutions, and the width of the kernel in standard deviations."""


def smoothed(
    times: Float[np.ndarray, " n"],
    poses: Float[np.ndarray, "n 4 4"],
    information: Float[np.ndarray, "n 6 6"],
    free: Bool[np.ndarray, " n"],
    label: Int[np.ndarray, " n"],
) -> Float[np.ndarray, "n 4 4"]:
    """Return the poses, world -> camera, with those of free frames where a smooth motion and their points want them.

    Args:
        times: s, increasing.
        poses: where the points alone want the frames, world -> camera.
        information: of the points about each pose, over its left tangent, translation first.
        free: whether a frame may move.
        label: the submap of each frame; negative for a frame without a pose.

    """
    motion = _accelerations(times, label)
    rows = np.flatnonzero(free & (label >= 0))
    if not len(rows) or not motion.shape[0]:
        return poses
    centres, turned = rigid.centres(poses), poses[rows, :3, :3]
    accelerations = motion @ centres
    sigma = max(sigma_by_median(accelerations), REGULARISER)
    known = information[rows] + REGULARISER * np.eye(6)
    # A displacement `d` of the centre is the translation `-R d` of the tangent; the rotation is eliminated.
    follows = np.linalg.solve(known[:, 3:, 3:], known[:, 3:, :3])
    places = turned.mT @ (known[:, :3, :3] - known[:, :3, 3:] @ follows) @ turned
    moved, fits, bends = np.zeros((len(times), 3)), np.ones(len(rows)), np.ones(motion.shape[0])
    own, diagonal = motion[:, rows], (np.arange(len(rows)), np.arange(len(rows) + 1))
    # Not `gauss_newton`: linear, so each round is one sparse solve; its dense steps would take the cube of the frames.
    for _ in range(ROUNDS):
        weighted = own.T @ sp.diags_array(bends / sigma**2)
        hessian = sp.kron(weighted @ own, np.eye(3)) + sp.bsr_array((fits[:, None, None] * places, *diagonal))
        moved[rows] = spsolve(hessian.tocsc(), -(weighted @ accelerations).ravel()).reshape(-1, 3)
        fits = _cauchy(np.einsum("ni,nij,nj->n", moved[rows], places, moved[rows]))
        bends = _cauchy(((accelerations + motion @ moved) ** 2).sum(1) / sigma**2)
    shift = -(turned @ moved[rows, :, None])
    found = poses.copy()
    found[rows] = rigid.moved(poses[rows], np.concatenate([shift, -follows @ shift], 1)[..., 0])
    return found


def _accelerations(times: np.ndarray, label: np.ndarray) -> sp.csr_array:
    """Return the matrix [m, n] from the places of frames to the accelerations in three consecutive ones."""
    count = len(times)
    middle = np.arange(1, count - 1)
    before, after = np.diff(times)[:-1], np.diff(times)[1:]
    same = (label[middle] >= 0) & (label[middle - 1] == label[middle]) & (label[middle + 1] == label[middle])
    longest = MAX_GAP * np.median(np.diff(times)) if count > 1 else 0.0
    chosen = same & (np.maximum(before, after) <= longest)
    middle, before, after = middle[chosen], before[chosen], after[chosen]
    rates = np.stack([1 / before, -1 / before - 1 / after, 1 / after], 1) / ((before + after) / 2)[:, None]
    columns = middle[:, None] + np.array([-1, 0, 1])
    line = np.repeat(np.arange(len(middle)), 3)
    return sp.csr_array((rates.ravel(), (line, columns.ravel())), shape=(len(middle), count))


def _cauchy(squares: np.ndarray) -> np.ndarray:
    """Return the weights of squared distances in standard deviations."""
    return 1 / (1 + squares / WIDTH**2)
