"""What the picks of points show beyond the points: distances between lines of sight, and a bone that moved.

A point seen in V views has 2V residuals and three unknowns. The other 2V - 3 combinations of its residuals, one less
for each snapped pick, have the mean zero wherever the point lies. With two views this is one number, the signed
distance between the two lines of sight.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import chndtrinc, gammaincc, ndtri

from sightline.common.geometry.covariance import ellipsoid_factor
from sightline.common.geometry.lines import cross, unit
from sightline.planning.points.solution import Solution, inverse

# Correct plans exceed a limit by chi-square once in a thousand [ours]. More often people would learn to ignore it; more
# rarely, larger errors would pass.
MIN_PROBABILITY = 1e-3
CONFIDENCE = 1 - MIN_PROBABILITY
_POWER = 0.95  # probability with which the stated movement is detected, as that of every stated region [ours]
# A shift known worse than this is not counted as shown [ours]; perspective shows one along a beam to 4 mm [calc].
_MAX_SD_MM = 3.0


@dataclass(frozen=True, eq=False)
class Movement:
    """What the points seen in three or more views show of shifts of the bone between the images.

    `chi2` with `freedom` degrees of freedom: of the shifts that the points show. `information` (V - 1, 3, 3), 1/mm²:
    about one shift, CFCS, before the second, third, ..., last image. `shown` (V,): how many of the tested points each
    image shows. `redundancy`: redundant residuals of all points, the degrees of freedom of `SpacePoints.gap_chi2`.
    """

    chi2: float
    freedom: int
    information: np.ndarray
    shown: np.ndarray
    redundancy: int

    @property
    def limit(self) -> float:
        """The chi-square that a bone at rest exceeds once in a thousand plans."""
        return ellipsoid_factor(CONFIDENCE, self.freedom) ** 2

    @property
    def noticed_mm(self) -> np.ndarray:
        """(V - 1, 3): for one shift before each image the lengths detected with a probability of 95 %, in three
        perpendicular directions, the smallest first; inf in a direction that does not show it."""
        needed = chndtrinc(self.limit, self.freedom, 1.0 - _POWER)
        values = np.linalg.eigvalsh(self.information)[:, ::-1]
        shown = values > _MAX_SD_MM**-2
        return np.sqrt(np.divide(needed, values, out=np.full_like(values, np.inf), where=shown))


@dataclass(frozen=True, eq=False)
class Gaps:
    """The redundant residuals of N points: Q values with the mean zero.

    `point` (Q,): the point of each; `values` (Q,), mm: for a point seen in two views the signed distance between its
    lines of sight; `rows` (Q, 2V): takes the residuals of its point to the value; `covariance_mm2` (Q, Q).
    """

    point: np.ndarray
    values: np.ndarray
    rows: np.ndarray
    covariance_mm2: np.ndarray

    @staticmethod
    def of(solution: Solution) -> "Gaps | None":
        """Return the redundant residuals; None where a view's error is unknown."""
        if solution.covariances is None:
            return None
        parts = [*_of_pairs(solution), *_of_more(solution)]
        point, values, rows = (np.concatenate(part) for part in zip(*parts, strict=True))
        order = np.argsort(point, kind="stable")
        point, values, rows = point[order], values[order], rows[order]
        total = np.sum(list(solution.covariances.values()), axis=0)
        own = np.take(total[point], point, axis=2)
        return Gaps(point, values, rows, np.einsum("ip,ipjq,jq->ij", rows, own, rows))

    def sigma(self, gap_mm: np.ndarray) -> np.ndarray:
        """Return (N,): for one residual `gap_mm` over its s.d.; for more the number of s.d. of a normal distribution
        that is exceeded as rarely as their chi-square. NaN without a residual."""
        sigma = np.full(len(gap_mm), np.nan)
        count = np.bincount(self.point, minlength=len(gap_mm))
        single = count[self.point] == 1
        at = self.point[single]
        sigma[at] = gap_mm[at] / np.sqrt(np.diag(self.covariance_mm2)[single])
        for i in np.flatnonzero(count > 1):
            rows = self.point == i
            square = self.values[rows] @ inverse(self.covariance_mm2[np.ix_(rows, rows)]) @ self.values[rows]
            tail = gammaincc(count[i] / 2.0, square / 2.0)
            # Where the probability underflows, the root of the chi-square is a little too large: far beyond any limit.
            sigma[i] = abs(ndtri(tail / 2.0)) if tail > 0.0 else np.sqrt(square)
        return sigma

    def mean(self) -> tuple[float, float, float]:
        """Return the weighted mean of the values, mm, its standard deviation, and the chi-square of all values.

        Raises ReconstructionRefusedError for a singular covariance.
        """
        information = inverse(self.covariance_mm2)
        weights = information.sum(axis=0)
        mean, sd = float(weights @ self.values / weights.sum()), float(1.0 / np.sqrt(weights.sum()))
        return mean, sd, float(self.values @ information @ self.values)

    def movement(self, solution: Solution) -> Movement:
        """Return what the values show of shifts of the bone between the images.

        Parallel beams would show 2V - 3 combinations of the 3V - 3 shifts; the others, which perspective shows faintly,
        are not tested. Raises ReconstructionRefusedError for a singular covariance.
        """
        count, views = len(self.values), len(solution.lines)
        information = inverse(self.covariance_mm2)
        by_view = self.rows.reshape(count, views, 2), solution.to_point[self.point].reshape(count, views, 2, 3)
        by_shift = np.einsum("qkp,qkpa->qka", *by_view).reshape(count, 3 * views)
        known, vectors = np.linalg.eigh(by_shift.T @ information @ by_shift)
        kept = np.flatnonzero(known > _MAX_SD_MM**-2)[-(2 * views - 3) :]
        known, vectors = known[kept], vectors[:, kept]
        score = vectors.T @ by_shift.T @ information @ self.values
        later = [np.kron((np.arange(views) >= k)[:, None], np.eye(3)) for k in range(1, views)]
        return Movement(
            chi2=float((score**2 / known).sum()),
            freedom=len(kept),
            information=np.array([(shift.T @ vectors * known) @ (vectors.T @ shift) for shift in later]),
            shown=solution.picks.seen[:, np.unique(self.point)].sum(axis=1),
            redundancy=count,
        )


def gap_mm(solution: Solution) -> np.ndarray:
    """Return (N,) the distance between the lines of sight of each point, the largest of all pairs of views.

    Pairs nearly parallel do not count: they approach each other far from the point.
    """
    largest = np.zeros(len(solution.xyz_mm))
    for own, approach in solution.given.approaches:
        largest[own] = np.maximum(largest[own], approach.gap_mm)
    return largest


def _of_pairs(solution: Solution) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return point, value and row of the points that just two views show, with free picks, for each pair of views."""
    picks, parts = solution.picks, []
    reach = solution.by_point([np.repeat(r.reach[:, None], 2, axis=1) for r in solution.residuals])
    for i, j, directions, sine in solution.given.pairs:
        own = (sine >= 0.0) & (picks.seen.sum(axis=0) == 2)
        common = unit(cross(*directions[:, own]))
        rows = np.zeros((len(common), reach.shape[1]))
        for k, sign in ((i, -1.0), (j, 1.0)):
            rows[:, 2 * k : 2 * k + 2] = sign * reach[own, 2 * k, None] * (common @ solution.lines[k].plane.axes.T)
        free = ~np.any(picks.snapped[:, own], axis=0)
        between = solution.lines[j].focal_point_mm - solution.lines[i].focal_point_mm
        parts.append((np.flatnonzero(own)[free], common[free] @ between, rows[free]))
    return parts


def _of_more(solution: Solution) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return points, values and rows of each point that more than two views show."""
    residual = solution.xy_mm
    snapped, parts = solution.given.snapped, []
    for i in np.flatnonzero(solution.picks.seen.sum(axis=0) > 2):
        shown = np.repeat(solution.picks.seen[:, i], 2)
        free = snapped[solution.picks.snapped[:, i], i].T  # (2V, snapped picks)
        explained = np.hstack([solution.to_point[i], free])[shown]
        rows = np.zeros((len(explained) - explained.shape[1], len(shown)))
        rows[:, shown] = np.linalg.svd(explained)[0][:, explained.shape[1] :].T
        parts.append((np.full(len(rows), i), rows @ residual[i], rows))
    return parts
