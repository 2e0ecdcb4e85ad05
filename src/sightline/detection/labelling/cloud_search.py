"""Hypotheses for the labelling of a cloud of balls: which three detections to try, and what the kernels find."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from sightline.common.fitting import median
from sightline.detection.labelling.cloud_kernels import (
    CELLS,
    SEEN,
    SLACK,
    Cloud,
    Hypotheses,
    Seen,
    nearest_table,
    search,
)
from sightline.detection.labelling.pinhole import Prior
from sightline.detection.results import Detections

GATE_MM, MIN_GATE_PX = 0.8, 3.0  # of a hypothesis from three detections: errors of their centres, amplified [ours]
GATE_SD = 5.0  # s.d. of the balls' own errors: those of the three, amplified, and of the others [ours]
MAX_BY_CHANCE = 0.4  # probability assumed at most that a gate holds a false detection
FLOOR_PX = 0.1  # s.d. of a centre besides the stated one: blur, scatter, panel [ours]
FOCAL_STEP = np.log(1.5)  # of focal lengths tried: a block of 100 mm is then predicted within its gate [calc]
CHUNK = 24  # triples between two fits
ALL, DRAWN = 40, 6000  # with more detections than ALL, triples are drawn at random
ALIKE = 0.1  # log ratio of radii that the same size may have: noise, depth [ours]
MIN_AREA = 0.15  # of three detections: doubled area over the square of their longest side [ours]
OVERHEAD = 30  # cost of a triple of detections besides its triples of balls
PRINCIPAL_SD = 0.1  # of the principal point about the image's middle, over the longer side: cropped images [ours]


def prior_of(focal_px: tuple[float, float], image_shape: tuple[int, int]) -> Prior:
    """Return the priors for focal lengths from low to high (95 %) and an image of (H, W) pixels.

    >>> prior_of((5000.0, 5400.0), (1024, 1024)).principal_px
    array([511.5, 511.5])
    """
    low, high = np.log(focal_px)
    height, width = image_shape
    middle = np.array([width - 1.0, height - 1.0]) / 2
    return Prior((low + high) / 2, max((high - low) / 4, 1e-3), middle, PRINCIPAL_SD * max(width, height))


def sign_of(mirrored: bool) -> np.ndarray:
    """Return the signs (3,) of right, down and along the beam in the image or its mirror image."""
    return np.array([-1.0 if mirrored else 1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Problem:
    """N detections of one image, and M balls at `xyz_mm` (M, 3), each coordinate with an error of `ball_sd_mm`.

    `uv_px` (N, 2), `variance_px2` (N, 2, 2), `log_radius` (N,); `log_half` (M,) log radii of the balls, mm.
    """

    uv_px: np.ndarray
    variance_px2: np.ndarray
    log_radius: np.ndarray
    xyz_mm: np.ndarray
    log_half: np.ndarray
    ball_sd_mm: float
    prior: Prior

    @staticmethod
    def of(  # noqa: PLR0917
        detections: Detections,
        rows: np.ndarray,
        xyz_mm: np.ndarray,
        diameter_mm: np.ndarray,
        focal_px: tuple[float, float],
        ball_sd_mm: float,
    ) -> "Problem":
        """Return the problem to label the `rows` of the detections."""
        return Problem(
            detections.uv_px[rows],
            detections.covariance_px2[rows] + FLOOR_PX**2 * np.eye(2),
            np.log(detections.radius_px[rows]),
            np.array(xyz_mm, dtype=np.float64),  # writable: kernels are compiled for one type
            np.log(diameter_mm / 2),
            ball_sd_mm,
            prior_of(focal_px, detections.image_shape),
        )

    def without(self, rows: np.ndarray) -> "Problem":
        """Return the problem without some detections."""
        left = np.delete(np.arange(len(self.uv_px)), rows)
        return replace(
            self, uv_px=self.uv_px[left], variance_px2=self.variance_px2[left], log_radius=self.log_radius[left]
        )

    @cached_property
    def cloud(self) -> Cloud:
        """The balls for kernels."""
        order = np.random.default_rng(len(self.xyz_mm)).permutation(len(self.xyz_mm))
        return Cloud(self.xyz_mm, cdist(self.xyz_mm, self.xyz_mm), order)

    @property
    def focals_px(self) -> np.ndarray:
        """(F,) focal lengths that hypotheses are tried with, ascending."""
        low, high = (self.prior.log_focal + sign * 2 * self.prior.log_focal_sd for sign in (-1, 1))
        steps = max(1, int(np.ceil((high - low) / FOCAL_STEP)))
        return np.exp(low + (high - low) * (np.arange(steps) + 0.5) / steps)

    def image(self, mirrored: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return centres and covariances in the image, or in its mirror image."""
        sign, middle = sign_of(mirrored)[:2], self.prior.principal_px
        return middle + sign * (self.uv_px - middle), self.variance_px2 * np.outer(sign, sign)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Detection `row` shows `ball`, and `matrix` (3, 3), px/mm, takes vectors between balls to the image's axes."""

    row: int
    ball: int
    matrix: np.ndarray
    focal_px: float

    @property
    def mirrored(self) -> bool:
        """Whether the image is mirrored."""
        return bool(np.linalg.det(self.matrix) < 0)

    @cached_property
    def scale(self) -> float:
        """Pixels per mm."""
        return float(np.cbrt(abs(np.linalg.det(self.matrix))))


@dataclass(frozen=True, eq=False)
class Search:
    """The search for hypotheses among all detections of a problem; `gate_px`: of a predicted centre."""

    problem: Problem
    seen: Seen
    gate_px: float

    @staticmethod
    def of(problem: Problem) -> "Search":
        """Return the search, with a table of the detections."""
        uv_px = problem.uv_px - problem.prior.principal_px
        scale = float(np.exp(median(problem.log_radius) - median(problem.log_half)))
        apart = KDTree(uv_px).query(uv_px, 2)[0][:, 1]
        reach_mm = np.hypot(GATE_MM, GATE_SD * problem.ball_sd_mm)
        gate = max(MIN_GATE_PX, min(reach_mm * scale, median(apart) / 2))
        low, high = uv_px.min(axis=0) - 2 * gate, uv_px.max(axis=0) + 2 * gate
        cells = CELLS / float((high - low).max())
        most = np.ptp(np.quantile(uv_px, (0.1, 0.9), axis=0), axis=0) / 0.8
        chance = min(MAX_BY_CHANCE, len(uv_px) * np.pi * gate**2 / max(1.0, float(most.prod())))
        w, corner = uv_px @ np.array([1.0, 1j]), complex(*low)
        seen = Seen(
            w=w,
            magnification=np.exp(problem.log_radius[:, None] - problem.log_half),
            nearest=nearest_table(w, corner, cells, gate),
            corner=corner,
            cells=cells,
            gate=gate,
            hit=np.log(SEEN / chance),
            miss=np.log((1 - SEEN) / (1 - chance)),
            matrices=np.empty((2, 3, 3)),
        )
        return Search(problem, seen, gate)

    def chunks(self, triples: np.ndarray, least: int, enough: int | None, keep: int) -> Iterator[list[Hypothesis]]:
        """Yield the `keep` best hypotheses of each chunk of `triples` (T, 3) of detections, best first.

        They have at least `least` hits; a chunk ends once one has `enough`.
        """
        start, problem = 0, self.problem
        most = len(problem.xyz_mm) + 1 if enough is None else enough
        while start < len(triples):
            whole, triple = np.zeros(keep, np.int64), np.zeros((keep, 3), np.int64)
            best = Hypotheses(whole, triple, triple.copy(), np.zeros((keep, 3, 3)), np.zeros(keep))
            part = triples[start : start + CHUNK]
            start += search(part, self.seen, problem.cloud, problem.focals_px, best, least, most)
            order = np.argsort(-best.hits, kind="stable")
            yield [
                Hypothesis(int(best.rows[k, 0]), int(best.balls[k, 0]), best.matrix[k], float(best.focal[k]))
                for k in order[best.hits[order] > 0]
            ]


def promising(problem: Problem, rows: np.ndarray, most: float) -> np.ndarray:
    """Return triples (T, 3) of the detections `rows`, those that promise most for their cost first.

    The chance that all three are balls grows with the number of detections of like size. The cost is the number of
    triples of balls that are far enough apart; the sum of costs is `most` at most. The longest side comes first.
    """
    n, log_radius, uv_px, half = len(rows), problem.log_radius[rows], problem.uv_px[rows], problem.log_half
    if n <= ALL:
        corners = np.array(list(combinations(range(n), 3)))
    else:
        corners = np.random.default_rng(n).integers(0, n, (DRAWN, 3))
        corners = corners[(np.diff(np.sort(corners), axis=1) > 0).all(axis=1)]
    distance = cdist(uv_px, uv_px)
    i, j, k = corners.T
    longest = np.argmax([distance[j, k], distance[i, k], distance[i, j]], axis=0)
    corners = np.take_along_axis(corners, (longest[:, None] + [1, 2, 0]) % 3, axis=1)
    i, j, k = corners.T
    (au, av), (bu, bv) = (uv_px[j] - uv_px[i]).T, (uv_px[k] - uv_px[i]).T
    broad = np.abs(au * bv - av * bu) > MIN_AREA * distance[i, j] ** 2
    off = np.subtract.outer(log_radius, log_radius)[:, :, None] - _size_steps(half)
    alike = (np.abs(off).min(axis=2) < ALIKE).mean(axis=1)
    share = _share_apart(problem, distance / np.exp(np.add.outer(log_radius, log_radius) / 2 - median(half)))
    cost = share[i, j] * share[i, k] * share[j, k] * len(half) ** 3
    promise = np.where(broad & (cost > 0), (alike[i] * alike[j] * alike[k]) ** 2 / (cost + OVERHEAD), 0.0)
    order = np.argsort(-promise, kind="stable")[: np.count_nonzero(promise)]
    return rows[corners[order[np.cumsum(cost[order] + OVERHEAD) <= most]]]


def _size_steps(log_half: np.ndarray) -> np.ndarray:
    """Return the log ratios (S,) of the sizes of balls, ascending."""
    sizes = np.unique(np.round(log_half, 3))
    return np.unique(np.round(np.subtract.outer(sizes, sizes), 3))


def _share_apart(problem: Problem, least_mm: np.ndarray) -> np.ndarray:
    """Return the share (N, N) of pairs of balls whose distance may be `least_mm` (N, N) or more."""
    apart = np.sort(problem.cloud.apart[np.triu_indices(len(problem.xyz_mm), 1)])
    return 1 - np.searchsorted(apart, least_mm * (1 - SLACK)) / len(apart)
