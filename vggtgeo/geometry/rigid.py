"""World -> camera poses as 4 x 4 matrices in numpy, and what a posed pinhole sees."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.models import pinhole


def invert(pose: np.ndarray) -> np.ndarray:
    """Inverse of rigid motions, float64 [..., 4, 4]."""
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    result = np.zeros_like(pose)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, pose[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def centre(pose: np.ndarray) -> np.ndarray:
    """Camera centre in the world, metres."""
    return -pose[:3, :3].T @ pose[:3, 3]


def angle_between(first: np.ndarray, second: np.ndarray) -> float:
    """Angle of the relative rotation, radians."""
    cosine = (np.trace(first[:3, :3].T @ second[:3, :3]) - 1) / 2
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def unproject(pixels: np.ndarray, inverse_depth: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """World points float64 [m, 3] of pixels with inverse depths; NaN where the depth is."""
    local = pinhole.rays(pixels, intrinsics) / inverse_depth[:, None]
    return (local - pose[:3, 3]) @ pose[:3, :3]


def project(points: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Pixels float64 [m, 2] of world points; NaN behind the camera."""
    return pinhole.project(points @ pose[:3, :3].T + pose[:3, 3], intrinsics)


def to_quaternion(poses: np.ndarray) -> np.ndarray:
    """`(qw, qx, qy, qz, tx, ty, tz)` of world -> camera matrices, float64 [n, 7]."""
    xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return np.concatenate([xyzw[:, 3:], xyzw[:, :3], poses[:, :3, 3]], 1)


def to_matrix(quaternions: np.ndarray) -> np.ndarray:
    """The inverse of `to_quaternion`."""
    poses = np.tile(np.eye(4), (len(quaternions), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
    poses[:, :3, 3] = quaternions[:, 4:]
    return poses


def triangulate(
    pixels: np.ndarray, targets: np.ndarray, relative: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth of pixels of camera i matched to `targets` in camera j, and its information.

    `d (t x r') = -(R r) x r'` in the least-squares sense; `relative` maps camera i to camera j. The information is
    `f^2 |t x r'|^2`, so several views combine by a weighted mean. Returns two float64 [m].
    """
    turned = pinhole.rays(pixels, intrinsics) @ relative[:3, :3].T
    seen = pinhole.rays(targets, intrinsics)
    lever = cross(relative[:3, 3], seen)
    information = (lever**2).sum(1)
    value = -(lever * cross(turned, seen)).sum(1) / np.maximum(information, 1e-18)
    return value, information * float(intrinsics[0]) ** 2


def cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Cross products of vectors [..., 3]; on a few rows `np.cross` takes longer to move axes than to compute."""
    a, b, c = first[..., 0], first[..., 1], first[..., 2]
    x, y, z = second[..., 0], second[..., 1], second[..., 2]
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], -1)


def orthonormal(pose: np.ndarray) -> np.ndarray:
    """The nearest rigid motion: products of many poses drift away from orthonormal rotations."""
    result = pose.copy()
    result[:3, :3] = Rotation.from_matrix(pose[:3, :3]).as_matrix()
    return result


def fraction(motion: np.ndarray, share: float) -> np.ndarray:
    """A share in [0, 1] of a small rigid motion: of its rotation vector and of its translation."""
    part = np.eye(4)
    part[:3, :3] = Rotation.from_rotvec(share * Rotation.from_matrix(motion[:3, :3]).as_rotvec()).as_matrix()
    part[:3, 3] = share * motion[:3, 3]
    return part


def moved(poses: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """Each of float64 [n, 4, 4] by a small tangent [n, 6], translation first: turned from the left, then shifted."""
    steps = np.tile(np.eye(4), (len(tangents), 1, 1))
    steps[:, :3, :3] = Rotation.from_rotvec(tangents[:, 3:]).as_matrix()
    steps[:, :3, 3] = tangents[:, :3]
    return np.asarray(steps @ poses)


def adjoint(pose: np.ndarray) -> np.ndarray:
    """`Ad(T)` of rigid motions [..., 4, 4], float64 [..., 6, 6], tangents translation first."""
    x, y, z = np.moveaxis(pose[..., :3, 3], -1, 0)
    none, rotation = np.zeros_like(x), pose[..., :3, :3]
    skew = np.stack([none, -z, y, z, none, -x, -y, x, none], -1).reshape(rotation.shape)
    found = np.zeros((*pose.shape[:-2], 6, 6))
    found[..., :3, :3] = found[..., 3:, 3:] = rotation
    found[..., :3, 3:] = skew @ rotation
    return found
