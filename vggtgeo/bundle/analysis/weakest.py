"""The weakest directions of a large map: a few eigenpairs of its sparse information, outside `jit`.

The smallest eigenvalues of the balanced information `B` are the largest of `(B + shift)^-1`, which one sparse factor
gives (shift-invert Lanczos: Lehoucq, Sorensen and Yang, "ARPACK Users' Guide", 1998, 3.2). The shift lies far above the
rounding errors of `B`, so that the factor exists, and far below the eigenvalues of interest, so that few steps separate
neighbours. A Rayleigh-Ritz step on `B` itself then restores the digits of eigenvalues below the shift.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu

from vggtgeo.solvers.schur_complement import Blocks, SparseLayout

SHIFT = 1e-9
"""With 1e-12 an eigenvalue of 1e-3 is accurate to two digits, with 1e-9 to nine; null directions stay below 1e-15
(loops of 80 to 3,000 keyframes)."""


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
