"""VGGT (Wang et al., CVPR 2025) as the geometry of a window: all its views at once, up to scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation
from vggtgeo.models.onnx.cache import MemoryCache, OutputCache, Outputs
from vggtgeo.models.onnx.fit import Fit
from vggtgeo.models.onnx.session import Session
from vggtgeo.models.roles import GeometryResult, WindowGuess

FARTHEST = 1e6
"""Scenes are of about unit size in the network's own scale; a camera beyond this is nowhere."""


@dataclass(frozen=True, eq=False)
class VggtWindow:
    """A `WindowGeometry`. A file with a fixed number of views takes up to so many; the last image fills the rest."""

    session: Session
    cache: OutputCache = field(default_factory=MemoryCache)

    @property
    def views(self) -> int | None:
        """Most views of a window; None if the file leaves it open."""
        return self.session.inputs["images"].shape[0]

    def window(self, images: Sequence[np.ndarray], intrinsics: np.ndarray | None = None) -> WindowGuess:
        """Return poses, shared intrinsics, depth and confidence of `images`; see `WindowGeometry.window`.

        Given intrinsics are handed back. A view whose quaternion has no length, or whose translation is not finite or
        beyond all scenes, is not found.
        """
        if self.views is not None and len(images) > self.views:
            raise ValueError(
                f"`images` has {len(images)} views, but `{self.session.path}` takes at most {self.views}; "
                "give fewer, or export it for more views"
            )
        fit = self.session.fit(images[0])
        outputs = self.cache.get((self.session,), ("window",), images, lambda: self._run(images, fit))
        count = len(images)
        poses, cameras, found = decode_cameras(outputs["pose_enc"][:count], fit.network_size)
        if intrinsics is None:
            intrinsics = fit.intrinsics_to_image(shared_intrinsics(cameras))
        depth = np.stack([fit.map_to_image(image) for image in outputs["depth"][:count]])
        certainty = np.stack([fit.map_to_image(image) for image in outputs["depth_conf"][:count]])
        valid = (depth > 0) & found[:, None, None]
        return WindowGuess(
            poses=poses,
            intrinsics=np.asarray(intrinsics, np.float64),
            depth=np.where(valid, depth, np.float32(np.nan)),
            confidence=np.where(valid, confidence_of(certainty), np.float32(0.0)),
            found=found,
            result=GeometryResult.SUCCESS if found.all() else GeometryResult.DEGENERATE,
        )

    def _run(self, images: Sequence[np.ndarray], fit: Fit) -> Outputs:
        prepared = [self.session.prepare(image, fit) for image in images]
        missing = (self.views or len(images)) - len(images)
        batch = np.concatenate(prepared + prepared[-1:] * missing)
        return self.session.run({"images": batch}, ("pose_enc", "depth", "depth_conf"))


def decode_cameras(encoding: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return poses float64 [n, 4, 4] (world -> camera), intrinsics float64 [n, 4] in pixels, and which are usable, bool
    [n].

    encoding: float [n, 9], translation, quaternion x y z w, vertical and horizontal field of view in radians. size:
    (height, width) of the network's images, whose centre is the principal point. A view that is not usable repeats
    the pose of the one before it.
    """
    values = np.asarray(encoding, np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        found = np.isfinite(values).all(axis=1) & (np.linalg.norm(values[:, 3:7], axis=1) > 1e-6)
        found &= (np.abs(values[:, :3]) < FARTHEST).all(axis=1)
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    for view in range(len(values)):
        if found[view]:
            poses[view, :3, :3] = Rotation.from_quat(values[view, 3:7]).as_matrix()
            poses[view, :3, 3] = values[view, :3]
        elif view:
            poses[view] = poses[view - 1]
    # An angle outside (0, pi) is no field of view; its limits keep the focal length finite.
    angles = np.clip(np.nan_to_num(values[:, 7:9]), 0.01, np.pi - 0.01)
    extent = np.array(size, np.float64)
    focal = 0.5 * extent / np.tan(0.5 * angles)
    centre = np.broadcast_to(0.5 * (extent - 1.0), focal.shape)
    return poses, np.concatenate([focal[:, ::-1], centre[:, ::-1]], axis=1), found


def shared_intrinsics(cameras: np.ndarray) -> np.ndarray:
    """Return one camera, float64 [4], of those of all views, float [n, 4]: robust means, of the focal lengths'
    logarithms.
    """
    focal = [np.exp(robust_mean(np.log(column))) for column in cameras[:, :2].T]
    return np.array([*focal, *(robust_mean(column) for column in cameras[:, 2:].T)])


def robust_mean(values: np.ndarray) -> float:
    """Return the mean of the values within 3 robust standard deviations of the median."""
    middle = np.median(values)
    off = np.abs(values - middle)
    # 1.4826 times the median absolute deviation estimates a normal standard deviation.
    return float(values[off <= 3.0 * 1.4826 * np.median(off) + 1e-12 * abs(middle)].mean())


def confidence_of(certainty: np.ndarray) -> np.ndarray:
    """Return 1 - 1 / c in [0, 1): the loss multiplies the error by the network's c >= 1, so the error is like 1 / c."""
    return (1.0 - 1.0 / np.maximum(certainty, 1.0)).astype(np.float32)
