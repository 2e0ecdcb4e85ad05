"""Free-network adjustment of measured series: ball positions in CFCS by weighted least squares, with their covariance.

Unknowns are the balls' positions and each series' pose. A common rigid motion of all of them is unobservable, so the
gauge (six parameters) is fixed by the free-network (inner) constraint: no net shift or rotation against the nominal
frame over its balls. The covariance refers to this gauge: it describes the shape, and no motion of the frame as a
whole.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve, cholesky, solve_triangular
from scipy.spatial.transform import RigidTransform
from scipy.special import chdtri

from sightline.common.checks import FALSE_ALARM
from sightline.common.geometry.rigid import displacement
from sightline.errors import FrameError
from sightline.frame.tables import Series

CONVERGED_MM = 1e-9
MAX_STEPS = 20


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Positions of the N measured balls.

    `ids`; `xyz_mm` (N, 3), CFCS; `covariance_mm2` (3N, 3N); `poses`: of each series, to CFCS; `freedom`: degrees of
    freedom, from repeated measurements; `chi_square`: of the residuals, None without repeats or without stated errors;
    `instrument_mm`: s.d. per axis estimated from the repeats, None without them; `residual_mm`: by series, (n, 3) in
    CFCS; `left_out`: (series, ball) of the outliers; `disputed`: balls that two series measured at different places,
    with no third series to decide.
    """

    ids: tuple[str, ...]
    xyz_mm: np.ndarray
    covariance_mm2: np.ndarray
    poses: tuple[RigidTransform, ...]
    freedom: int
    chi_square: float | None
    instrument_mm: float | None
    residual_mm: dict[str, np.ndarray]
    left_out: tuple[tuple[str, str], ...] = ()
    disputed: tuple[str, ...] = ()


def adjust(
    series: Sequence[Series], poses: Sequence[RigidTransform], nominal_mm: dict[str, tuple[float, float, float]]
) -> Adjusted:
    """Return the least-squares positions; outlying measurements are left out one at a time.

    `poses`: starting values; `nominal_mm`: nominal places of the balls, CFCS, for the inner constraint. Raises
    FrameError where the series do not determine the positions.
    """
    stated = all(each.covariance_mm2 is not None for each in series)
    left_out: list[tuple[str, str]] = []
    used = list(series)
    while True:
        system = _System.of(used, nominal_mm)
        if not stated and system.freedom == 0:
            raise FrameError(
                "the measurements state no error and none was repeated; add a column sd_mm with the error that the "
                "instrument's maker states, or measure a second series"
            )
        solution = _solve(system, poses)
        worst = _worst_outlier(system, solution, stated)
        if worst is None:
            return _result(system, solution, stated, left_out, ())
        place, ball = worst
        if sum(ball in each.ids for each in used) < 3:
            return _result(system, solution, stated, left_out, (ball,))
        left_out.append((used[place].name, ball))
        used[place] = used[place].where(np.array([i != ball for i in used[place].ids]))


@dataclass(frozen=True, eq=False)
class _System:
    """The constant parts of the adjustment. `rows[s]` (n,): indices of the balls of series s among `ids`."""

    series: tuple[Series, ...]
    ids: tuple[str, ...]
    nominal: np.ndarray
    rows: tuple[np.ndarray, ...]

    @staticmethod
    def of(series: Sequence[Series], nominal_mm: dict[str, tuple[float, float, float]]) -> "_System":
        ids = tuple(dict.fromkeys(i for each in series for i in each.ids))
        where = {ball: k for k, ball in enumerate(ids)}
        nominal = np.array([nominal_mm[i] for i in ids])
        rows = tuple(np.array([where[i] for i in each.ids]) for each in series)
        _refuse_apart(series, nominal, rows)
        return _System(tuple(series), ids, nominal, rows)

    def motions(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return (3N, 6): displacements of balls at (N, 3) by a rigid motion about the nominal frame's mean."""
        return displacement(xyz_mm - self.nominal.mean(axis=0)).reshape(-1, 6)

    @property
    def freedom(self) -> int:
        return 3 * sum(map(len, self.rows)) - 3 * len(self.ids) - 6 * len(self.series) + 6


@dataclass(frozen=True, eq=False)
class _Solution:
    """Solution of the normal equations for m observations, CFCS.

    `moved` (3N,): positions minus nominal ones; `design` (m, 3N + 6S); `factor` (m, m): lower Cholesky factor of the
    observations' covariance; `cofactor`: of the unknowns; `residual` (m,).
    """

    moved: np.ndarray
    poses: tuple[RigidTransform, ...]
    design: np.ndarray
    factor: np.ndarray
    cofactor: np.ndarray
    residual: np.ndarray


def _solve(system: _System, poses: Sequence[RigidTransform]) -> _Solution:
    """Return the Gauss-Newton solution for positions and poses. Raises FrameError where it does not converge."""
    n, s = len(system.ids), len(system.series)
    poses, moved = list(poses), np.zeros(3 * n)
    middle = system.nominal.mean(axis=0)
    for _ in range(MAX_STEPS):
        at = [pose.apply(each.xyz_mm) for pose, each in zip(poses, system.series, strict=True)]
        motions = system.motions(system.nominal + moved.reshape(-1, 3))
        design = np.zeros((3 * sum(map(len, at)), 3 * n + 6 * s))
        data = np.concatenate([(q - system.nominal[rows]).ravel() for q, rows in zip(at, system.rows, strict=True)])
        start = 0
        for k, rows in enumerate(system.rows):
            own = slice(start, start + 3 * len(rows))
            unknowns = (3 * rows[:, None] + np.arange(3)).ravel()
            design[range(own.start, own.stop), unknowns] = 1.0
            design[own, 3 * n + 6 * k : 3 * n + 6 * k + 6] = -motions[unknowns]
            start = own.stop
        factor = cholesky(block_diag(*map(_in_cfcs, system.series, poses)), lower=True)
        white = solve_triangular(factor, np.column_stack([design, data]), lower=True)
        cofactor = _constrained_cofactor(white[:, :-1], system.motions(system.nominal), motions)
        unknown = cofactor @ (white[:, :-1].T @ white[:, -1])
        moved, twists = unknown[: 3 * n], unknown[3 * n :].reshape(s, 6)
        if np.abs(motions @ twists.T).max() < CONVERGED_MM:
            return _Solution(moved, tuple(poses), design, factor, cofactor, data - design @ unknown)
        poses = [_twisted(pose, twist, middle) for pose, twist in zip(poses, twists, strict=True)]
    raise FrameError("the series' poses do not converge; check the coordinates for wrong numbers")


def _in_cfcs(series: Series, pose: RigidTransform) -> np.ndarray:
    """Return a series' covariance rotated to CFCS; unit variances where none is stated."""
    n = len(series.ids)
    if series.covariance_mm2 is None:
        return np.eye(3 * n)
    rotation = pose.rotation.as_matrix()
    half = np.einsum("ai,nij->naj", rotation, series.covariance_mm2.reshape(n, 3, -1)).reshape(3 * n, n, 3)
    return np.einsum("mni,ai->mna", half, rotation).reshape(3 * n, 3 * n)


def _twisted(pose: RigidTransform, twist: np.ndarray, about: np.ndarray) -> RigidTransform:
    """Return a pose after a small twist about a point in CFCS."""
    there, back = RigidTransform.from_translation(about), RigidTransform.from_translation(-about)
    return there * RigidTransform.from_exp_coords(twist) * back * pose


def _constrained_cofactor(white: np.ndarray, gauge: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """Return the cofactor of the unknowns under the constraint gauge^T positions = 0, for a whitened design.

    `motions` (3N, 6): the unobservable rigid motions; the poses follow them by the same six parameters.
    """
    normal = white.T @ white
    n = len(gauge)
    unit = gauge / np.linalg.norm(gauge, axis=0)
    fixed = normal.copy()
    fixed[:n, :n] += np.trace(normal[:n, :n]) / n * unit @ unit.T  # any weight: the projection below removes it
    inverse = cho_solve(cho_factor(fixed, lower=True), np.eye(len(normal)))
    unobservable = np.vstack([motions, np.tile(np.eye(6), ((len(normal) - n) // 6, 1))])
    onto = np.eye(len(normal))
    onto[:, :n] -= unobservable @ np.linalg.solve(unit.T @ motions, unit.T)
    return onto @ inverse @ onto.T


def _result(
    system: _System,
    solution: _Solution,
    stated: bool,
    left_out: Sequence[tuple[str, str]],
    disputed: tuple[str, ...],
) -> Adjusted:
    n = len(system.ids)
    white = solve_triangular(solution.factor, solution.residual, lower=True)
    square = float(white @ white)
    repeated = system.freedom > 0
    # The variance itself where no error is stated, otherwise a factor of the stated variances.
    variance = square / system.freedom if repeated else None
    mean_stated = float(np.mean(np.sum(solution.factor**2, axis=1)))
    covariance = solution.cofactor[: 3 * n, : 3 * n] * (1.0 if stated or variance is None else variance)
    parts = np.split(solution.residual.reshape(-1, 3), np.cumsum([len(rows) for rows in system.rows])[:-1])
    return Adjusted(
        ids=system.ids,
        xyz_mm=system.nominal + solution.moved.reshape(-1, 3),
        covariance_mm2=(covariance + covariance.T) / 2,
        poses=solution.poses,
        freedom=system.freedom,
        chi_square=square if stated and repeated else None,
        instrument_mm=None if variance is None else float(np.sqrt(variance * mean_stated)),
        residual_mm={each.name: part for each, part in zip(system.series, parts, strict=True)},
        left_out=tuple(left_out),
        disputed=disputed,
    )


def _worst_outlier(system: _System, solution: _Solution, stated: bool) -> tuple[int, str] | None:
    """Return (series, ball) of the worst outlier by Baarda's test of single residuals; None without an outlier."""
    if system.freedom == 0:
        return None
    half = solve_triangular(solution.factor, solution.design, lower=True)
    inverse = solve_triangular(solution.factor, np.eye(len(solution.factor)), lower=True)
    pull = inverse.T @ (inverse @ solution.residual)  # V^-1 v
    # Precision of the residuals: V^-1 - V^-1 A Q A^T V^-1.
    precision = _blocks(inverse.T) - _blocks(inverse.T @ half @ cholesky(_positive(solution.cofactor), lower=True))
    names = [(k, ball) for k, each in enumerate(system.series) for ball in each.ids]
    repeated = np.array([sum(ball in each.ids for each in system.series) > 1 for _, ball in names])
    square = np.zeros(len(names))
    square[repeated] = [
        v @ np.linalg.solve(p, v) for v, p in zip(pull.reshape(-1, 3)[repeated], precision[repeated], strict=True)
    ]
    if not stated:
        white = inverse @ solution.residual
        square *= system.freedom / (white @ white)
    worst = int(np.argmax(square))
    limit = float(chdtri(3, FALSE_ALARM / len(names)))
    # If all residuals are too large, the stated error is too small: the check "measured series" reports that.
    common = max(1.0, float(np.median(square[repeated])) / float(chdtri(3, 0.5)))
    return names[worst] if square[worst] > limit * common else None


def _positive(matrix: np.ndarray) -> np.ndarray:
    """Return the cofactor made positive definite: the gauge makes six eigenvalues zero, or negative by rounding."""
    return matrix + 1e-12 * np.trace(matrix) / len(matrix) * np.eye(len(matrix))


def _blocks(rows: np.ndarray) -> np.ndarray:
    """Return the diagonal blocks (n, 3, 3) of rows @ rows.T."""
    each = rows.reshape(-1, 3, rows.shape[1])
    return np.einsum("nak,nbk->nab", each, each)


def _refuse_apart(series: Sequence[Series], nominal: np.ndarray, rows: Sequence[np.ndarray]) -> None:
    """Raise FrameError for unconnected series: each must share three balls that are not collinear with the others."""
    joined, waiting = set(rows[0].tolist()), list(range(1, len(series)))
    while waiting:
        fits = [k for k in waiting if _is_broad(nominal[sorted(joined & set(rows[k].tolist()))])]
        if not fits:
            names = ", ".join(series[k].name for k in waiting)
            raise FrameError(
                f"series {names} shares too few balls with the others: measure more balls of the other series too; at "
                "least three that do not lie on one line must be in both, to determine their relative pose"
            )
        for k in fits:
            joined |= set(rows[k].tolist())
            waiting.remove(k)


def _is_broad(points: np.ndarray) -> bool:
    if len(points) < 3:
        return False
    across = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]
    return bool(across / np.sqrt(len(points)) > 1.0)  # [ours] mm rms: twenty times a plate's tolerance; less is a line
