"""Measured series brought together: ball positions in CFCS by weighted least squares, with their covariance.

Unknown are the balls' positions and each series' pose. Poses and positions are free of each other, so six numbers are a
matter of choice (the gauge): of all solutions the one is taken that neither shifts nor turns against the nominal frame,
summed over its balls. The covariance is that of this choice: it holds the shape, and no motion of the frame as a whole.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve, cholesky, solve_triangular
from scipy.spatial.transform import RigidTransform
from scipy.special import chdtri

from sightline.errors import FrameError
from sightline.frame.measurements import Series
from sightline.geometry.rigid import displacement

FALSE_ALARM = 1e-4  # [ours] per frame, as for beads in images (calibration/outliers.py)
CONVERGED_MM = 1e-9
MAX_STEPS = 20


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Positions of the N measured balls.

    `ids`; `xyz_mm` (N, 3) CFCS; `covariance_mm2` (3N, 3N); `poses`: of each series, to CFCS; `freedom`: how many
    numbers repeats leave to test by; `chi_square`: of the residuals over what is stated, None without repeats or
    where nothing is stated; `instrument_mm`: s.d. per axis as the repeats show it, None without them; `residual_mm`: by
    series, (n, 3) in CFCS; `left_out`: (series, ball) that contradict the others; `disputed`: balls that two series see
    at different places, and no third tells which.
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
    """The least-squares positions; measurements that contradict the others are left out one at a time.

    `nominal_mm`: where the balls should be, CFCS: the gauge. Raises FrameError where the series do not determine them.
    """
    stated = all(one.covariance_mm2 is not None for one in series)
    left_out: list[tuple[str, str]] = []
    used = list(series)
    while True:
        system = _System.of(used, nominal_mm)
        if not stated and system.freedom == 0:
            raise FrameError(
                "no error of the measurements is stated and none was repeated; add a column sd_mm with what the "
                "instrument's maker states, or measure a second series"
            )
        solution = _solve(system, poses)
        worst = _worst(system, solution, stated)
        if worst is None:
            return _result(system, solution, stated, left_out, ())
        place, ball = worst
        if sum(ball in one.ids for one in used) < 3:
            return _result(system, solution, stated, left_out, (ball,))
        left_out.append((used[place].name, ball))
        used[place] = used[place].where(np.array([i != ball for i in used[place].ids]))


@dataclass(frozen=True, eq=False)
class _System:
    """What does not change while the poses settle. `rows[s]` (n,): balls of series s among `ids`."""

    series: tuple[Series, ...]
    ids: tuple[str, ...]
    nominal: np.ndarray
    rows: tuple[np.ndarray, ...]

    @staticmethod
    def of(series: Sequence[Series], nominal_mm: dict[str, tuple[float, float, float]]) -> "_System":
        ids = tuple(dict.fromkeys(i for one in series for i in one.ids))
        where = {ball: k for k, ball in enumerate(ids)}
        nominal = np.array([nominal_mm[i] for i in ids])
        rows = tuple(np.array([where[i] for i in one.ids]) for one in series)
        _refuse_apart(series, nominal, rows)
        return _System(tuple(series), ids, nominal, rows)

    def motions(self, xyz_mm: np.ndarray) -> np.ndarray:
        """(3N, 6): how balls at (N, 3) move with the frame as a whole, about its middle."""
        return displacement(xyz_mm - self.nominal.mean(axis=0)).reshape(-1, 6)

    @property
    def freedom(self) -> int:
        return 3 * sum(map(len, self.rows)) - 3 * len(self.ids) - 6 * len(self.series) + 6


@dataclass(frozen=True, eq=False)
class _Solution:
    """`design` (m, 3N + 6S) and `factor` (m, m, lower, of the observations' covariance), CFCS; `cofactor`: of the
    unknowns; `residual` (m,)."""

    moved: np.ndarray
    poses: tuple[RigidTransform, ...]
    design: np.ndarray
    factor: np.ndarray
    cofactor: np.ndarray
    residual: np.ndarray


def _solve(system: _System, poses: Sequence[RigidTransform]) -> _Solution:
    """Gauss-Newton over positions and poses."""
    n, s = len(system.ids), len(system.series)
    poses, moved = list(poses), np.zeros(3 * n)
    middle = system.nominal.mean(axis=0)
    for _ in range(MAX_STEPS):
        at = [pose.apply(one.xyz_mm) for pose, one in zip(poses, system.series, strict=True)]
        motions = system.motions(system.nominal + moved.reshape(-1, 3))
        design = np.zeros((3 * sum(map(len, at)), 3 * n + 6 * s))
        data = np.concatenate([(q - system.nominal[rows]).ravel() for q, rows in zip(at, system.rows, strict=True)])
        start = 0
        for k, rows in enumerate(system.rows):
            mine = slice(start, start + 3 * len(rows))
            unknowns = (3 * rows[:, None] + np.arange(3)).ravel()
            design[range(mine.start, mine.stop), unknowns] = 1.0
            design[mine, 3 * n + 6 * k : 3 * n + 6 * k + 6] = -motions[unknowns]
            start = mine.stop
        factor = cholesky(block_diag(*map(_in_cfcs, system.series, poses)), lower=True)
        white = solve_triangular(factor, np.column_stack([design, data]), lower=True)
        cofactor = _bordered(white[:, :-1], system.motions(system.nominal), motions)
        unknown = cofactor @ (white[:, :-1].T @ white[:, -1])
        moved, twists = unknown[: 3 * n], unknown[3 * n :].reshape(s, 6)
        if np.abs(motions @ twists.T).max() < CONVERGED_MM:
            return _Solution(moved, tuple(poses), design, factor, cofactor, data - design @ unknown)
        poses = [_turned(pose, twist, middle) for pose, twist in zip(poses, twists, strict=True)]
    raise FrameError("the series' poses do not settle; check the coordinates for wrong numbers")


def _in_cfcs(series: Series, pose: RigidTransform) -> np.ndarray:
    """A series' covariance turned into CFCS; unit variances where none is stated."""
    n = len(series.ids)
    if series.covariance_mm2 is None:
        return np.eye(3 * n)
    turn = pose.rotation.as_matrix()
    half = np.einsum("ai,nij->naj", turn, series.covariance_mm2.reshape(n, 3, -1)).reshape(3 * n, n, 3)
    return np.einsum("mni,ai->mna", half, turn).reshape(3 * n, 3 * n)


def _turned(pose: RigidTransform, twist: np.ndarray, about: np.ndarray) -> RigidTransform:
    """A pose after a small twist about a point of CFCS."""
    there, back = RigidTransform.from_translation(about), RigidTransform.from_translation(-about)
    return there * RigidTransform.from_exp_coords(twist) * back * pose


def _bordered(white: np.ndarray, gauge: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """Cofactor of the unknowns under gauge^T positions = 0, for a whitened design.

    `motions` (3N, 6): what no measurement sees; the poses follow it by the same six numbers.
    """
    normal = white.T @ white
    n = len(gauge)
    unit = gauge / np.linalg.norm(gauge, axis=0)
    fixed = normal.copy()
    fixed[:n, :n] += np.trace(normal[:n, :n]) / n * unit @ unit.T  # a weight of any size: the next step takes it out
    inverse = cho_solve(cho_factor(fixed, lower=True), np.eye(len(normal)))
    unseen = np.vstack([motions, np.tile(np.eye(6), ((len(normal) - n) // 6, 1))])
    onto = np.eye(len(normal))
    onto[:, :n] -= unseen @ np.linalg.solve(unit.T @ motions, unit.T)
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
    # A variance where no error is stated, else a factor of the stated ones.
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
        residual_mm={one.name: part for one, part in zip(system.series, parts, strict=True)},
        left_out=tuple(left_out),
        disputed=disputed,
    )


def _worst(system: _System, solution: _Solution, stated: bool) -> tuple[int, str] | None:
    """(series, ball) of the measurement that contradicts the others most, by Baarda's test of single residuals; None
    where all are within what chance gives."""
    if system.freedom == 0:
        return None
    half = solve_triangular(solution.factor, solution.design, lower=True)
    inverse = solve_triangular(solution.factor, np.eye(len(solution.factor)), lower=True)
    pull = inverse.T @ (inverse @ solution.residual)  # V^-1 v
    whole, taken = inverse.T, inverse.T @ half @ cholesky(_positive(solution.cofactor), lower=True)
    precision = _blocks(whole) - _blocks(taken)
    names = [(k, ball) for k, one in enumerate(system.series) for ball in one.ids]
    repeated = np.array([sum(ball in one.ids for one in system.series) > 1 for _, ball in names])
    square = np.zeros(len(names))
    square[repeated] = [
        v @ np.linalg.solve(p, v) for v, p in zip(pull.reshape(-1, 3)[repeated], precision[repeated], strict=True)
    ]
    if not stated:
        white = inverse @ solution.residual
        square *= system.freedom / (white @ white)
    worst = int(np.argmax(square))
    limit = float(chdtri(3, FALSE_ALARM / len(names)))
    # Where all residuals are too large, the error stated is too small: that is for the check of the series to say.
    common = max(1.0, float(np.median(square[repeated])) / float(chdtri(3, 0.5)))
    return names[worst] if square[worst] > limit * common else None


def _positive(matrix: np.ndarray) -> np.ndarray:
    """Six directions of the cofactor are zero by the gauge; rounding may put them below."""
    return matrix + 1e-12 * np.trace(matrix) / len(matrix) * np.eye(len(matrix))


def _blocks(rows: np.ndarray) -> np.ndarray:
    """(n, 3, 3) diagonal blocks of rows @ rows.T."""
    each = rows.reshape(-1, 3, rows.shape[1])
    return np.einsum("nak,nbk->nab", each, each)


def _refuse_apart(series: Sequence[Series], nominal: np.ndarray, rows: Sequence[np.ndarray]) -> None:
    """Refuse series that do not hang together: each must share three balls, not on a line, with the others."""
    joined, waiting = set(rows[0].tolist()), list(range(1, len(series)))
    while waiting:
        fits = [k for k in waiting if _spread(nominal[sorted(joined & set(rows[k].tolist()))])]
        if not fits:
            names = ", ".join(series[k].name for k in waiting)
            raise FrameError(
                f"series {names} shares too few balls with the others; three that are not on a line must be in both, "
                "or nothing tells how the two lie to each other: measure more of the balls of the other series too"
            )
        for k in fits:
            joined |= set(rows[k].tolist())
            waiting.remove(k)


def _spread(points: np.ndarray) -> bool:
    if len(points) < 3:
        return False
    across = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]
    return bool(across / np.sqrt(len(points)) > 1.0)  # [ours] mm: less is a line, to what a frame is built
