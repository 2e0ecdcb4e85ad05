"""Plane map of the smooth method: a cubic plus a Gaussian process."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from heapq import heappop, heappush

import numpy as np

from sightline.calibration.maps.hull import well_conditioned
from sightline.calibration.maps.polynomial import (
    Affine,
    InvertibleMap,
    derivatives,
    monomial_gradients,
)
from sightline.common.fitting import (
    Kriging,
    cholesky,
    monomials,
    solve_lower,
    solve_lower_transposed,
    squared_distances,
    squared_exponential,
    terms,
)
from sightline.errors import CalibrationRefusedError

# Grid and hyper-prior [ours]: chosen on real plates and the twin together, where results depend little on them
# (docs/choosing-a-method.md). Amplitude: expected rms beyond a cubic, in radii of the region.
LENGTHS = np.array([0.25, 0.4, 0.65])
LENGTH_MEDIAN, LENGTH_SPREAD = 0.45, 0.6  # log-normal
AMPLITUDES = np.geomspace(1e-5, 1e-2, 8)
AMPLITUDE_MEDIAN, AMPLITUDE_SPREAD = 1.5e-3, 1.3  # log-normal
QUINTIC = 5
QUINTIC_SHARE = 0.75  # share of that mean square in degrees 4 and 5
NEGLIGIBLE = 1e-6  # share of the largest mean square below which a component is dropped
MAX_LOG_RATIO = 15.0  # smaller weights, exp(-this) of the largest, change no displayed digit [calc]
# Where no noise is stated, of centres picked by hand, 0.1 to 1 px [physics.md, Picks]; log-normal.
NOISE_SCALES_PX = np.geomspace(0.03, 3.0, 9)
NOISE_MEDIAN_PX, NOISE_SPREAD = 0.3, 0.8
# Log density of the hyper-prior (lengths, amplitudes, 1).
_HYPER = (
    -0.5 * (np.log(LENGTHS / LENGTH_MEDIAN) / LENGTH_SPREAD)[:, None, None] ** 2
    - 0.5 * (np.log(AMPLITUDES / AMPLITUDE_MEDIAN) / AMPLITUDE_SPREAD)[:, None] ** 2
)


@dataclass(frozen=True, eq=False)
class Kernel:
    """Covariance of one coordinate of g: sum of variances_mm2 * exp(-d² / 2 lengths²), plus `quintic_mm2` times the
    covariance of a random polynomial of degree 4 and 5."""

    variances_mm2: np.ndarray
    lengths: np.ndarray
    quintic_mm2: float

    @staticmethod
    def of_amplitudes(squares_mm2: np.ndarray) -> "Kernel":
        """Return the sum over LENGTHS of processes with these mean squares beyond a cubic."""
        rough = (1 - QUINTIC_SHARE) * squares_mm2 / [_beyond_cubic(length) for length in LENGTHS]
        kept = squares_mm2 > NEGLIGIBLE * squares_mm2.max()
        return Kernel(rough[kept], LENGTHS[kept], QUINTIC_SHARE * float(squares_mm2.sum()))

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return (N, M), mm², for unit coordinates (N, 2) and (M, 2)."""
        of_a = monomials(a, QUINTIC) @ _quintics()
        of_b = of_a if b is a else monomials(b, QUINTIC) @ _quintics()
        return self.covariance_mm2(squared_distances(a, b), of_a, of_b)

    def covariance_mm2(self, squares: np.ndarray, of_a: np.ndarray, of_b: np.ndarray) -> np.ndarray:
        """Return (N, M) for squared distances (N, M) and the polynomials of degree 4 and 5, (N, 11) and (M, 11)."""
        covariance = self.quintic_mm2 * of_a @ of_b.T
        for variance, length in zip(self.variances_mm2, self.lengths, strict=True):
            covariance += variance * squared_exponential(squares, length)
        return covariance

    def polynomial_part(self, b: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the coefficients (21, c) of the polynomial of degree 4 and 5 in kernel(., b) @ weights (M, c)."""
        return self.quintic_mm2 * (_quintics() @ (_quintics().T @ (monomials(b, QUINTIC).T @ weights)))


@lru_cache(maxsize=1)
def _disc() -> np.ndarray:
    """Return (M, 2) points evenly spaced over the unit disc, for means over it."""
    side = np.linspace(-1.0, 1.0, 33)
    square = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    return square[(square**2).sum(axis=1) <= 1.0]


@lru_cache(maxsize=1)
def _quintics() -> np.ndarray:
    """Return the coefficients (21, 11) of polynomials of degree 4 and 5 whose mean squares add up to 1.

    They are orthogonal on the disc to each other and to every cubic.
    """
    r = np.linalg.qr(monomials(_disc(), QUINTIC))[1]
    return np.linalg.inv(r)[:, 10:] * np.sqrt(len(_disc()) / 11)


@lru_cache(maxsize=32)
def _beyond_cubic(length: float) -> float:
    """Return the expected mean square over the unit disc, beyond a cubic, of a unit-variance process of this length."""
    disc, q, within = _disc(), np.linalg.qr(monomials(_disc(), 3))[0], 0.0
    for some, own in zip(np.array_split(disc, 8), np.array_split(q, 8), strict=True):  # the whole matrix takes 5 MB
        within += float((own * (squared_exponential(squared_distances(some, disc), length) @ q)).sum())
    return 1 - within / len(disc)


@dataclass(frozen=True, eq=False)
class PriorData:
    """Data from which the prior is learned: isotropic noise for each of N beads.

    `at` (N, 2): the beads' unit coordinates; `design` (N, a), the same columns for x and y; `shared` (N, 2, s): columns
    of parameters that act on both coordinates; `data_mm` (N, 2); `noise_mm2` (N,): variance of one coordinate;
    `frame_mm2`: variance that the frame's errors add to each; `radius_mm`: length of one unit.
    """

    at: np.ndarray
    design: np.ndarray
    shared: np.ndarray
    data_mm: np.ndarray
    noise_mm2: np.ndarray
    frame_mm2: float
    radius_mm: float


@dataclass(frozen=True, eq=False)
class Learned:
    """The averaged prior, and the factor of the noise's standard deviation (1 where the noise is stated)."""

    kernel: Kernel
    noise_scale: float


def learn(data: PriorData, noise_scales: np.ndarray | None = None) -> Learned:
    """Return the prior averaged over its posterior.

    `noise_scales`: grid of the noise's standard deviation, px, where it is unknown; `noise_mm2` is then that of 1 px.
    """
    scales = np.ones(1) if noise_scales is None else noise_scales
    quintics, squares = monomials(data.at, QUINTIC) @ _quintics(), squared_distances(data.at, data.at)
    shapes = [Kernel.of_amplitudes(unit).covariance_mm2(squares, quintics, quintics) for unit in np.eye(len(LENGTHS))]
    # The evidence does not depend on the design's share of the data, but its rounding errors grow with that.
    r = cholesky(data.design.T @ data.design)
    rest = data.data_mm - data.design @ solve_lower_transposed(r, solve_lower(r, data.design.T @ data.data_mm))
    columns = [data.design, rest, np.swapaxes(data.shared, 1, 2).reshape(len(rest), -1)]
    rows = np.concatenate(columns, axis=1).T
    hyper = _HYPER if noise_scales is None else _HYPER - 0.5 * (np.log(scales / NOISE_MEDIAN_PX) / NOISE_SPREAD) ** 2

    def score(at: tuple[int, ...]) -> float:
        i, j, k = at
        diagonal = scales[k] ** 2 * data.noise_mm2 + data.frame_mm2
        amplitude2 = float(AMPLITUDES[j] * data.radius_mm) ** 2
        covariance = amplitude2 * shapes[i] + np.diag(diagonal)
        return _log_evidence(covariance, rows, data.design.shape[1]) + float(hyper[at])

    weight = _weights(score, hyper)
    amplitudes2 = weight.sum(axis=2) @ (AMPLITUDES * data.radius_mm) ** 2
    scale = float(np.sqrt(weight.sum(axis=(0, 1)) @ scales**2))
    return Learned(Kernel.of_amplitudes(amplitudes2), scale)


def _weights(score: Callable[[tuple[int, ...]], float], hyper: np.ndarray) -> np.ndarray:
    """Return the weights, of sum 1, of a grid's points by their log `score`; `hyper` (the grid): log hyper-prior.

    Best-first search from the maximum of `hyper`: only the neighbours of points with some weight are evaluated. The
    evidence has one ridge (a larger amplitude reduces the misfit but adds freedom), so most of the grid is not.
    """
    first = tuple(int(k) for k in np.unravel_index(np.argmax(hyper), hyper.shape))
    known = {first: score(first)}
    queue, best = [(-known[first], first)], known[first]
    while queue and -queue[0][0] > best - MAX_LOG_RATIO:
        at = heappop(queue)[1]
        for axis, size in enumerate(hyper.shape):
            for k in range(max(at[axis] - 1, 0), min(at[axis] + 2, size)):
                near = (*at[:axis], k, *at[axis + 1 :])
                if near not in known:
                    known[near] = score(near)
                    best = max(best, known[near])
                    heappush(queue, (-known[near], near))
    weight = np.zeros(hyper.shape)
    for at, value in known.items():
        weight[at] = np.exp(value - best)
    return weight / weight.sum()


def _log_evidence(covariance: np.ndarray, rows: np.ndarray, a: int) -> float:
    """Return the REML log-likelihood, up to a constant, of data with a covariance (N, N). Raises LinAlgError.

    `rows` (m, N): design (a), data x and y, shared x, y, x, y ... The design is that of either coordinate, the shared
    columns act on both.
    """
    lower = cholesky(covariance)
    white = solve_lower(lower, rows.T)
    factor = cholesky(white[:, :a].T @ white[:, :a])
    along = solve_lower(factor, white[:, :a].T @ white[:, a:])
    gram = white[:, a:].T @ white[:, a:] - along.T @ along  # orthogonal to the design
    both = gram[::2, ::2] + gram[1::2, 1::2]  # of x and y together: the data first, then the shared columns
    shared = cholesky(both[1:, 1:])
    rest = both[0, 0] - float((solve_lower(shared, both[1:, :1]) ** 2).sum())
    log_det = 4 * np.log(lower.diagonal()).sum() + 4 * np.log(factor.diagonal()).sum()
    return -0.5 * float(log_det + 2 * np.log(shared.diagonal()).sum() + rest)


DEGREE = 3
# What a fit may take [ours]. With more controls, seconds and gigabytes: their covariance is dense. The
# hyper-parameters, a few numbers, are learned from at most LEARN_FROM controls, drawn at random: time grows with their
# cube. Kernel values held at once take 8 MB, as much as a processor's cache.
MAX_CONTROLS, LEARN_FROM, BLOCK = 4000, 250, 2**20


@dataclass(frozen=True, eq=False)
class SmoothMap(InvertibleMap):
    """`cubic` (10, 2) on normalised pixels plus kernel(., controls) @ `dual` (N, 2), mm."""

    unit: Affine
    kernel: Kernel
    cubic: np.ndarray
    dual: np.ndarray
    controls_px: np.ndarray

    @cached_property
    def controls_unit(self) -> np.ndarray:
        """(N, 2): the controls in unit coordinates."""
        return self.unit(self.controls_px)

    def linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `to_plane` and `jacobian`."""
        return self._at_controls if uv_px is self.controls_px else self._linearised(uv_px)

    @cached_property
    def _at_controls(self) -> tuple[np.ndarray, np.ndarray]:
        """`linearised` at the controls, read-only: residuals, checks and the inverse map ask for it."""
        xy, jacobian = self._linearised(self.controls_px)
        xy.flags.writeable = jacobian.flags.writeable = False
        return xy, jacobian

    def _linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `linearised` in blocks, so that the kernel of millions of pixels is never held at once."""
        rows = max(1, BLOCK // len(self.dual))
        at = self.unit(uv_px)
        blocks = [self._block(at[k : k + rows]) for k in range(0, max(len(at), 1), rows)]
        xy, by_unit = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
        return xy, by_unit @ self.unit.matrix

    def _block(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return plane coordinates (N, 2) at unit coordinates `at` (N, 2), and their derivatives (N, 2, 2) by these."""
        basis, d2 = monomials(at, QUINTIC), squared_distances(at, self.controls_unit)
        xy = basis @ self._polynomial
        by_unit = np.stack([basis @ slope for slope in self._polynomial_slopes], axis=-1)
        for variance, length in zip(self.kernel.variances_mm2, self.kernel.lengths, strict=True):
            near = variance * squared_exponential(d2, length)
            own = near @ self.dual
            xy += own  # and d exp(-|a - b|² / 2 l²) / da is that times (b - a) / l²
            by_unit += ((near @ self._moments).reshape(-1, 2, 2) - own[:, :, None] * at[:, None, :]) / length**2
        return xy, by_unit

    @cached_property
    def _moments(self) -> np.ndarray:
        """(N, 4): `dual` times the controls' coordinates."""
        return (self.dual[:, :, None] * self.controls_unit[:, None, :]).reshape(-1, 4)

    @cached_property
    def _polynomial_slopes(self) -> list[np.ndarray]:
        """Coefficients (21, 2) of the derivatives of `_polynomial` by both coordinates."""
        return [by @ self._polynomial for by in derivatives(QUINTIC)]

    @cached_property
    def _polynomial(self) -> np.ndarray:
        """(21, 2): coefficients of the monomials to degree 5: the cubic, and the process's polynomial."""
        coefficients = self.kernel.polynomial_part(self.controls_unit, self.dual)
        coefficients[: len(self.cubic)] += self.cubic
        return coefficients


@dataclass(frozen=True, eq=False)
class FittedSmoothMap(SmoothMap):
    """A smooth map fitted to controls in one plane, with its posterior covariance."""

    solution: Kriging

    @staticmethod
    @well_conditioned()
    def fit(uv_px: np.ndarray, xy_mm: np.ndarray, noise_px: float | None) -> "FittedSmoothMap":
        """Return the map fitted to controls (N, 2); `noise_px`: s.d. of their pixels per axis (None: estimated).

        Raises CalibrationRefusedError.
        """
        n = len(uv_px)
        if not terms(DEGREE) + 2 <= n <= MAX_CONTROLS:
            raise CalibrationRefusedError(
                f"{n} controls given; the smooth method takes {terms(DEGREE) + 2} to {MAX_CONTROLS}: "
                + ("give more controls" if n < MAX_CONTROLS else "thin them out evenly, or use a polynomial")
            )
        unit, radius = Affine.fit(uv_px, xy_mm)
        at = unit(uv_px)
        design = monomials(at, DEGREE)
        cubic = np.linalg.lstsq(design, xy_mm, rcond=None)[0]
        slopes = np.einsum("nkd,kc->ncd", monomial_gradients(at, DEGREE), cubic) @ unit.matrix
        per_px2 = 0.5 * (slopes**2).sum(axis=(1, 2))
        some = np.arange(n) if n <= LEARN_FROM else np.random.default_rng(0).permutation(n)[:LEARN_FROM]
        noise = per_px2 if noise_px is None else per_px2 * noise_px**2
        none_shared = np.zeros((len(some), 2, 0))
        data = PriorData(at[some], design[some], none_shared, xy_mm[some], noise[some], 0.0, radius)
        learned = learn(data, NOISE_SCALES_PX if noise_px is None else None)
        covariance = learned.kernel(at, at) + np.diag(learned.noise_scale**2 * noise)
        solution = Kriging.of(design, covariance, xy_mm)
        return FittedSmoothMap(unit, learned.kernel, solution.theta, solution.dual, uv_px, solution)

    def covariance_mm2(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the posterior covariance (N, N), mm², of one plane coordinate at pixels (N, 2).

        x and y are independent and have the same covariance.
        """
        at = self.unit(uv_px)
        cross, prior = self.kernel(at, self.controls_unit), self.kernel(at, at)
        return self.solution.predict(monomials(at, DEGREE), cross, prior)[1]
