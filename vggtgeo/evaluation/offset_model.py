"""Least-squares model of time offset, lever arm and rotation between an estimate and its ground truth.

The estimate has camera poses `E_i` at times `t_i`; the ground truth is a continuous motion `T(t)` of a point fixed to
the camera. With the alignment A (a similarity), the time offset d to be added to the ground truth's times, and the pose
B of the ground truth's point in the camera frame (lever arm and rotation),

    T(t_i - d) = A E_i B,    residuals  p_T - p_AEB  and  log(R_T R_AEB^T),  in the ground truth's world.

Both residuals have the noise model `DriftNoise`, estimated alternately with the unknowns (D. Cochrane, G. H. Orcutt,
JASA 44, 1949): errors of neighbouring poses are correlated, so that n poses are not n observations. Rotation and lever
arm are a hand-eye calibration: R. Horaud, F. Dornaika, IJRR 14(3), 1995. The solver is in numpy, not `vggtgeo.solve`,
since whitening is O(n) per column, and the second Jacobian Z is not that of any residual.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cholesky_banded, solve_banded
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.evaluation.association import ContinuousTrajectory
from vggtgeo.geometry.gauss_newton import gauss_newton
from vggtgeo.geometry.rigid import cross
from vggtgeo.geometry.trajectory import Trajectory

_CORRELATIONS = (0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.999)
_SHARES = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
UNKNOWNS = 14
"""Translation (3), rotation (3) and scale of A, time offset, position (3) and rotation (3) of B."""
TIME, LEVER, TURN = slice(7, 8), slice(8, 11), slice(11, 14)
MAX_OFFSET = 10.0
"""Maximum time offset of the search, seconds."""
LEVEL = 1e-3
"""Significance level of all tests of offsets."""
_ROUNDS, _STEPS, _HALVINGS = 5, 20, 6
_MIN_STEP = 0.1
"""Seconds between candidates of the search, and of the finite differences for velocities: the motion of a hand-held
camera changes little within this time."""
_MIN_SPREAD = 1e-6
"""Minimum spread of a path: that of a camera that does not move, in a file of six decimals."""
_WEAK_PRIOR, _MIN_GAIN = 10.0, 4.0
"""Prior deviation of the alignment, in spreads of the path; information, in units of the prior's, of a direction that
counts as determined."""
_MAX_POSES, _MAX_SEARCH_POSES = 400, 100
"""Maximum poses of a fit, and of the search: since errors are correlated, more poses hardly improve the accuracy."""


@dataclass(frozen=True)
class DriftNoise:
    """White noise plus a first-order autoregressive drift, and its whitening.

    The error of pose i is `d_i + v_i` with the stationary drift `d_i = c d_(i-1) + w_i` and `var v = share var w`. The
    bidiagonal D with the first row `sqrt(1 - c^2)` whitens the drift; `cov(D x) = var w (I + share D D^T)` is
    tridiagonal, and its Cholesky factor whitens the rest: O(n) for any c and share. Both are estimated by restricted
    maximum likelihood (H. D. Patterson, R. Thompson, Biometrika 58(3), 1971), since a fit of k parameters removes a
    part of the drift from the residuals.

    Fields: sigma, standard deviation of w, in the unit of the errors; correlation, c in [0, 1); share, `var v / var w`.
    White noise has `correlation` and `share` zero.
    """

    sigma: float
    correlation: float = 0.0
    share: float = 0.0

    def whitened(self, rows: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Return `rows` of errors or their derivatives, whitened: unit variance, no correlation."""
        return self._factored(rows)[0]

    def _factored(self, rows: np.ndarray) -> tuple[np.ndarray, float]:
        """Return whitened rows, and the log determinant of the covariance for `sigma` 1."""
        c, first = self.correlation, np.sqrt(1.0 - self.correlation**2)
        white = np.concatenate([first * rows[:1], rows[1:] - c * rows[:-1]])
        band = np.zeros((2, len(rows)))
        band[0] = 1.0 + self.share * (1.0 + c * c)
        band[0, 0] = 1.0 + self.share * first**2
        band[1, :-1] = -self.share * c
        band[1, :1] *= first
        lower = cholesky_banded(band, lower=True)
        determinant = 2.0 * float(np.log(lower[0]).sum()) - 2.0 * float(np.log(first))
        return solve_banded((1, 0), lower, white) / self.sigma, determinant

    @classmethod
    def of(
        cls, errors: Float[np.ndarray, "n 3"], jacobian: Float[np.ndarray, "n 3 k"], min_sigma: float
    ) -> "DriftNoise":
        """Return the most likely noise for the residuals of a fit with this `jacobian`; `min_sigma`: rounding error."""
        count, unknowns = len(errors), jacobian.shape[2]
        kinds = [cls(1.0), *(cls(1.0, c, share) for c in _CORRELATIONS for share in _SHARES)]
        rows = np.concatenate([errors, jacobian.reshape(count, -1)], axis=1)
        degrees = max(3 * count - unknowns, 1)
        best = np.inf, kinds[0]
        for kind in kinds:
            white, determinant = kind._factored(rows)
            variance = max(float((white[:, :3] ** 2).sum()) / degrees, min_sigma**2)
            matrix = white[:, 3:].reshape(3 * count, unknowns)
            # The restricted likelihood's term for the fitted parameters.
            information = np.linalg.slogdet(matrix.T @ matrix + 1e-12 * np.eye(unknowns))[1]
            cost = degrees * np.log(variance) + 3.0 * determinant + information
            best = min(best, (cost, cls(np.sqrt(variance), kind.correlation, kind.share)), key=lambda one: one[0])
        return best[1]


Noises = tuple[DriftNoise, DriftNoise]


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Values of all unknowns. rotation, translation, scale: of A. time: d, seconds. lever, turn: position and rotation
    of B, that is of the ground truth's point in the camera frame; lengths are in the unit of the ground truth.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    scale: float
    time: float
    lever: Float[np.ndarray, "3"]
    turn: Float[np.ndarray, "3 3"]

    @property
    def offsets(self) -> Float[np.ndarray, "14"]:
        """Time offset, lever arm and rotation vector, in the order of the unknowns; zero for the alignment."""
        rotation = Rotation.from_matrix(self.turn).as_rotvec()
        return np.concatenate([np.zeros(TIME.start), [self.time], self.lever, rotation])

    def retracted(self, step: Float[np.ndarray, "14"], middle: Float[np.ndarray, "3"]) -> "Unknowns":
        """Apply a step of all unknowns; the alignment rotates and scales about `middle` in the ground truth's world."""
        turn, growth = Rotation.from_rotvec(step[3:6]).as_matrix(), float(np.exp(step[6]))
        return Unknowns(
            turn @ self.rotation,
            middle + step[:3] + growth * turn @ (self.translation - middle),
            growth * self.scale,
            self.time + float(step[7]),
            self.lever + step[LEVER],
            Rotation.from_rotvec(step[TURN]).as_matrix() @ self.turn,
        )


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit.

    Fields: unknowns, of which those in `free` are estimated; covariance, float64 [14, 14], of a step of the unknowns;
    determined, which of them the motion determines; noise, of positions and rotations; degrees, of freedom;
    rotation_error, RMS, radians.
    """

    unknowns: Unknowns
    free: Bool[np.ndarray, "14"]
    covariance: Float[np.ndarray, "14 14"]
    determined: Bool[np.ndarray, "14"]
    noise: tuple[DriftNoise, DriftNoise]
    degrees: int
    rotation_error: float


class OffsetModel:
    """The model of one pair of trajectories. estimate: camera -> world; truth: covers some of its times."""

    def __init__(self, estimate: Trajectory, truth: ContinuousTrajectory) -> None:
        self._truth = truth
        rows = np.arange(0, len(estimate), -(-len(estimate) // _MAX_POSES))
        times = estimate.timestamps
        # The poses on both sides of each row give its velocity by finite differences.
        before = np.minimum(np.searchsorted(times, times[rows] - _MIN_STEP, side="right") - 1, rows - 1)
        after = np.maximum(np.searchsorted(times, times[rows] + _MIN_STEP), rows + 1)
        self._sides = np.maximum(before, 0), np.minimum(after, len(times) - 1)
        self._all, self._rows, self._times = estimate, rows, times[rows]
        self._every = -(-len(rows) // _MAX_SEARCH_POSES)
        true = truth.poses(self._times[self._seen(0.0)])[:, :3, 3]
        self._middle = true.mean(axis=0)
        spread = max(float(np.sqrt(((true - self._middle) ** 2).sum(axis=1).mean())), _MIN_SPREAD)
        # Standard deviations of the prior: wide for the alignment; the range of the search for the time offset, the
        # spread of the path for the lever arm, a radian for the rotation.
        prior = [_WEAK_PRIOR * spread] * 3 + [_WEAK_PRIOR] * 4 + [MAX_OFFSET] + [spread] * 3 + [1.0] * 3
        self._prior = np.array(prior)
        self._min_sigma = 1e-6 * spread, 1e-6  # pose files have six decimals or more

    def matched(self, time: float) -> int:
        """Return the number of poses within the ground truth at this time offset."""
        return int(self._seen(time).sum())

    def search(self) -> tuple[float, int]:
        """Return the best time offset for positions and rotations, and the number of candidates.

        Candidates are at most `MAX_OFFSET`, and match at least half as many poses as the candidate with most matches.
        """
        step = max(float(np.median(np.diff(self._all.timestamps))), _MIN_STEP)
        count = int(MAX_OFFSET / step)
        grid = step * np.arange(-count, count + 1)
        seen = np.array([self.matched(time) for time in grid])
        tried = grid[seen >= 0.5 * seen.max()]
        costs = [self._misfit(time) for time in tried]
        return float(tried[np.argmin(costs)]), len(tried)

    def fit(self, free: Bool[np.ndarray, "14"], *times: float) -> Fit:
        """Fit the `free` unknowns, alternating with the noise; the time offset starts from 0 and from `times`."""
        starts = [
            self._solved(start, free, self._white(self._residuals(start)))
            for time in {0.0, *times}
            for start in self._starts(time, free)
        ]
        unknowns = min(starts, key=lambda one: sum(np.log(part.sigma) for part in self._white(self._residuals(one))))
        noise = self._noise(unknowns, free)
        for _ in range(_ROUNDS):
            unknowns, before = self._solved(unknowns, free, noise), noise
            noise = self._noise(unknowns, free)
            if [(one.correlation, one.share) for one in noise] == [(one.correlation, one.share) for one in before]:
                break
        return self._fitted(unknowns, free, noise)

    def refit(self, fit: Fit, free: Bool[np.ndarray, "14"]) -> Fit:
        """Fit the `free` unknowns, with the others zero, and the noise of `fit`."""
        time = float(fit.unknowns.time) if free[TIME].all() else 0.0
        starts = [self._solved(start, free, fit.noise) for start in self._starts(time, free)]
        cost = lambda one: np.mean(self._whitened(self._residuals(one), fit.noise) ** 2)
        return self._fitted(min(starts, key=cost), free, fit.noise)

    def _fitted(self, unknowns: Unknowns, free: np.ndarray, noise: Noises) -> Fit:
        unknowns = self._balanced(unknowns, free, noise)
        covariance, determined = self._covariance(unknowns, free, noise)
        residuals = self._residuals(unknowns)
        error = float(np.sqrt((residuals[:, 3:] ** 2).sum(axis=1).mean()))
        return Fit(unknowns, free, covariance, determined, noise, residuals.size - int(free.sum()), error)

    def _seen(self, time: float) -> np.ndarray:
        return self._truth.covers(self._times - time)

    def _pair(self, time: float, every: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Return poses of the estimate and of the ground truth at the same times."""
        chosen = np.flatnonzero(self._seen(time))[::every]
        return self._all.poses[self._rows[chosen]], self._truth.poses(self._times[chosen] - time)

    def _misfit(self, time: float) -> float:
        found, true = self._pair(time, self._every)
        moved = umeyama(found[:, :3, 3], true[:, :3, 3], True).points(found[:, :3, 3])
        position = ((moved - true[:, :3, 3]) ** 2).sum(axis=1).mean()
        rotation = _turn_of_steps(found[:, :3, :3], true[:, :3, :3])[1]
        return float(np.log(position + self._min_sigma[0] ** 2) + np.log(rotation + self._min_sigma[1] ** 2))

    def _starts(self, time: float, free: np.ndarray) -> Iterator[Unknowns]:
        """Return initial values from positions, and from rotations, which are better for a straight path or a long
        lever arm.
        """
        found, true = self._pair(time)
        turned, turns = true[:, :3, :3], bool(free[TURN].all())
        by_positions = umeyama(found[:, :3, 3], true[:, :3, 3], True).rotation
        own = _turn_of_steps(found[:: self._every, :3, :3], turned[:: self._every])[0] if turns else np.eye(3)
        by_rotations = _mean(turned @ own.T @ found[:, :3, :3].mT)
        for rotation in (by_positions, by_rotations):
            cameras = rotation @ found[:, :3, :3]
            turn = _mean(cameras.mT @ turned) if turns else np.eye(3)
            yield self._placed(rotation, turn, time, found, true, bool(free[LEVER].all()))

    def _placed(
        self, rotation: np.ndarray, turn: np.ndarray, time: float, found: np.ndarray, true: np.ndarray, lever: bool
    ) -> Unknowns:
        """Solve for scale, translation and lever arm, a linear problem for given rotations."""
        along = found[:, :3, 3] @ rotation.T
        columns = [np.broadcast_to(np.eye(3), (len(found), 3, 3))]
        columns += [rotation @ found[:, :3, :3]] if lever else []
        columns += [along[..., None]]
        matrix = np.concatenate(columns, axis=2).reshape(3 * len(found), -1)
        solved = np.linalg.lstsq(matrix, true[:, :3, 3].reshape(-1), rcond=1e-3)[0]
        scale = float(solved[-1]) if solved[-1] > 0 else 1.0
        return Unknowns(rotation, solved[:3], scale, time, solved[3:6] if lever else np.zeros(3), turn)

    def _solved(self, unknowns: Unknowns, free: np.ndarray, noise: Noises) -> Unknowns:
        """Return the solution of `J^T r = 0` by Gauss-Newton."""

        def evaluate(unknowns: Unknowns) -> tuple[float, Callable[[], np.ndarray]]:
            if self.matched(unknowns.time) < 2:
                return np.inf, lambda: np.zeros(UNKNOWNS)
            residuals = self._whitened(self._residuals(unknowns), noise)
            return float(np.mean(residuals**2)), lambda: self._step(unknowns, residuals, free, noise)

        retract = lambda unknowns, step: unknowns.retracted(step * self._prior * free, self._middle)
        return gauss_newton(unknowns, evaluate, retract, steps=_STEPS, trials=_HALVINGS)

    def _step(self, unknowns: Unknowns, residuals: np.ndarray, free: np.ndarray, noise: Noises) -> np.ndarray:
        jacobian = self._whitened(self._jacobian(unknowns), noise) * (self._prior * free)
        # The identity is the information of the prior: it keeps undetermined directions unchanged.
        normal = jacobian.T @ jacobian + np.eye(UNKNOWNS)
        size = 1.0 / np.sqrt(np.diag(normal))
        inverse = np.linalg.pinv(normal * np.outer(size, size), rcond=1e-13, hermitian=True)
        return np.asarray(-size * (inverse @ (size * (jacobian.T @ residuals))))

    def _predicted(self, unknowns: Unknowns, poses: np.ndarray) -> np.ndarray:
        found = poses.copy()
        found[:, :3, :3] = unknowns.rotation @ poses[:, :3, :3]
        found[:, :3, 3] = unknowns.scale * poses[:, :3, 3] @ unknowns.rotation.T + unknowns.translation
        found[:, :3, 3] += found[:, :3, :3] @ unknowns.lever
        found[:, :3, :3] = found[:, :3, :3] @ unknowns.turn
        return found

    def _residuals(self, unknowns: Unknowns) -> np.ndarray:
        found, true = self._pair(unknowns.time)
        made = self._predicted(unknowns, found)
        turned = Rotation.from_matrix(true[:, :3, :3] @ made[:, :3, :3].mT).as_rotvec()
        return np.concatenate([true[:, :3, 3] - made[:, :3, 3], turned], axis=1)

    def _jacobian(self, unknowns: Unknowns) -> np.ndarray:
        """Return derivatives of the residuals, float64 [n, 6, 14]."""
        seen = self._seen(unknowns.time)
        made = self._predicted(unknowns, self._all.poses[self._rows[seen]])
        return self._columns(unknowns, made, self._truth.velocities(self._times[seen] - unknowns.time))

    def _other_jacobian(self, unknowns: Unknowns) -> np.ndarray:
        """Return the Jacobian with the trajectories exchanged: equal motion, independent noise (an instrument, see
        `_covariance`).
        """
        seen = self._seen(unknowns.time)
        before, after = (self._predicted(unknowns, self._all.poses[side[seen]]) for side in self._sides)
        seconds = np.subtract(*(self._all.timestamps[side[seen]] for side in self._sides[::-1]))
        turned = Rotation.from_matrix(after[:, :3, :3] @ before[:, :3, :3].mT).as_rotvec()
        motion = np.concatenate([after[:, :3, 3] - before[:, :3, 3], turned], axis=1)
        true = self._truth.poses(self._times[seen] - unknowns.time)
        return self._columns(unknowns, true, motion / seconds[:, None])

    def _columns(self, unknowns: Unknowns, body: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return the Jacobian for poses and velocities of the ground truth's point.

        The Jacobian of the logarithm is approximated by the identity, as for small residuals.
        """
        camera = body[:, :3, :3] @ unknowns.turn.T
        arm = body[:, :3, 3] - self._middle
        found = np.zeros((len(body), 6, UNKNOWNS))
        found[:, :3, :3] = found[:, 3:, 3:6] = -np.eye(3)
        found[:, :3, 3:6] = -cross(np.eye(3)[None], arm[:, None]).mT
        found[:, :3, 6] = -(arm - camera @ unknowns.lever)
        found[:, :, 7] = -velocity
        found[:, :3, LEVER] = found[:, 3:, TURN] = -camera
        return found

    def _whitened(self, rows: np.ndarray, noise: Noises) -> np.ndarray:
        """Whiten residuals or a Jacobian [n, 6, ...]."""
        parts = [
            one.whitened(part.reshape(len(part), -1)).reshape(3 * len(part), *part.shape[2:])
            for one, part in zip(noise, (rows[:, :3], rows[:, 3:]), strict=True)
        ]
        return np.concatenate(parts)

    def _white(self, residuals: np.ndarray) -> Noises:
        """Return white noise with the RMS of the residuals."""
        parts = zip((residuals[:, :3], residuals[:, 3:]), self._min_sigma, strict=True)
        first, second = (DriftNoise(max(float(np.sqrt(np.mean(part**2))), sigma)) for part, sigma in parts)
        return first, second

    def _noise(self, unknowns: Unknowns, free: np.ndarray) -> Noises:
        residuals, jacobian = self._residuals(unknowns), self._jacobian(unknowns)[:, :, free] * self._prior[free]
        parts = zip((slice(0, 3), slice(3, 6)), self._min_sigma, strict=True)
        first, second = (DriftNoise.of(residuals[:, part], jacobian[:, part], sigma) for part, sigma in parts)
        return first, second

    def _scaled(self, unknowns: Unknowns, free: np.ndarray, noise: Noises) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return both Jacobians J and Z, whitened, in units of the prior, along a basis of the determined directions.

        A direction is determined if `Z^T J` has four times the information of the prior (half its standard deviation),
        and more than two independent noises have by chance.
        """
        jacobians = self._jacobian(unknowns), self._other_jacobian(unknowns)
        own, other = (self._whitened(one, noise) * (self._prior * free) for one in jacobians)
        values, vectors = np.linalg.eigh(0.5 * (other.T @ own + own.T @ other))
        lengths = np.sqrt(((own @ vectors) ** 2).sum(axis=0) * ((other @ vectors) ** 2).sum(axis=0))
        chance = -ndtri(LEVEL / 2) / np.sqrt(0.5 * len(own))
        basis = vectors[:, (values > _MIN_GAIN) & (values > chance * lengths)]
        return own @ basis, other @ basis, basis

    def _balanced(self, unknowns: Unknowns, free: np.ndarray, noise: Noises) -> Unknowns:
        """Return the solution of `Z^T r = 0` (instrumental variables, see `_covariance`), starting from that of `J^T r
        = 0`.

        The solution of `J^T r = 0` is biased: interpolation reduces the ground truth's noise between its poses, and
        noisy rotations shorten the lever arm.
        """
        size = np.inf
        for _ in range(_STEPS):
            own, other, basis = self._scaled(unknowns, free, noise)
            residuals = self._whitened(self._residuals(unknowns), noise)
            step = -basis @ np.linalg.lstsq(other.T @ own, other.T @ residuals, rcond=None)[0]
            updated = unknowns.retracted(step * self._prior, self._middle)
            if not np.linalg.norm(step) < 0.5 * size or self.matched(updated.time) < 2:
                return unknowns
            unknowns, size = updated, float(np.linalg.norm(step))
        return unknowns

    def _covariance(self, unknowns: Unknowns, free: np.ndarray, noise: Noises) -> tuple[np.ndarray, np.ndarray]:
        """Return the covariance of the solution of `Z^T r = 0`: `(Z^T J)^-1 Z^T Z (Z^T J)^-T`.

        J and Z are the Jacobians of the two trajectories. Their noises are independent, so that `Z^T J` contains motion
        only. In undetermined directions it is the covariance of the prior.
        """
        own, other, basis = self._scaled(unknowns, free, noise)
        gain = basis @ np.linalg.pinv(other.T @ own, rcond=1e-18)
        covariance = gain @ (other.T @ other) @ gain.T + np.eye(UNKNOWNS) - basis @ basis.T
        return covariance * np.outer(self._prior, self._prior), free & (np.diag(covariance) < 1.0 / _MIN_GAIN)


def _mean(rotations: np.ndarray) -> np.ndarray:
    return np.asarray(Rotation.from_matrix(rotations).mean().as_matrix())


def _turn_of_steps(found: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the rotation of the ground truth's body in the camera frame, and the mean square residual, rad^2.

    It follows from the rotation vectors between successive poses, which do not depend on an alignment (W. Kabsch, Acta
    Cryst. A 32, 1976).
    """
    camera, body = (Rotation.from_matrix(one[:-1].mT @ one[1:]).as_rotvec() for one in (found, true))
    u, _, vt = np.linalg.svd(camera.T @ body)
    turn = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return turn, float(((camera - body @ turn.T) ** 2).sum(axis=1).mean())
