"""Hypotheses for the pose of a cloud of balls: three detections taken for three balls; the other balls verify them.

Three points under scaled orthography have one scale and two depth-reversed solutions. Each is corrected to a central
projection, and its out-of-plane axis is tried in both directions: as the X-ray source sees the cloud, and mirrored.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from sightline.common.fitting import median
from sightline.common.kernels import kernel
from sightline.detection.labelling.seeds import RADIUS_RATIO, square
from sightline.detection.results import Detections

# Share by which the scale of three points, or a distance, may differ from that by their radii: 5 % each, blur [ours].
SLACK = 0.12
CELLS = 256  # of the table of nearest detections, per side
BEYOND = -2  # stands for a detection outside the table
SEEN = 0.7  # probability that a ball of the right hypothesis has a detection in its gate [ours]
GIVE_UP = -4.5  # log likelihood ratio at which a hypothesis is dropped: 1 % of right ones [calc]
CORRECTIONS = 2  # of scaled orthography towards perspective; the third changes less than 0.1 px [calc]
MIN_BREADTH = 0.05  # of three balls: doubled area over the square of their longest side [ours]


class Seen(NamedTuple):
    """N detections for kernels: `w` (N,) centres u + iv from the image's middle, px.

    `magnification` (N, M): px/mm of each detection as each ball. `nearest` (CELLS, CELLS): the detection nearest to the
    middle of each cell, or -1; `corner`: the first cell's corner, px; `cells` per pixel. `gate` around a predicted
    centre, px. `hit`, `miss`: log likelihood ratios of a ball with and without a detection in its gate. `matrices`
    (2, 3, 3): work space.
    """

    w: np.ndarray
    magnification: np.ndarray
    nearest: np.ndarray
    corner: complex
    cells: float
    gate: float
    hit: float
    miss: float
    matrices: np.ndarray


class Cloud(NamedTuple):
    """M balls for kernels: `xyz` (M, 3), mm; `apart` (M, M) distances, mm.

    `order` (M,): the random order in which balls verify a hypothesis.
    """

    xyz: np.ndarray
    apart: np.ndarray
    order: np.ndarray


class Hypotheses(NamedTuple):
    """The best hypotheses so far. `hits` (K,): balls with a detection in their gate, 0 where there is none.

    `rows` (K, 3): three detections, `balls` (K, 3) which they show. `matrix` (K, 3, 3): px per mm from the first ball,
    the third row along the beam; left-handed where the image is mirrored. `focal` (K,), px.
    """

    hits: np.ndarray
    rows: np.ndarray
    balls: np.ndarray
    matrix: np.ndarray
    focal: np.ndarray


@kernel()
def nearest_table(w, corner, cells, gate):
    """Return the detection nearest to the middle of each cell, or -1 where none is within the gate of the cell."""
    table, nearest = np.full((CELLS, CELLS), -1), np.full((CELLS, CELLS), np.inf)
    reach = int(gate * cells) + 2
    for k in range(len(w)):
        at = (w[k] - corner) * cells
        ci, cj = int(at.imag), int(at.real)
        for i in range(max(ci - reach, 0), min(ci + reach + 1, CELLS)):
            for j in range(max(cj - reach, 0), min(cj + reach + 1, CELLS)):
                d = (at.real - j - 0.5) ** 2 + (at.imag - i - 0.5) ** 2
                if d < nearest[i, j]:
                    table[i, j], nearest[i, j] = k, d
    return table


@kernel()
def _heights(d1, d2, g11, g22, g12):
    """Return the squared scale and the depths (px) of two points over a first, under scaled orthography.

    `d1`, `d2`: their images relative to the first, px; `g11`, `g22`, `g12`: products of the vectors to them, mm².
    """
    a, b, c = square(d1), square(d2), d1.real * d2.real + d1.imag * d2.imag
    determinant = g11 * g22 - g12 * g12
    half = 0.5 * (g11 * b + g22 * a - 2 * g12 * c)
    q = (half + np.sqrt(max(half * half - determinant * (a * b - c * c), 0.0))) / determinant
    h1, h2 = np.sqrt(max(q * g11 - a, 0.0)), np.sqrt(max(q * g22 - b, 0.0))
    return q, h1, h2 if q * g12 >= c else -h2


@kernel()
def _cross(a, b):
    """Return the cross product of two vectors, as a tuple."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel()
def _from(origin, point):
    """Return the vector from one point to another, as a tuple."""
    return point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]


@kernel()
def _dot(a, b):
    """Return the product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel()
def _hits(seen, cloud, first, u0, matrix, focal, scale, least):  # noqa: PLR0917 - a kernel
    """Return the number of balls with a detection of their size in the gate; 0 where the hypothesis is given up.

    `u0`: the image of ball `first`; `matrix` (3, 3), px per mm; `scale` its scale; `least`: hits needed.
    """
    w, nearest, cells, corner = seen.w, seen.nearest, seen.cells, seen.corner
    xyz, gate2 = cloud.xyz, seen.gate**2
    hits, ratio, left, origin = 0, 0.0, len(xyz), xyz[first]
    for n in range(first, first + left):  # each hypothesis begins elsewhere: the same hidden balls never decide all
        p = cloud.order[n % len(xyz)]
        at = _from(origin, xyz[p])
        depth = 1 + _dot(matrix[2], at) / focal
        u, v = (u0.real + _dot(matrix[0], at)) / depth, (u0.imag + _dot(matrix[1], at)) / depth
        j, i = int((u - corner.real) * cells), int((v - corner.imag) * cells)
        left -= 1
        k = nearest[i, j] if 0 <= i < CELLS and 0 <= j < CELLS else BEYOND
        if (
            k >= 0
            and (w[k].real - u) ** 2 + (w[k].imag - v) ** 2 < gate2
            and abs(seen.magnification[k, p] * depth - scale) < RADIUS_RATIO * scale
        ):
            hits += 1
            ratio = min(ratio + seen.hit, -GIVE_UP)
        else:
            ratio += seen.miss if k > BEYOND else seen.miss / 4  # perhaps outside the image
        if ratio < GIVE_UP or hits + left < least:
            return 0
    return hits


@kernel()
def _pose(rows, balls, seen, cloud, near, focal, matrices):  # noqa: PLR0917 - a kernel
    """Write the upright and the mirrored matrix (2, 3, 3) with three detections as three balls; return their scale.

    `near`: 1 where the second ball lies behind the first, -1 where before. The result is 0 where no such pose exists.
    """
    w, xyz = seen.w, cloud.xyz
    v1, v2 = _from(xyz[balls[0]], xyz[balls[1]]), _from(xyz[balls[0]], xyz[balls[2]])
    g11, g22, g12 = _dot(v1, v1), _dot(v2, v2), _dot(v1, v2)
    w0, w1, w2 = w[rows[0]], w[rows[1]], w[rows[2]]
    d1, d2 = w1 - w0, w2 - w0
    q, h1, h2 = _heights(d1, d2, g11, g22, g12)
    for _ in range(CORRECTIONS):
        f1, f2 = 1 + near * h1 / focal, 1 + near * h2 / focal
        if not (0.5 < f1 < 2 and 0.5 < f2 < 2):
            return 0.0
        d1, d2 = w1 * f1 - w0, w2 * f2 - w0
        q, h1, h2 = _heights(d1, d2, g11, g22, g12)
    scale = np.sqrt(q)
    p1, p2 = (d1.real, d1.imag, near * h1), (d2.real, d2.imag, near * h2)
    across, normal = _cross(p1, p2), _cross(v1, v2)
    area2 = _dot(normal, normal)
    b1, b2 = _cross(v2, normal), _cross(normal, v1)
    for r in range(3):
        for c in range(3):
            within, beyond = (p1[r] * b1[c] + p2[r] * b2[c]) / area2, across[r] * normal[c] / (scale * area2)
            matrices[0, r, c], matrices[1, r, c] = within + beyond, within - beyond
    return scale


@kernel()
def _keep(best, hits, rows, balls, matrix, focal):  # noqa: PLR0917 - a kernel
    """Put a hypothesis in the place of the worst one."""
    worst = best.hits.argmin()
    best.hits[worst], best.matrix[worst], best.focal[worst] = hits, matrix, focal
    for c in range(3):
        best.rows[worst, c], best.balls[worst, c] = rows[c], balls[c]


@kernel()
def _verify(rows, balls, seen, cloud, focals, best, least):  # noqa: PLR0917 - a kernel
    """Keep the best hypotheses that three detections show three balls; return the most hits."""
    matrices, most = seen.matrices, 0
    for focal in focals:
        for near in (1, -1):
            scale = _pose(rows, balls, seen, cloud, near, focal, matrices)
            for side in range(2 if scale > 0 else 0):
                wanted = max(best.hits.min() + 1, least)
                hits = _hits(seen, cloud, balls[0], seen.w[rows[0]], matrices[side], focal, scale, wanted)
                if hits >= wanted:
                    _keep(best, hits, rows, balls, matrices[side], focal)
                most = max(most, hits)
    return most


@kernel()
def _search_one(rows, seen, cloud, focals, best, least, enough):  # noqa: PLR0917 - a kernel
    """Take three detections for every three balls that are far enough apart; return whether one has `enough` hits."""
    w, magnification, apart = seen.w, seen.magnification, cloud.apart
    i, j, k = rows
    d1, d2 = w[j] - w[i], w[k] - w[i]
    ij, ik, jk, focal = abs(d1), abs(d2), abs(w[k] - w[j]), focals[0]
    low, high = np.exp(-6 * SLACK), np.exp(6 * SLACK)
    balls = len(apart)
    for a in range(balls):
        m_a = magnification[i, a]
        for b in range(balls):
            m_b, reach = magnification[j, b], (1 + SLACK) * apart[a, b]
            mean = np.sqrt(m_a * m_b)
            if b == a or reach * mean < ij or abs(m_a - m_b) > (SLACK + reach * mean / focal) * mean:
                continue
            for c in range(balls):
                m_c, reach = magnification[k, c], (1 + SLACK) * mean * apart[a, c]
                if (
                    reach < ik
                    or (1 + SLACK) * mean * apart[b, c] < jk
                    or c in {a, b}
                    or abs(m_a - m_c) > (SLACK + reach / focal) * mean
                ):
                    continue
                g11, g22 = apart[a, b] ** 2, apart[a, c] ** 2
                g12 = (g11 + g22 - apart[b, c] ** 2) / 2
                if g11 * g22 - g12**2 < (MIN_BREADTH * max(g11, g22)) ** 2:
                    continue
                q, _, _ = _heights(d1, d2, g11, g22, g12)
                if (
                    low < q**3 / (m_a * m_b * m_c) ** 2 < high
                    and _verify(rows, (a, b, c), seen, cloud, focals, best, least) >= enough
                ):
                    return True
    return False


@kernel()
def search(triples, seen, cloud, focals, best, least, enough):  # noqa: PLR0917 - a kernel
    """Fill `best` with hypotheses of at least `least` hits; return how many of the `triples` (T, 3) it took.

    Stops once a hypothesis has `enough` hits. `focals` (F,): focal lengths tried, px.
    """
    for t in range(len(triples)):
        if _search_one((triples[t, 0], triples[t, 1], triples[t, 2]), seen, cloud, focals, best, least, enough):
            return t + 1
    return len(triples)


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


class Prior(NamedTuple):
    """Priors of a camera: log focal length (px) with its s.d., principal point (2,), px, with its s.d. per axis."""

    log_focal: float
    log_focal_sd: float
    principal_px: np.ndarray
    principal_sd_px: float


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
    sizes = np.unique(np.round(half, 3))
    steps = np.unique(np.round(np.subtract.outer(sizes, sizes), 3))
    off = np.subtract.outer(log_radius, log_radius)[:, :, None] - steps
    alike = (np.abs(off).min(axis=2) < ALIKE).mean(axis=1)
    # The share (N, N) of pairs of balls whose distance may be that of each pair of detections, or more.
    apart = np.sort(problem.cloud.apart[np.triu_indices(len(half), 1)])
    apart_mm = distance / np.exp(np.add.outer(log_radius, log_radius) / 2 - median(half))
    share = 1 - np.searchsorted(apart, apart_mm * (1 - SLACK)) / len(apart)
    cost = share[i, j] * share[i, k] * share[j, k] * len(half) ** 3
    promise = np.where(broad & (cost > 0), (alike[i] * alike[j] * alike[k]) ** 2 / (cost + OVERHEAD), 0.0)
    order = np.argsort(-promise, kind="stable")[: np.count_nonzero(promise)]
    return rows[corners[order[np.cumsum(cost[order] + OVERHEAD) <= most]]]
