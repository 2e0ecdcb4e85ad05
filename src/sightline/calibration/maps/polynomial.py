"""Plane map: one polynomial per coordinate over the whole field (the paper's "global" compensation)."""

from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sightline.calibration.maps.hull import MAX_OUTSIDE
from sightline.calibration.view import PlaneMap
from sightline.common.fitting import exponents, minimum_norm, monomials, terms
from sightline.errors import CalibrationRefusedError, UnusableInputError

if TYPE_CHECKING:
    from scipy.spatial import KDTree

ITERATIONS = 10  # four are enough wherever a view is calibrated [calc]
# Steps below this end the iteration: the next would be its square times the map's curvature (1e-3 per px), 1e-9 px
# [calc].
CONVERGED_PX = 1e-3


class InvertibleMap(PlaneMap, Protocol):
    """A plane map with a derivative everywhere near its controls `controls_px` (M, 2), inverted by Newton's method."""

    controls_px: np.ndarray

    def find_image(self, xy_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the points (N, 2) that have one near the controls, and which do, (N,) bool.

        Each point starts at its nearest control.
        """
        controls_mm, back, tree = self._back
        (low_mm, high_mm), (low, high) = ((at.min(axis=0), at.max(axis=0)) for at in (controls_mm, self.controls_px))
        size = float((high - low).max())
        # Twice the limit for pixels: no usable map stretches by more than that outside its controls.
        at = np.flatnonzero(_within(xy_mm, low_mm, high_mm, 2 * MAX_OUTSIDE * float((high_mm - low_mm).max())))
        near = tree.query(xy_mm[at])[1]
        here = self.controls_px[near] + np.einsum("nij,nj->ni", back[near], xy_mm[at] - controls_mm[near])
        uv, length, converged = np.zeros((len(xy_mm), 2)), np.full(len(at), np.inf), np.zeros(len(xy_mm), dtype=bool)
        for _ in range(ITERATIONS):
            if not len(at):
                break
            xy, jacobian = self.linearised(here)
            (a, b), (c, d) = np.moveaxis(jacobian, 0, -1)
            x, y = (xy_mm[at] - xy).T
            determinant = a * d - b * c
            regular = np.abs(determinant) >= 1e-9 * (a * a + b * b + c * c + d * d)  # elsewhere the map folds
            step = np.stack([d * x - b * y, a * y - c * x], axis=1) / np.where(regular, determinant, 1.0)[:, None]
            before, length = length, np.hypot(*step.T)
            here = here + step * np.minimum(1.0, 0.25 * size / np.maximum(length, 1e-300))[:, None]
            # Converging steps shrink faster, and no point returns from far outside.
            converges = regular & (length < 0.5 * before) & _within(here, low, high, 1.25 * MAX_OUTSIDE * size)
            ended = converges & (length < CONVERGED_PX)
            uv[at], converged[at] = here, ended & _within(here, low, high, MAX_OUTSIDE * size)
            on = converges & ~ended
            at, here, length = at[on], here[on], length[on]
        return uv[converged], converged

    @cached_property
    def _back(self) -> tuple[np.ndarray, np.ndarray, "KDTree"]:
        """The controls (M, 2), mm, the inverse Jacobian (M, 2, 2) there, px/mm, and a tree of the controls."""
        from scipy.spatial import KDTree  # here: lines of sight need no inverse, and it takes 6 MB

        xy, jacobian = self.linearised(self.controls_px)
        return xy, np.linalg.pinv(jacobian), KDTree(xy)


def _within(points: np.ndarray, low: np.ndarray, high: np.ndarray, margin: float) -> np.ndarray:
    """Return (N,) bool: whether points (N, 2) lie in a box widened by `margin`."""
    inside = (points >= low - margin) & (points <= high + margin)
    return inside[:, 0] & inside[:, 1]


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


def monomial_gradients(xy: np.ndarray, degree: int) -> np.ndarray:
    """Return (N, terms, 2): derivatives of `monomials` by x and y."""
    return np.stack([monomials(xy, degree) @ by for by in derivatives(degree)], axis=-1)


@cache
def derivatives(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return two matrices (terms, terms) from a polynomial's coefficients to those of its derivatives by x and y."""
    powers = [tuple(p) for p in exponents(degree).T.tolist()]
    matrices = np.zeros((2, len(powers), len(powers)))
    for column, (i, j) in enumerate(powers):
        if i:
            matrices[0, powers.index((i - 1, j)), column] = i
        if j:
            matrices[1, powers.index((i, j - 1)), column] = j
    return matrices[0], matrices[1]


@dataclass(frozen=True, eq=False)
class PolynomialMap(InvertibleMap):
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

    def linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `to_plane` and `jacobian`."""
        basis = monomials(self.unit(uv_px), self.degree)
        by_unit = np.stack([basis @ (by @ self.coefficients) for by in derivatives(self.degree)], axis=-1)
        return basis @ self.coefficients, by_unit @ self.unit.matrix
