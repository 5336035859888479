"""MoGe-2 (Wang et al., 2025) as metric depth: its affine points, with shift and focal length recovered, times scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import least_squares
from vggtgeo.models.classical.sensor_depth import no_depth
from vggtgeo.models.onnx.cache import MemoryCache, OutputCache, Outputs
from vggtgeo.models.onnx.fit import Fit
from vggtgeo.models.onnx.session import Session
from vggtgeo.models.roles import DepthEstimate

from vggtgeo.io.argument_checks import check_fields

_GRID = 64


@dataclass(frozen=True, eq=False)
class MogeDepth:
    """A `MetricDepth` from the image alone; the sensor's depth is ignored.

    tokens: resolution of the network, if the file leaves it open (1200 to 3600; more is finer and slower). threshold:
    minimum mask of a valid pixel. sigma: relative standard deviation of the depth.
    """

    session: Session
    cache: OutputCache = field(default_factory=MemoryCache)
    tokens: int = 1800
    threshold: float = 0.5
    sigma: float = 0.05

    def __post_init__(self) -> None:
        check_fields(self, sigma="(0, inf)", threshold="[0, 1)", tokens="[1, inf)")

    def estimate(
        self,
        image: np.ndarray,
        sensor_depth: np.ndarray | None = None,
        intrinsics: Sequence[float] | None = None,
    ) -> DepthEstimate:
        """Return metric depth; with `intrinsics` only the shift is recovered, without them the focal length too."""
        fit = self.session.fit(image)
        outputs = self.cache.get((self.session,), ("depth", self.tokens), (image,), lambda: self._run(image, fit))
        mask = fit.map_to_image(outputs["mask"][0])
        points = fit.map_to_image(outputs["points"][0])
        keep = mask > self.threshold
        _, shift = recover_focal_shift(points, keep, intrinsics)
        depth = (points[..., 2] + np.float32(shift)) * np.float32(outputs["metric_scale"].reshape(-1)[0])
        valid = keep & (depth > 0)
        if not valid.any():
            return no_depth(image.shape[:2])
        return DepthEstimate(
            np.where(valid, depth, np.float32(np.nan)).astype(np.float32),
            np.where(valid, np.clip(mask, 0.0, 1.0), 0.0).astype(np.float32),
            np.where(valid, np.float32(self.sigma), np.float32(np.nan)),
        )

    def _run(self, image: np.ndarray, fit: Fit) -> Outputs:
        inputs = {"image": self.session.prepare(image, fit)}
        if "num_tokens" in self.session.inputs:
            inputs["num_tokens"] = np.asarray(self.tokens, np.int64)
        return self.session.run(inputs, ("points", "mask", "metric_scale"))


def recover_focal_shift(
    points: np.ndarray, keep: np.ndarray, intrinsics: Sequence[float] | None = None
) -> tuple[float, float]:
    """Return (f, s), pixels and the points' unit, that minimise sum |f (x, y) / (z + s) - (u, v)|^2.

    (u, v) is the pixel from the centre of the image; for a given s the best f is a ratio of two sums (variable
    projection), so the search is over s alone, by Levenberg-Marquardt on at most 64 x 64 points. With `intrinsics`
    (fx, fy, cx, cy) the rays are known, f is fx, and only s is sought.

    points: float [H, W, 3]. keep: bool [H, W]. Gives s = 0 where fewer than two points are kept.
    """
    counts = [min(side, _GRID) for side in keep.shape]
    spread = lambda side, count: ((np.arange(count) + 0.5) * side / count).astype(np.int64)
    rows, columns = map(spread, keep.shape, counts)
    which = keep[np.ix_(rows, columns)] & np.isfinite(points[np.ix_(rows, columns)]).all(axis=2)
    x, y, z = points[np.ix_(rows, columns)][which].astype(np.float64).T
    v, u = (axis[which].astype(np.float64) for axis in np.meshgrid(rows, columns, indexing="ij"))
    fx, fy, cx, cy = intrinsics or (1.0, 1.0, 0.5 * (points.shape[1] - 1), 0.5 * (points.shape[0] - 1))
    rays = np.concatenate([(u - cx) / fx, (v - cy) / fy])
    if len(z) < 2:
        return float(fx), 0.0

    def scale_and_error(shift: float) -> tuple[float, np.ndarray]:
        ahead = z + shift
        image = np.concatenate([x, y]) / np.tile(np.where(np.abs(ahead) < 1e-6, 1e-6, ahead), 2)
        factor = 1.0 if intrinsics is not None else float(image @ rays / max(image @ image, 1e-12))
        return factor, factor * image - rays

    start = _closed_form_shift(x, y, z, rays, intrinsics is not None)
    solution = least_squares(lambda s: scale_and_error(s[0])[1], [start], method="lm", x_scale=[np.ptp(z) + 1e-3])
    shift = float(solution.x[0])
    return float(fx * scale_and_error(shift)[0]), shift


def _closed_form_shift(x: np.ndarray, y: np.ndarray, z: np.ndarray, rays: np.ndarray, known: bool) -> float:
    """Return the shift of the equations multiplied out, f (x, y) = (z + s) (u, v): linear in f and s."""
    ahead = np.tile(z, 2)
    image = np.concatenate([x, y])
    if known:
        return float(rays @ (image - ahead * rays) / max(rays @ rays, 1e-12))
    solved = np.linalg.lstsq(np.stack([image, -rays], axis=1), ahead * rays, rcond=None)[0]
    return float(solved[1])
