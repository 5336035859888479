"""World -> camera poses as 4 x 4 matrices in numpy, and projection with a posed pinhole."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import pinhole


def invert(pose: np.ndarray) -> np.ndarray:
    """Return the inverse of rigid motions [..., 4, 4]."""
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    result = np.zeros_like(pose)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, pose[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def centre(pose: np.ndarray) -> np.ndarray:
    """Return the camera centre in the world, [3]."""
    return -pose[:3, :3].T @ pose[:3, 3]


def centres(poses: np.ndarray) -> np.ndarray:
    """Return the camera centres of poses [n, 4, 4] in the world, [n, 3]."""
    return -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])


def angle_between(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle of the relative rotation, radians."""
    cosine = (np.trace(first[:3, :3].T @ second[:3, :3]) - 1) / 2
    # Rounding may leave the cosine of equal rotations above 1.
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def unproject(pixels: np.ndarray, inverse_depth: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Return the world points [m, 3] of pixels with inverse depths, NaN for NaN."""
    local = pinhole.rays(pixels, intrinsics) / inverse_depth[:, None]
    return (local - pose[:3, 3]) @ pose[:3, :3]


def project(points: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Return the pixels [m, 2] of world points, NaN behind the camera."""
    return pinhole.project(points @ pose[:3, :3].T + pose[:3, 3], intrinsics)


def to_quaternion(poses: np.ndarray) -> np.ndarray:
    """Return `(qw, qx, qy, qz, tx, ty, tz)` of matrices [n, 4, 4], float64 [n, 7]."""
    xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return np.concatenate([xyzw[:, 3:], xyzw[:, :3], poses[:, :3, 3]], 1)


def to_matrix(quaternions: np.ndarray) -> np.ndarray:
    """Return the matrices of `to_quaternion`, [n, 4, 4]."""
    poses = np.tile(np.eye(4), (len(quaternions), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
    poses[:, :3, 3] = quaternions[:, 4:]
    return poses


def triangulate(
    pixels: np.ndarray, targets: np.ndarray, relative: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverse depth of pixels of camera i matched to `targets` in camera j, and its information.

    `d (t x r') = -(R r) x r'` in the least-squares sense; `relative` maps camera i to camera j. The information is
    `f^2 |t x r'|^2`, so several views combine by a weighted mean. Returns two float64 [m].
    """
    turned = pinhole.rays(pixels, intrinsics) @ relative[:3, :3].T
    seen = pinhole.rays(targets, intrinsics)
    lever = cross(relative[:3, 3], seen)
    # Zero without parallax: the ray is then along the baseline.
    information = (lever**2).sum(1)
    value = -(lever * cross(turned, seen)).sum(1) / np.maximum(information, 1e-18)
    return value, information * float(intrinsics[0]) ** 2


def cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return cross products of vectors [..., 3]; for a few rows `np.cross` spends most of its time on axes."""
    a, b, c = first[..., 0], first[..., 1], first[..., 2]
    x, y, z = second[..., 0], second[..., 1], second[..., 2]
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], -1)


def skew(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices `[v]x`, [..., 3, 3], of vectors [..., 3]: `[v]x w = v x w`."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    none = np.zeros_like(x)
    return np.stack([none, -z, y, z, none, -x, -y, x, none], -1).reshape(*x.shape, 3, 3)


def orthonormal(pose: np.ndarray) -> np.ndarray:
    """Return the nearest rigid motion: products of many poses lose orthonormal rotations."""
    result = pose.copy()
    result[:3, :3] = Rotation.from_matrix(pose[:3, :3]).as_matrix()
    return result


def fraction(motion: np.ndarray, share: float) -> np.ndarray:
    """Return a share in [0, 1] of a small rigid motion: of its rotation vector and its translation."""
    part = np.eye(4)
    part[:3, :3] = Rotation.from_rotvec(share * Rotation.from_matrix(motion[:3, :3]).as_rotvec()).as_matrix()
    part[:3, 3] = share * motion[:3, 3]
    return part


def exponential(tangent: np.ndarray) -> np.ndarray:
    """Return the motion [4, 4] of a translation and a rotation vector, float64 [6].

    Exp on R^3 x SO(3): equal to that of SE(3) to first order, and as good a retraction. By Rodrigues' formula with
    Python's numbers: a call that releases Python's lock, as OpenCV's do, may wait for it sixty times as long as it
    takes.
    """
    tx, ty, tz, x, y, z = map(float, tangent)
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    # sin(a) / a and (1 - cos(a)) / a^2; by their series where the second would cancel.
    along = math.sin(angle) / angle if angle > 1e-4 else 1 - square / 6
    bend = (1 - math.cos(angle)) / square if angle > 1e-4 else 0.5 - square / 24
    return np.array(
        [
            [1 - bend * (y * y + z * z), bend * x * y - along * z, bend * x * z + along * y, tx],
            [bend * x * y + along * z, 1 - bend * (x * x + z * z), bend * y * z - along * x, ty],
            [bend * x * z - along * y, bend * y * z + along * x, 1 - bend * (x * x + y * y), tz],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def moved(poses: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """Return `exponential(tangent) @ pose` for each of n poses [n, 4, 4] and tangents [n, 6]."""
    steps = np.tile(np.eye(4), (len(tangents), 1, 1))
    steps[:, :3, :3] = Rotation.from_rotvec(tangents[:, 3:]).as_matrix()
    steps[:, :3, 3] = tangents[:, :3]
    return np.asarray(steps @ poses)


def adjoint(pose: np.ndarray) -> np.ndarray:
    """Return `Ad(T)` of rigid motions [..., 4, 4], float64 [..., 6, 6]; tangents have translation first."""
    rotation = pose[..., :3, :3]
    found = np.zeros((*pose.shape[:-2], 6, 6))
    found[..., :3, :3] = found[..., 3:, 3:] = rotation
    found[..., :3, 3:] = skew(pose[..., :3, 3]) @ rotation
    return found
