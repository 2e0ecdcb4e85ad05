"""Plane map of the smooth method: a cubic plus a Gaussian process."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.calibration.maps.hull import well_conditioned
from sightline.calibration.maps.inverse import Inverse
from sightline.calibration.maps.polynomial import Affine, derivatives, monomial_gradients, monomials, terms
from sightline.calibration.maps.prior import NOISE_SCALES_PX, QUINTIC, Kernel, PriorData, learn
from sightline.common.fitting import Kriging, squared_distances, squared_exponential
from sightline.errors import CalibrationRefusedError

DEGREE = 3
# With more controls a fit takes seconds and gigabytes: their covariance is dense [ours].
MAX_CONTROLS = 4000
# The hyper-parameters are learned from at most this many controls, drawn at random [ours].
LEARN_FROM = 250
BLOCK = 2**20  # kernel values held at once: 8 MB [ours]


@dataclass(frozen=True, eq=False)
class SmoothMap:
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

    def to_plane(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the plane coordinates (N, 2), mm, of pixels (N, 2): the posterior mean."""
        return self.linearised(uv_px)[0]

    def jacobian(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N, 2, 2) d xy / d uv, mm/px."""
        return self.linearised(uv_px)[1]

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
        by_unit = np.stack([basis @ (by @ self._polynomial) for by in derivatives(QUINTIC)], axis=-1)
        moments = (self.dual[:, :, None] * self.controls_unit[:, None, :]).reshape(-1, 4)
        for variance, length in zip(self.kernel.variances_mm2, self.kernel.lengths, strict=True):
            near = variance * squared_exponential(d2, length)
            own = near @ self.dual
            xy += own  # and d exp(-|a - b|² / 2 l²) / da is that times (b - a) / l²
            by_unit += ((near @ moments).reshape(-1, 2, 2) - own[:, :, None] * at[:, None, :]) / length**2
        return xy, by_unit

    @cached_property
    def _polynomial(self) -> np.ndarray:
        """(21, 2): coefficients of the monomials to degree 5: the cubic, and the process's polynomial."""
        coefficients = self.kernel.polynomial_part(self.controls_unit, self.dual)
        coefficients[: len(self.cubic)] += self.cubic
        return coefficients

    def find_image(self, xy_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the plane coordinates (N, 2) that have one, and which do, (N,) bool."""
        return self._inverse.find(xy_mm)

    def to_image(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of plane coordinates (N, 2). Raises OutsideRegionError."""
        return self._inverse(xy_mm)

    @cached_property
    def _inverse(self) -> Inverse:
        return Inverse.of(self, self.controls_px)


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
