"""Plane map: a cubic plus a Gaussian process."""

from dataclasses import dataclass

import numpy as np

from sightline.calibration.gaussian import Solution
from sightline.calibration.inverse import invert
from sightline.calibration.polynomial import Affine, monomial_gradients, monomials, terms
from sightline.calibration.prior import NOISE_SCALES_PX, Kernel, Problem, learn
from sightline.errors import CalibrationRefusedError

DEGREE = 3
# Beyond this many controls a fit takes seconds and gigabytes: V is dense [ours].
MOST_CONTROLS = 4000
# The hyper-parameters of many controls are learnt from this many of them, evenly drawn [ours].
LEARN_FROM = 250
BLOCK = 2**20  # numbers of a kernel held at once: 8 MB [ours]


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """`cubic` (10, 2) on normalised pixels plus kernel(., controls) @ `dual` (N, 2), mm."""

    unit: Affine
    kernel: Kernel
    cubic: np.ndarray
    dual: np.ndarray
    controls_px: np.ndarray

    @property
    def controls_unit(self) -> np.ndarray:
        """(N, 2) the controls in unit coordinates."""
        return self.unit(self.controls_px)

    def to_plane(self, uv_px: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) to plane coordinates (N, 2), mm: the posterior mean."""
        controls = self.controls_unit
        blocks = [
            monomials(at, DEGREE) @ self.cubic + self.kernel(at, controls) @ self.dual for at in self._blocks(uv_px)
        ]
        return np.concatenate(blocks)

    def jacobian(self, uv_px: np.ndarray) -> np.ndarray:
        """(N, 2, 2) d xy / d uv, mm/px."""
        controls = self.controls_unit
        blocks = [
            np.einsum("nkd,kc->ncd", monomial_gradients(at, DEGREE), self.cubic)
            + self.kernel.gradient(at, controls, self.dual)
            for at in self._blocks(uv_px)
        ]
        return np.concatenate(blocks) @ self.unit.matrix

    def _blocks(self, uv_px: np.ndarray) -> list[np.ndarray]:
        """Unit coordinates in parts, so that the kernel of millions of pixels is never held at once."""
        rows = max(1, BLOCK // len(self.controls_px))
        at = self.unit(uv_px)
        return [at[k : k + rows] for k in range(0, max(len(at), 1), rows)]

    def to_image(self, xy_mm: np.ndarray) -> np.ndarray:
        """Plane coordinates (N, 2) to pixels (N, 2), by Newton's method. Raises OutsideRegionError."""
        return invert(self, xy_mm, self.controls_px)


@dataclass(frozen=True, eq=False)
class FittedSmoothMap(SmoothMap):
    """A smooth map of controls that are all of one plane, with its posterior covariance."""

    solution: Solution

    @staticmethod
    def fit(uv_px: np.ndarray, xy_mm: np.ndarray, noise_px: float | None) -> "FittedSmoothMap":
        """Through controls (N, 2) whose pixels err by `noise_px` per axis (None: estimated).

        Raises CalibrationRefusedError.
        """
        n = len(uv_px)
        if not terms(DEGREE) + 2 <= n <= MOST_CONTROLS:
            raise CalibrationRefusedError(
                f"{n} controls given; the smooth method takes {terms(DEGREE) + 2} to {MOST_CONTROLS}: "
                + ("give more controls" if n < MOST_CONTROLS else "thin them out evenly, or use a polynomial")
            )
        unit, radius = Affine.fit(uv_px, xy_mm)
        at = unit(uv_px)
        design = monomials(at, DEGREE)
        cubic = np.linalg.lstsq(design, xy_mm, rcond=None)[0]
        slopes = np.einsum("nkd,kc->ncd", monomial_gradients(at, DEGREE), cubic) @ unit.matrix
        per_px2 = 0.5 * (slopes**2).sum(axis=(1, 2))
        some = np.arange(n) if n <= LEARN_FROM else np.random.default_rng(0).permutation(n)[:LEARN_FROM]
        noise = per_px2 if noise_px is None else per_px2 * noise_px**2
        problem = Problem(at[some], design[some], np.zeros((len(some), 2, 0)), xy_mm[some], noise[some], 0.0, radius)
        learned = learn(problem, NOISE_SCALES_PX if noise_px is None else None)
        covariance = learned.kernel(at, at) + np.diag(learned.noise_scale**2 * noise)
        solution = Solution.of(design, covariance, xy_mm)
        return FittedSmoothMap(unit, learned.kernel, solution.theta, solution.dual, uv_px, solution)

    def covariance_mm2(self, uv_px: np.ndarray) -> np.ndarray:
        """(N, N) posterior covariance of one plane coordinate at pixels (N, 2); x and y are independent and alike."""
        at = self.unit(uv_px)
        return self.solution.posterior(monomials(at, DEGREE), self.kernel(at, self.controls_unit), self.kernel(at, at))
