"""Saved problems: a scene, its arrays and a way to write them changed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scenes import Scene, make_scene

SCENE = make_scene(noise=0.5, outliers=0.2, depth_error=0.05, seed=7)


def arrays_of(scene: Scene) -> dict[str, np.ndarray]:
    """A scene in the layout of docs/reference/problem-file.md."""
    seen = scene.observations
    return {
        "edges": seen.edges.astype(np.int32),
        "T_init": scene.start_poses,
        "k_init": scene.start_intrinsics,
        "k_prior_sigma": np.full(4, 5.0),
        "var_kf": seen.host,
        "var_uv": seen.pixel,
        "d_init": scene.start_inverse_depth,
        "d_prior": seen.depth_mean,
        "d_sigma": seen.depth_sigma,
        "d_weight": seen.depth_weight,
        "pt_edge": seen.point_edge,
        "pt_var": seen.point_landmark,
        "pt_target": seen.point_target,
        "pt_weight": seen.point_weight,
        "ln_edge": seen.line_edge,
        "ln_var": seen.line_landmark,
        "ln_abc": seen.line_coefficients,
        "ln_weight": seen.line_weight,
        "alpha": np.float64(seen.alpha),
        "huber": np.float64(1.5),
    }


def write(folder: Path, **changes: np.ndarray | None) -> Path:
    arrays = {**arrays_of(SCENE), **changes}
    np.savez(folder / "problem.npz", **{name: array for name, array in arrays.items() if array is not None})
    return folder / "problem.npz"
