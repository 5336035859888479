"""Named motions of poses and intrinsics, to report which directions of a problem are weakly constrained.

Frames: common motions of all free keyframes are given in the axes of the anchor, the first held camera (camera 0
without one), and rotations turn about its centre; motions of one keyframe are in its own camera axes (x right, y down,
z forward), rotations about its own centre. Pitch turns about x, yaw about y, roll about z. All are left tangents: they
move the world before the camera, so the camera itself goes the other way.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import Pinhole

MOTIONS = ("translation along x", "translation along y", "translation along z", "pitch", "yaw", "roll")
"""The names of a tangent's coordinates."""
_INTRINSICS = {
    **{"f": "focal length", "fx": "focal length", "fy": "aspect ratio"},
    **{"cx": "principal point u", "cy": "principal point v"},
}
"""Names of the motions of a camera's parameters, by parameter name; all others are distortion."""


def direction_names(keyframes: int, parameters: tuple[str, ...] = Pinhole.names) -> tuple[str, ...]:
    """Return the names of the rows of `common_directions` for cameras with these parameters, then of the keyframes'."""
    words = [name.partition(" ") for name in parameters]
    camera = tuple(f"{_INTRINSICS.get(name, f'distortion {name}')}{gap}{which}" for name, gap, which in words)
    each = tuple(f"keyframe {i}: {motion}" for i in range(keyframes) for motion in MOTIONS)
    return ("scale", *MOTIONS, *camera, *each)


def common_directions(problem: Problem, state: State) -> Float[Array, "g c"]:
    """Return one row for each global name (the first `g = 7 + q`), in the coordinates of the dense state.

    Units: 1 m, 1 rad, 1 pixel, or 100 % of scale or focal length. The other names are the keyframes' own coordinates,
    in their order. Fixed coordinates are not masked. The aspect ratio changes `fx` by 100 % and `fy` by -100 %.
    """
    keyframes, tail = problem.num_keyframes, problem.num_parameters
    rigid = rigid_motions(problem, state).transpose(2, 0, 1).reshape(lie.TANGENT, -1)
    common = jnp.concatenate([_scale(problem, state)[None], rigid])
    common = jnp.concatenate([common, jnp.zeros((len(common), tail), common.dtype)], 1)
    shared = _of_cameras(problem.parameter_names, state.parameters.astype(common.dtype))
    shared = jnp.concatenate([jnp.zeros((tail, lie.TANGENT * keyframes), common.dtype), shared], 1)
    return jnp.concatenate([common, shared])


def _of_cameras(names: tuple[str, ...], values: Float[Array, " q"]) -> Float[Array, "q q"]:
    """Return one row a parameter; focal lengths as their common change (size) and their difference (aspect ratio)."""
    rows = jnp.eye(len(names), dtype=values.dtype)
    for i, name in enumerate(names):
        kind = name.partition(" ")[0]
        if kind == "f":
            rows = rows.at[i, i].set(values[i])
        elif kind == "fx":
            rows = rows.at[i, i : i + 2].set(values[i : i + 2])
        elif kind == "fy":
            rows = rows.at[i, i - 1 : i + 1].set(jnp.stack([values[i - 1], -values[i]]))
    return rows


def _anchor(problem: Problem, state: State) -> jaxlie.SE3:
    return jaxlie.SE3(state.poses.wxyz_xyz[jnp.argmax(problem.fixed_pose)])


def _scale(problem: Problem, state: State) -> Float[Array, " camera"]:
    """Return the motion of all camera centres away from the anchor's centre, by 100 %."""
    anchor = _anchor(problem, state).inverse().translation().astype(state.inverse_depth.dtype)
    outward = state.poses.translation() + state.poses.rotation().as_matrix() @ anchor
    return jnp.concatenate([outward, jnp.zeros_like(outward)], 1).reshape(-1)


def rigid_motions(problem: Problem, state: State) -> Float[Array, "n 6 6"]:
    """Return the tangent of each pose by that of a rigid motion in the anchor's frame: `Ad(T_i T_anchor^-1)`."""
    anchor = _anchor(problem, state)
    return lie.adjoint(jax.vmap(lambda pose: lie.relative(anchor, jaxlie.SE3(pose)))(state.poses.wxyz_xyz))
