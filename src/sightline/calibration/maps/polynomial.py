"""Plane map: one polynomial per coordinate over the whole field (the paper's "global" compensation)."""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from sightline.calibration.maps.inverse import Inverse
from sightline.common.fitting import minimum_norm
from sightline.errors import CalibrationRefusedError, UnusableInputError

DEGREES = range(1, 8)


@dataclass(frozen=True, eq=False)
class Affine:
    """Affine normalisation of pixels to coordinates of about unit size: `(uv - centre_px) @ matrix.T`."""

    centre_px: np.ndarray
    matrix: np.ndarray

    @staticmethod
    def fit(uv_px: np.ndarray, xy_mm: np.ndarray) -> tuple["Affine", float]:
        """Return the least-squares affine map of controls (N, 2), scaled to the unit disc, and its radius, mm."""
        n = len(uv_px)
        centre = uv_px.sum(axis=0) / n
        off_px = uv_px - centre
        matrix = minimum_norm(off_px, xy_mm - xy_mm.sum(axis=0) / n).T
        mapped = off_px @ matrix.T
        radius = float(np.sqrt((mapped**2).sum(axis=1).max()))
        return Affine(centre, matrix / radius), radius

    @property
    def is_mirrored(self) -> bool:
        """Whether it changes the handedness."""
        (a, b), (c, d) = self.matrix.tolist()
        return a * d < b * c

    def __call__(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the unit coordinates (N, 2) of pixels (N, 2)."""
        return (uv_px - self.centre_px) @ self.matrix.T


def terms(degree: int) -> int:
    """Return the number of monomials of two variables up to a degree."""
    return (degree + 1) * (degree + 2) // 2


def monomials(xy: np.ndarray, degree: int) -> np.ndarray:
    """Return (N, terms): x^i y^j with i + j <= degree, by increasing degree."""
    powers = np.empty((degree + 1, 2, len(xy)))
    powers[0], powers[1:] = 1.0, np.transpose(xy)
    np.multiply.accumulate(powers, out=powers)
    i, j = _exponents(degree)
    return np.ascontiguousarray((powers[i, 0] * powers[j, 1]).T)


def monomial_gradients(xy: np.ndarray, degree: int) -> np.ndarray:
    """Return (N, terms, 2): derivatives of `monomials` by x and y."""
    return np.stack([monomials(xy, degree) @ by for by in derivatives(degree)], axis=-1)


@cache
def derivatives(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return two matrices (terms, terms) from a polynomial's coefficients to those of its derivatives by x and y."""
    powers = [tuple(p) for p in _exponents(degree).T.tolist()]
    matrices = np.zeros((2, len(powers), len(powers)))
    for column, (i, j) in enumerate(powers):
        if i:
            matrices[0, powers.index((i - 1, j)), column] = i
        if j:
            matrices[1, powers.index((i, j - 1)), column] = j
    return matrices[0], matrices[1]


@cache
def _exponents(degree: int) -> np.ndarray:
    """Return (2, terms): i and j of `monomials`."""
    return np.array([(d - j, j) for d in range(degree + 1) for j in range(d + 1)]).T


@dataclass(frozen=True, eq=False)
class PolynomialMap:
    """Plane coordinates as polynomials of normalised pixel coordinates; `coefficients` (terms, 2), mm.

    `inverse_design` (terms, N): the coefficients are this times the controls' coordinates.
    """

    degree: int
    unit: Affine
    coefficients: np.ndarray
    inverse_design: np.ndarray
    controls_px: np.ndarray

    @staticmethod
    def fit(uv_px: np.ndarray, xy_mm: np.ndarray, degree: int) -> "PolynomialMap":
        """Return the least-squares map of controls (N, 2).

        Raises CalibrationRefusedError where they do not determine it, UnusableInputError for an unknown degree.
        """
        if degree not in DEGREES:
            raise UnusableInputError(f"degree {degree} is not available; choose 1 to 7")
        if len(uv_px) < terms(degree):
            raise CalibrationRefusedError(
                f"{len(uv_px)} controls do not determine a polynomial of degree {degree} (at least {terms(degree)} are "
                "needed); choose a lower degree, or use the smooth method"
            )
        unit = Affine.fit(uv_px, xy_mm)[0]
        design = monomials(unit(uv_px), degree)
        inverse = np.linalg.pinv(design, rcond=1e-10)
        if np.linalg.matrix_rank(design, tol=1e-8 * np.sqrt(len(design))) < terms(degree):
            raise CalibrationRefusedError(
                f"the positions of the controls do not determine a polynomial of degree {degree}; choose a lower "
                "degree, or use the smooth method"
            )
        return PolynomialMap(degree, unit, inverse @ xy_mm, inverse, uv_px)

    def weights(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N, controls): to_plane(uv) = weights @ the controls' plane coordinates."""
        return monomials(self.unit(uv_px), self.degree) @ self.inverse_design

    def to_plane(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the plane coordinates (N, 2), mm, of pixels (N, 2)."""
        return monomials(self.unit(uv_px), self.degree) @ self.coefficients

    def jacobian(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N, 2, 2) d xy / d uv, mm/px."""
        return self.linearised(uv_px)[1]

    def linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `to_plane` and `jacobian`."""
        basis = monomials(self.unit(uv_px), self.degree)
        by_unit = np.stack([basis @ (by @ self.coefficients) for by in derivatives(self.degree)], axis=-1)
        return basis @ self.coefficients, by_unit @ self.unit.matrix

    def find_image(self, xy_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the plane coordinates (N, 2) that have one, and which do, (N,) bool."""
        return self._inverse.find(xy_mm)

    def to_image(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of plane coordinates (N, 2). Raises OutsideRegionError."""
        return self._inverse(xy_mm)

    @cached_property
    def _inverse(self) -> Inverse:
        return Inverse.of(self, self.controls_px)
