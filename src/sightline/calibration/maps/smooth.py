"""Plane map of the smooth method: a cubic plus a Gaussian process."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.calibration.maps.inverse import Inverse
from sightline.calibration.maps.polynomial import Affine, derivatives, monomial_gradients, monomials, terms
from sightline.calibration.maps.prior import NOISE_SCALES_PX, QUINTIC, Basis, Kernel, PriorData, learn
from sightline.calibration.maps.well_conditioned import well_conditioned
from sightline.errors import CalibrationRefusedError
from sightline.fitting.kriging import Kriging

DEGREE = 3
# With more controls a fit takes seconds and gigabytes: their covariance is dense [ours].
MAX_CONTROLS = 4000
# The hyper-parameters are learned from at most this many controls, drawn at random [ours].
LEARN_FROM = 250
BLOCK = 2**20  # kernel values held at once: 8 MB [ours]


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """`cubic` (10, 2) on normalised pixels plus kernel(., controls) @ `dual` (N, 2), mm.

    `basis`: of the controls' unit coordinates, None where nobody computed it.
    """

    unit: Affine
    kernel: Kernel
    cubic: np.ndarray
    dual: np.ndarray
    controls_px: np.ndarray
    basis: Basis | None

    @cached_property
    def controls_unit(self) -> np.ndarray:
        """(N, 2): the controls in unit coordinates."""
        return self.unit(self.controls_px)

    def to_plane(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the plane coordinates (N, 2), mm, of pixels (N, 2): the posterior mean."""
        if uv_px is self.controls_px:
            return self._at_controls[0]
        return np.concatenate([self._terms(at)[:, :2] for at in self._blocks(uv_px)])

    def jacobian(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N, 2, 2) d xy / d uv, mm/px."""
        return self.linearised(uv_px)[1]

    def linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `to_plane` and `jacobian`."""
        return self._at_controls if uv_px is self.controls_px else self._linearised(uv_px)

    @cached_property
    def _at_controls(self) -> tuple[np.ndarray, np.ndarray]:
        """`linearised` at the controls, read-only: residuals, checks and the inverse map ask for it."""
        if self.basis is None:
            xy, jacobian = self._linearised(self.controls_px)
        else:
            rough = np.concatenate([self.basis.rough[length] for length in self.kernel.lengths.tolist()], axis=1)
            xy, jacobian = self._of_terms(self._sums(self.basis.monomials, rough), self.controls_unit)
        xy.flags.writeable = jacobian.flags.writeable = False
        return xy, jacobian

    def _linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        blocks = self._blocks(uv_px)
        terms = [self._terms(at) for at in blocks]
        return self._of_terms(*(one[0] if len(blocks) == 1 else np.concatenate(one) for one in (terms, blocks)))

    def _of_terms(self, terms: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        by_unit = terms[:, 2:6].reshape(-1, 2, 2) - terms[:, 6:, None] * at[:, None, :]
        return terms[:, :2], (by_unit.reshape(-1, 2) @ self.unit.matrix).reshape(-1, 2, 2)

    def _terms(self, at: np.ndarray) -> np.ndarray:
        """Return (N, 8) at unit coordinates `at` (N, 2): xy (2), terms of its derivatives (4), and factors (2).

        The derivatives by the unit coordinates are the terms minus factor times `at`, since the derivative of
        exp(-|a - b|² / 2 l²) by a is that times (b - a) / l².
        """
        factors = np.ones((len(at), 4))
        factors[:, :2] = at
        np.einsum("ni,ni->n", at, at, out=factors[:, 2])
        rough = factors @ self._exponents
        np.exp(rough, out=rough)
        return self._sums(monomials(at, QUINTIC), rough)

    def _sums(self, whole: np.ndarray, rough: np.ndarray) -> np.ndarray:
        """Return `_terms` from monomials (N, 21) and exponentials (N, lengths * controls)."""
        return whole @ self._polynomial + rough @ self._rough

    @cached_property
    def _exponents(self) -> np.ndarray:
        """(4, lengths * N): takes (a, |a|², 1) to -|a - control|² / 2 length²."""
        b = self.controls_unit
        whole = np.vstack([-2 * b.T, np.ones(len(b)), (b**2).sum(axis=1)])
        return np.hstack([whole * (-0.5 / length**2) for length in self.kernel.lengths])

    @cached_property
    def _rough(self) -> np.ndarray:
        """(lengths * N, 8): coefficients of the process's exponentials in `_terms`."""
        own = np.empty((len(self.dual), 8))
        own[:, :2] = own[:, 6:] = self.dual
        own[:, 2:6] = (self.controls_unit[:, None, :] * self.dual[:, :, None]).reshape(-1, 4)
        out = np.empty((len(self.kernel.lengths), *own.shape))
        for k, (variance, length) in enumerate(zip(self.kernel.variances_mm2, self.kernel.lengths, strict=True)):
            out[k, :, :2], out[k, :, 2:] = variance * own[:, :2], variance / length**2 * own[:, 2:]
        return out.reshape(-1, 8)

    @cached_property
    def _polynomial(self) -> np.ndarray:
        """(21, 8): coefficients of the monomials in `_terms`: the cubic and the process's degrees 4 and 5."""
        whole = monomials(self.controls_unit, QUINTIC) if self.basis is None else self.basis.monomials
        out = np.zeros((whole.shape[1], 8))
        out[:, :2] = self.kernel.quintic_of(whole, self.dual)
        out[: len(self.cubic), :2] += self.cubic
        for k, by in enumerate(derivatives(QUINTIC)):
            out[:, 2 + k : 6 : 2] = by @ out[:, :2]
        return out

    def _blocks(self, uv_px: np.ndarray) -> list[np.ndarray]:
        """Return the unit coordinates in blocks, so that the kernel of millions of pixels is never held at once."""
        rows = max(1, BLOCK // self._exponents.shape[1])
        at = self.unit(uv_px)
        return [at[k : k + rows] for k in range(0, max(len(at), 1), rows)]

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
        data = PriorData(
            Basis.of(at[some]), design[some], np.zeros((len(some), 2, 0)), xy_mm[some], noise[some], 0.0, radius
        )
        learned = learn(data, NOISE_SCALES_PX if noise_px is None else None)
        covariance = learned.kernel(at, at) + np.diag(learned.noise_scale**2 * noise)
        solution = Kriging.of(design, covariance, xy_mm)
        return FittedSmoothMap(unit, learned.kernel, solution.theta, solution.dual, uv_px, None, solution)

    def covariance_mm2(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the posterior covariance (N, N), mm², of one plane coordinate at pixels (N, 2).

        x and y are independent and have the same covariance.
        """
        at = self.unit(uv_px)
        cross, prior = self.kernel(at, self.controls_unit), self.kernel(at, at)
        return self.solution.predict(monomials(at, DEGREE), cross, prior)[1]
