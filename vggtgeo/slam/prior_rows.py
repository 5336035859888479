"""What is known of one pose, or of the motion between two, as rows of the window's Gaussian prior.

They are linearised where the prior is, or, at a pose it has said nothing about so far, at the current estimate, and
stay there when keyframes leave, like any other information.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import jaxlie
import numpy as np

from vggtgeo.bundle.marginalisation import no_prior, square_root
from vggtgeo.bundle.problem import MarginalPrior
from vggtgeo.geometry import rigid
from vggtgeo.slam.evidence import tangent
from vggtgeo.slam.settings import SlamSettings
from vggtgeo.slam.state import Slam, Tie

TIE_SCALE = 12.6
"""Squared Mahalanobis distance at which a tie counts half: the 95 % level of 6 degrees of freedom."""
HOLD = 1e8
"""Information, 1/m^2 and 1/rad^2, that holds a pose: a tenth of a millimetre."""


def hold_pose(slam: Slam, number: int, settings: SlamSettings) -> Slam:
    """Hold keyframe `number` of the window where it is: the gauge of a window whose older members are gone."""
    prior, place = _prior(slam, settings), slam.window.index(number)
    rows = np.arange(6 * place, 6 * place + 6)
    return replace(slam, prior=_with(prior, rows, np.eye(6), np.zeros(6), HOLD * np.eye(6), slam))


def add_tie(slam: Slam, tie: Tie, settings: SlamSettings) -> Slam:
    """Tie two keyframes of the window by their tracked motion."""
    prior = _prior(slam, settings)
    i, j = slam.window.index(tie.first), slam.window.index(tie.second)
    points = _linearisation_points(prior, slam)
    relative = points[j] @ rigid.invert(points[i])
    rows = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
    jacobian = np.concatenate([-rigid.adjoint(relative), np.eye(6)], 1)
    residual = tangent(relative @ rigid.invert(tie.motion))
    return replace(slam, prior=_with(prior, rows, jacobian, residual, tie.information, slam))


def _prior(slam: Slam, settings: SlamSettings) -> MarginalPrior:
    return slam.prior if slam.prior is not None else no_prior(settings.window)


def _linearisation_points(prior: MarginalPrior, slam: Slam) -> np.ndarray:
    """World -> camera of the window's members, float64 [n, 4, 4]: the prior's where it speaks, else the estimate."""
    root = np.asarray(prior.root)
    poses = rigid.to_matrix(np.asarray(prior.poses.wxyz_xyz, np.float64))
    members = np.array([slam.keyframes[number].pose for number in slam.window])
    for place in range(len(members)):
        if np.any(root[:, 6 * place : 6 * place + 6]):
            members[place] = poses[place]
    return members


def _with(
    prior: MarginalPrior,
    rows: np.ndarray,
    jacobian: np.ndarray,
    residual: np.ndarray,
    information: np.ndarray,
    slam: Slam,
) -> MarginalPrior:
    members = _linearisation_points(prior, slam)
    root, offset = np.asarray(prior.root), np.asarray(prior.offset)
    hessian, gradient = root.T @ root, root.T @ offset
    hessian[np.ix_(rows, rows)] += jacobian.T @ information @ jacobian
    gradient[rows] += jacobian.T @ information @ residual
    points = np.asarray(prior.poses.wxyz_xyz).copy()
    points[: len(members)] = rigid.to_quaternion(members)
    new_root, new_offset = square_root(jnp.asarray(hessian), jnp.asarray(gradient))
    return MarginalPrior(new_root, new_offset, jaxlie.SE3(jnp.asarray(points)), prior.intrinsics)


def with_ties(prior: MarginalPrior | None, slam: Slam) -> MarginalPrior | None:
    """The prior of an adjustment of all keyframes, with every tie at the current poses; None where there is neither."""
    if not slam.ties:
        return prior
    prior = no_prior(len(slam.keyframes)) if prior is None else prior
    root, offset = np.asarray(prior.root), np.asarray(prior.offset)
    hessian, gradient = root.T @ root, root.T @ offset
    poses = np.array([keyframe.pose for keyframe in slam.keyframes])
    for tie in slam.ties:
        relative = poses[tie.second] @ rigid.invert(poses[tie.first])
        rows = np.r_[6 * tie.first : 6 * tie.first + 6, 6 * tie.second : 6 * tie.second + 6]
        jacobian = np.concatenate([-rigid.adjoint(relative), np.eye(6)], 1)
        residual = tangent(relative @ rigid.invert(tie.motion))
        # Cauchy's weight: a tie that everything else contradicts (a false loop) gives way.
        information = tie.information / (1.0 + residual @ tie.information @ residual / TIE_SCALE)
        hessian[np.ix_(rows, rows)] += jacobian.T @ information @ jacobian
        gradient[rows] += jacobian.T @ information @ residual
    new_root, new_offset = square_root(jnp.asarray(hessian), jnp.asarray(gradient))
    return MarginalPrior(
        new_root, new_offset, jaxlie.SE3(jnp.asarray(rigid.to_quaternion(poses))), jnp.asarray(slam.intrinsics)
    )
