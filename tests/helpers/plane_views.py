"""Tiny images with known geometry: a textured plane, seen through a known homography or by a known camera."""

import cv2
import numpy as np

INTRINSICS = np.array([260.0, 255.0, 158.0, 121.0])
SIZE = (320, 240)  # width, height


def texture(seed: int = 0, size: tuple[int, int] = (640, 480)) -> np.ndarray:
    """uint8 [H, W, 3]: random blobs of many sizes."""
    generator = np.random.default_rng(seed)
    total = np.zeros(size[::-1])
    for sigma in (1.5, 3.0, 6.0, 12.0):
        noise = cv2.GaussianBlur(generator.standard_normal(size[::-1]), (0, 0), sigma)
        total += noise / noise.std() * np.sqrt(sigma)
    gray = np.clip(128 + 40 * total / total.std(), 0, 255).astype(np.uint8)
    return np.repeat(gray[..., None], 3, axis=2)


def rotation(*degrees: float) -> np.ndarray:
    """The rotation by a rotation vector in degrees, float64 [3, 3]."""
    return cv2.Rodrigues(np.deg2rad(np.array(degrees)))[0]


def pose(degrees: tuple[float, float, float], translation: tuple[float, float, float]) -> np.ndarray:
    """A rigid motion, float64 [4, 4]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation(*degrees), translation
    return matrix


def camera_matrix(intrinsics: np.ndarray = INTRINSICS) -> np.ndarray:
    """K, float64 [3, 3]."""
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def plane_homography(motion: np.ndarray, distance: float = 2.0) -> np.ndarray:
    """Pixels of camera i -> pixels of camera j for the plane z = `distance` of camera i; `motion` is i -> j."""
    normal = np.array([0.0, 0.0, 1.0])
    matrix = camera_matrix()
    return matrix @ (motion[:3, :3] + np.outer(motion[:3, 3], normal) / distance) @ np.linalg.inv(matrix)


def move(homography: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Pixels float [n, 2] through a homography."""
    moved = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ homography.T
    return moved[:, :2] / moved[:, 2:]


def view(picture: np.ndarray, homography: np.ndarray, size: tuple[int, int] = SIZE) -> np.ndarray:
    """`picture` as seen through `homography` (picture pixels -> view pixels), four times oversampled."""
    fine = 4
    scale = np.array([[fine, 0, (fine - 1) / 2], [0, fine, (fine - 1) / 2], [0, 0, 1.0]])
    large = cv2.warpPerspective(picture, scale @ homography, (size[0] * fine, size[1] * fine), flags=cv2.INTER_CUBIC)
    return cv2.resize(large, size, interpolation=cv2.INTER_AREA)


def plane_pair(motion: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two views of a textured plane and the homography between them."""
    picture = texture(seed)
    shift = np.array([[1.0, 0, -160], [0, 1, -120], [0, 0, 1]])
    between = plane_homography(motion)
    return view(picture, shift), view(picture, between @ shift), between


def cloud(count: int, seed: int = 0) -> np.ndarray:
    """Points float64 [count, 3] that fill the view of a camera at the origin between 1 and 4 metres."""
    generator = np.random.default_rng(seed)
    depth = generator.uniform(1.0, 4.0, count)
    pixels = generator.uniform((10, 10), (SIZE[0] - 10, SIZE[1] - 10), (count, 2))
    rays = (pixels - INTRINSICS[2:]) / INTRINSICS[:2]
    return np.concatenate([rays * depth[:, None], depth[:, None]], axis=1)


def project(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Pixels float64 [n, 2] of world points under a world -> camera pose."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    return local[:, :2] / local[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]
