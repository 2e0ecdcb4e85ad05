"""The prior of what a cubic leaves of a plane map: degrees 4 and 5, and a Gaussian process for the rest.

Pincushion and the S of a magnetic field have parts of degree 4 and 5 that reach across the field; real tubes add a
rough remainder of shorter reach. How much (amplitude) and how rough (length) is unknown: each pair of a grid is weighed
by its penalised marginal likelihood (REML: the cubic and F integrated out, log-determinants kept), and the prior used
is the average over the grid. So what the beads do not tell of amplitude and length stays in the covariance, and where
beads are few the hyper-prior decides. Lengths are in unit coordinates (1 = radius of the region of the controls).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from heapq import heappop, heappush

import numpy as np

from sightline.calibration.polynomial import monomials
from sightline.fitting.kernels import squared_distances, squared_exponential
from sightline.fitting.triangular import cholesky, solve_lower

# Grid and hyper-prior [ours]: chosen on real plates and the twin together, where results depend little on them
# (docs/choosing-a-method.md). Amplitude: expected rms of what a cubic leaves, in radii of the region.
LENGTHS = np.array([0.25, 0.4, 0.65])
LENGTH_MEDIAN, LENGTH_SPREAD = 0.45, 0.6  # log-normal
AMPLITUDES = np.geomspace(1e-5, 1e-2, 8)
AMPLITUDE_MEDIAN, AMPLITUDE_SPREAD = 1.5e-3, 1.3  # log-normal
QUINTIC = 5
QUINTIC_SHARE = 0.75  # of that mean square, what is of degree 4 and 5
NEGLIGIBLE = 1e-6  # of the largest mean square
MAX_LOG_RATIO = 15.0  # logarithm of a weight, against the largest, that changes no digit that is shown [calc]
# Where no noise is stated: a hand-made centre errs by 0.1 to 1 px [ours]; log-normal.
NOISE_SCALES_PX = np.geomspace(0.03, 3.0, 9)
NOISE_MEDIAN_PX, NOISE_SPREAD = 0.3, 0.8


@dataclass(frozen=True, eq=False)
class Kernel:
    """Covariance of one coordinate of g: sum of variances_mm2 * exp(-d² / 2 lengths²), plus `quintic_mm2` times that of
    a random polynomial of degree 4 and 5."""

    variances_mm2: np.ndarray
    lengths: np.ndarray
    quintic_mm2: float

    @staticmethod
    def of_amplitudes(squares_mm2: np.ndarray) -> "Kernel":
        """The sum, over LENGTHS, of processes of these mean squares beyond a cubic."""
        rough = (1 - QUINTIC_SHARE) * squares_mm2 / [_beyond_cubic(length) for length in LENGTHS]
        kept = squares_mm2 > NEGLIGIBLE * squares_mm2.max()
        return Kernel(rough[kept], LENGTHS[kept], QUINTIC_SHARE * float(squares_mm2.sum()))

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """(N, M) for unit coordinates (N, 2), (M, 2), mm²."""
        d2 = squared_distances(a, b)
        out = self.quintic_mm2 * (monomials(a, QUINTIC) @ _quintics()) @ (monomials(b, QUINTIC) @ _quintics()).T
        for variance, length in zip(self.variances_mm2, self.lengths, strict=True):
            out += variance * squared_exponential(d2, length)
        return out

    def quintic_of(self, b: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(21, c): what the part of degree 4 and 5 is in kernel(., b) @ weights (M, c): a polynomial's coefficients."""
        return self.quintic_mm2 * (_quintics() @ (_quintics().T @ (monomials(b, QUINTIC).T @ weights)))


@lru_cache(maxsize=1)
def _disc() -> np.ndarray:
    """(M, 2) points evenly over the unit disc: the quadrature of every mean over it."""
    side = np.linspace(-1.0, 1.0, 33)
    square = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    return square[(square**2).sum(axis=1) <= 1.0]


@lru_cache(maxsize=1)
def _quintics() -> np.ndarray:
    """(21, 11): coefficients of polynomials of degree 4 and 5, orthogonal on the disc to each other and to every cubic,
    whose mean squares add up to 1."""
    r = np.linalg.qr(monomials(_disc(), QUINTIC))[1]
    return np.linalg.inv(r)[:, 10:] * np.sqrt(len(_disc()) / 11)


@lru_cache(maxsize=32)
def _beyond_cubic(length: float) -> float:
    """Expected mean square over the unit disc that a cubic leaves of a unit-variance process of this length."""
    q = np.linalg.qr(monomials(_disc(), 3))[0]
    k = squared_exponential(squared_distances(_disc(), _disc()), length)
    return float(1 - np.einsum("ia,ij,ja->", q, k, q, optimize=True) / len(_disc()))


@dataclass(frozen=True, eq=False)
class PriorData:
    """What the search sees: both coordinates alike, noise of one number per bead.

    `unit_xy` (N, 2); `design` (N, a), the same columns for x and y; `shared` (N, 2, s): columns of parameters that
    act on both coordinates; `data_mm` (N, 2); `noise_mm2` (N,): of one coordinate; `frame_mm2`: variance that the
    frame's errors add to each; `radius_mm`: one unit.
    """

    unit_xy: np.ndarray
    design: np.ndarray
    shared: np.ndarray
    data_mm: np.ndarray
    noise_mm2: np.ndarray
    frame_mm2: float
    radius_mm: float


@dataclass(frozen=True, eq=False)
class Learned:
    """The averaged prior, and by what the stated noise is to be multiplied (1 where it is known)."""

    kernel: Kernel
    noise_scale: float


def learn(problem: PriorData, noise_scales: np.ndarray | None = None) -> Learned:
    """The posterior average of the prior. `noise_scales` of the standard deviations, where the noise is unknown.

    Then `noise_mm2` is what 1 px of noise would be.
    """
    scales = np.ones(1) if noise_scales is None else noise_scales
    shapes = _shapes(problem.unit_xy)
    right = np.concatenate([problem.design, problem.data_mm, problem.shared.reshape(len(problem.data_mm), -1)], axis=1)
    hyper = -0.5 * (np.log(LENGTHS / LENGTH_MEDIAN) / LENGTH_SPREAD)[:, None, None] ** 2
    hyper = hyper - 0.5 * (np.log(AMPLITUDES / AMPLITUDE_MEDIAN) / AMPLITUDE_SPREAD)[:, None] ** 2
    hyper = hyper - (0 if noise_scales is None else 0.5 * (np.log(scales / NOISE_MEDIAN_PX) / NOISE_SPREAD) ** 2)

    def score(at: tuple[int, ...]) -> float:
        i, j, k = at
        covariance = (AMPLITUDES[j] * problem.radius_mm) ** 2 * shapes[i]
        covariance.flat[:: len(right) + 1] += scales[k] ** 2 * problem.noise_mm2 + problem.frame_mm2
        return _log_evidence(covariance, right, problem.design.shape[1]) + hyper[at]

    weight = _weights(score, hyper)
    squares = weight.sum(axis=2) @ (AMPLITUDES * problem.radius_mm) ** 2
    scale = float(np.sqrt(weight.sum(axis=(0, 1)) @ scales**2))
    return Learned(Kernel.of_amplitudes(squares), scale)


def _weights(score: Callable[[tuple[int, ...]], float], hyper: np.ndarray) -> np.ndarray:
    """Weights, of sum 1, of a grid's points by their `score`; `hyper` (the grid): where to begin, at its largest.

    Best first: only around points of some weight does it look on. The evidence has one ridge (misfit falls with the
    amplitude, freedom rises), so that most of the grid is never computed.
    """
    scores = np.full(hyper.shape, -np.inf)
    first = tuple(int(k) for k in np.unravel_index(np.argmax(hyper), hyper.shape))
    scores[first] = score(first)
    queue = [(-scores[first], first)]
    while queue and -queue[0][0] > scores.max() - MAX_LOG_RATIO:
        at = heappop(queue)[1]
        for axis, size in enumerate(hyper.shape):
            for k in range(max(at[axis] - 1, 0), min(at[axis] + 2, size)):
                near = (*at[:axis], k, *at[axis + 1 :])
                if scores[near] == -np.inf:
                    scores[near] = score(near)
                    heappush(queue, (-scores[near], near))
    weight = np.exp(scores - scores.max())
    return weight / weight.sum()


def _shapes(unit_xy: np.ndarray) -> list[np.ndarray]:
    """(N, N) covariance for each of LENGTHS, of unit amplitude."""
    d2 = squared_distances(unit_xy, unit_xy)
    features = monomials(unit_xy, QUINTIC) @ _quintics()
    quintic = QUINTIC_SHARE * features @ features.T
    return [
        quintic + (1 - QUINTIC_SHARE) / _beyond_cubic(length) * squared_exponential(d2, length) for length in LENGTHS
    ]


def _log_evidence(covariance: np.ndarray, right: np.ndarray, a: int) -> float:
    """REML log-likelihood up to a constant; `right` = [design (a), data x and y, shared x, y, x, y ...]."""
    factor = cholesky(covariance)
    white = solve_lower(factor, right)
    gram = white.T @ white
    r = cholesky(gram[:a, :a])
    fixed = solve_lower(r, gram[:a, a:])
    rest = gram[a:, a:] - fixed.T @ fixed  # inner products beside the design, of data and shared columns
    x, y = rest[0::2, 0::2], rest[1::2, 1::2]
    both = x + y
    log_det = 2 * (np.log(factor.diagonal()).sum() + np.log(r.diagonal()).sum()) * 2
    misfit = both[0, 0]
    if len(both) > 1:
        shared = cholesky(both[1:, 1:])
        misfit -= (solve_lower(shared, both[1:, :1]) ** 2).sum()
        log_det += 2 * np.log(shared.diagonal()).sum()
    return -0.5 * (log_det + misfit)
