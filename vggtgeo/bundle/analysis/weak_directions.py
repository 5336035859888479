"""Directions of a problem that may be weakly constrained: named motions of poses and intrinsics to report them, and the
weakest directions of a large map.

Frames of the named motions: common motions of all free keyframes are given in the axes of the anchor, the first held
camera (camera 0 without one), and rotations turn about its centre; motions of one keyframe are in its own camera axes
(x right, y down, z forward), rotations about its own centre. Pitch turns about x, yaw about y, roll about z. All are
left tangents: they move the world before the camera, so the camera itself goes the other way.

The weakest directions of a large map are a few eigenpairs of its sparse information, computed outside `jit`. The
smallest eigenvalues of the balanced information `B` are the largest of `(B + shift)^-1`, which one sparse factor gives
(shift-invert Lanczos: Lehoucq, Sorensen and Yang, "ARPACK Users' Guide", 1998, 3.2). The shift lies far above the
rounding errors of `B`, so that the factor exists, and far below the eigenvalues of interest, so that few steps separate
neighbours. A Rayleigh-Ritz step on `B` itself then restores the digits of eigenvalues below the shift.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import Pinhole
from vggtgeo.solvers.schur_complement import Blocks, SparseLayout

MOTIONS = ("translation along x", "translation along y", "translation along z", "pitch", "yaw", "roll")
"""The names of a tangent's coordinates."""
_INTRINSICS = {
    **{"f": "focal length", "fx": "focal length", "fy": "aspect ratio"},
    **{"cx": "principal point u", "cy": "principal point v"},
}
"""Names of the motions of a camera's parameters, by parameter name; all others are distortion."""
SHIFT = 1e-9
"""With 1e-12 an eigenvalue of 1e-3 is accurate to two digits, with 1e-9 to nine; null directions stay below 1e-15
(loops of 80 to 3,000 keyframes)."""


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
    outward = state.poses.translation() + lie.rotation_matrix(state.poses) @ anchor
    return jnp.concatenate([outward, jnp.zeros_like(outward)], 1).reshape(-1)


def rigid_motions(problem: Problem, state: State) -> Float[Array, "n 6 6"]:
    """Return the tangent of each pose by that of a rigid motion in the anchor's frame: `Ad(T_i T_anchor^-1)`."""
    anchor = _anchor(problem, state)
    return lie.adjoint(jax.vmap(lambda pose: lie.relative(anchor, jaxlie.SE3(pose)))(state.poses.wxyz_xyz))


def sparse_matrix(blocks: Blocks, layout: SparseLayout) -> sp.csr_array:
    """Return the matrix over nodes and shared coordinates, `[c, c]` in double, without the gradient."""
    values, corner = np.asarray(blocks.nodes, float), np.asarray(blocks.corner, float)[:-1, :-1]
    size = layout.nodes * values.shape[-1]
    starts = np.searchsorted(np.asarray(layout.row), np.arange(layout.nodes + 1))
    inner = sp.bsr_array((values, np.asarray(layout.column), starts), shape=(size, size))
    border = sp.csr_array(np.asarray(blocks.border, float)[:, :, :-1].reshape(size, -1))
    whole = sp.block_array([[inner, border], [border.T, sp.csr_array(corner)]], format="csr")
    # Blocks above and below the diagonal are summed in different orders.
    return (whole + whole.T) / 2


def weakest(matrix: sp.csr_array, count: int) -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, "c v"]]:
    """Return the smallest `count` eigenvalues, ascending, and their eigenvectors; all if the matrix has fewer.

    Args:
        matrix: positive semidefinite up to rounding, entries of at most about one.
        count: number of eigenvalues.

    """
    size = matrix.shape[0]
    if size <= 2 * count:
        values, vectors = np.linalg.eigh(matrix.toarray())
        return values[:count], vectors[:, :count]
    factor = definite_factor(matrix + SHIFT * sp.eye_array(size))
    inverse = LinearOperator(matrix.shape, matvec=factor.solve, dtype=float)
    # ARPACK's own start is random; a fixed one makes the result reproducible.
    start = np.random.default_rng(0).normal(size=size)
    found = eigsh(matrix, k=count, sigma=-SHIFT, OPinv=inverse, v0=start)[1]
    basis = np.linalg.qr(found)[0]
    values, turn = np.linalg.eigh(basis.T @ (matrix @ basis))
    return values, basis @ turn


def definite_factor(matrix: sp.csr_array) -> SuperLU:
    """Return a sparse factor of a positive definite matrix, with diagonal pivots only to limit fill-in."""
    return splu(
        sp.csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
