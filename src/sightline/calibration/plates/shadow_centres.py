"""From the centroids of the balls' shadows to the images of their centres.

Distortion bends a shadow, so its centroid is not the image of the ball's centre: with an intensifier it is up to 0.1 px
off, alike for neighbouring balls, so that averaging does not remove it. A polynomial map from each plate to the image
shows how the rims of its balls are bent.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np

from sightline.calibration.maps.polynomial import monomial_gradients, monomials, terms
from sightline.common.fitting import minimum_norm
from sightline.common.geometry.outlines import centroids
from sightline.detection.results import Observations
from sightline.frame import Frame, Plate

MAX_DEGREE = 5  # leaves 0.004 px rms of 0.018 in the twin's images; degree 3 leaves 0.005 [twin]
BALLS_PER_TERM = 3  # at least [ours]; with fewer than 18 balls of a plate nothing is known of the bending
_FLOOR_PX = 0.05  # s.d. added to each centre's: what the polynomial does not follow [ours]
_NEWTON_STEPS = 4  # from the nearest ball; the scale changes little over half a pitch [ours]
_AROUND = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
_RIM = np.stack([np.cos(_AROUND), np.sin(_AROUND)], axis=-1)


@dataclass(frozen=True, eq=False)
class _Balls:
    """The M balls of a plate, the same for every image, at `xy_mm` (M, 2).

    Polynomials are of (xy - `centre_mm`) / `half_mm`; `basis` (M, terms): their monomials at the balls' centres, `rims`
    (M, K, terms): at points on the balls' rims.
    """

    xy_mm: np.ndarray
    centre_mm: np.ndarray
    half_mm: float
    degree: int
    basis: np.ndarray
    rims: np.ndarray

    @classmethod
    def of(cls, plate: Plate, degree: int) -> Self:
        """Return the balls of a plate for polynomials of a degree."""
        xy = plate.plane.to_plane(plate.xyz_mm)
        centre, half = xy.mean(axis=0), float(np.ptp(xy)) / 2
        at, reach = (xy - centre) / half, np.array([ball.diameter_mm for ball in plate.fiducials]) / (2 * half)
        rims = (at[:, None] + reach[:, None, None] * _RIM).reshape(-1, 2)
        rims_basis = monomials(rims, degree).reshape(len(xy), len(_RIM), -1)
        return cls(xy, centre, half, degree, monomials(at, degree), rims_basis)


@dataclass(frozen=True, eq=False)
class _PlateMap:
    """Polynomial map from a plate to pixels, fitted to its balls `on` (N,)."""

    balls: _Balls
    on: np.ndarray
    coefficients: np.ndarray

    @classmethod
    def fit(cls, balls: _Balls, on: np.ndarray, uv_px: np.ndarray, sd_px: np.ndarray) -> Self:
        """Return the map of the balls `on` (N,), weighted by the s.d. (N,) of their centres."""
        weight = 1.0 / sd_px[:, None]
        return cls(balls, on, minimum_norm(weight * balls.basis[on], weight * uv_px))

    def __call__(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2)."""
        return monomials(self._unit(xy_mm), self.balls.degree) @ self.coefficients

    def _unit(self, xy_mm: np.ndarray) -> np.ndarray:
        return (xy_mm - self.balls.centre_mm) / self.balls.half_mm

    def own_shift_px(self) -> np.ndarray:
        """Return (N, 2): `shift_px` of the balls that it is fitted to."""
        basis, rims = self.balls.basis, self.balls.rims
        bent = (rims.reshape(-1, rims.shape[2]) @ self.coefficients).reshape(*rims.shape[:2], 2)
        return centroids(bent[self.on]) - basis[self.on] @ self.coefficients

    def located(self, uv_px: np.ndarray, controls_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where pixels (N, 2) are on the plate, mm, and the scale there (N,), px/mm. `controls_px`: the plate's
        balls, the nearest of which are where to begin."""
        at = self.balls.xy_mm[self.on][np.linalg.norm(uv_px[:, None] - controls_px, axis=2).argmin(axis=1)]
        for _ in range(_NEWTON_STEPS):
            slopes = self._slopes(at)
            at = at + np.linalg.solve(slopes, (uv_px - self(at))[..., None])[..., 0]
        return at, np.sqrt(np.abs(np.linalg.det(self._slopes(at))))

    def _slopes(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return (N, 2, 2) d uv / d xy, px/mm."""
        gradients = monomial_gradients(self._unit(xy_mm), self.balls.degree)
        return np.einsum("nkd,kc->ncd", gradients, self.coefficients) / self.balls.half_mm

    def shift_px(self, xy_mm: np.ndarray, radius_mm: np.ndarray) -> np.ndarray:
        """Return (N, 2): the centroid of the image of each disc (N, 2) of the radius (N,), less its centre's image."""
        rim = xy_mm[:, None] + radius_mm[:, None, None] * _RIM
        return centroids(self(rim.reshape(-1, 2)).reshape(rim.shape)) - self(xy_mm)


def at_centres(seen: Observations, frame: Frame) -> Observations:
    """Return `seen` with the images of the balls' centres in place of the centroids of their shadows.

    Observations without `radius_px` are of points, and of a solid without a plate those of a flat panel: they stay as
    they are. So do the balls of a plate of which fewer than 18 are seen.
    """
    uv_px = centres_px(seen, frame)
    return seen if uv_px is seen.uv_px else replace(seen, uv_px=uv_px)


def centres_px(seen: Observations, frame: Frame) -> np.ndarray:
    """Return the pixels (N, 2) of `at_centres`."""
    if seen.radius_px is None:
        return seen.uv_px
    sd_px = np.full(len(seen), _FLOOR_PX)
    if seen.covariance_px2 is not None:
        sd_px = np.sqrt((seen.covariance_px2[:, 0, 0] + seen.covariance_px2[:, 1, 1]) / 2 + _FLOOR_PX**2)
    uv_px = seen.uv_px.copy()
    for k, plate in enumerate(_plates(frame, seen.view)):
        place = _place(frame, seen.view, k)
        on = np.array([place.get(name, -1) for name in seen.ids], dtype=int)
        mine = on >= 0
        degree = _degree(int(np.count_nonzero(mine)))
        if degree < 2:  # it could not bend
            continue
        bent = _PlateMap.fit(_balls(frame, seen.view, k, degree), on[mine], seen.uv_px[mine], sd_px[mine])
        uv_px[mine] -= bent.own_shift_px()
        if plate is frame.detector and not mine.all():  # all shadows fall through it
            at, per_mm = bent.located(seen.uv_px[~mine], seen.uv_px[mine])
            uv_px[~mine] -= bent.shift_px(at, seen.radius_px[~mine] / per_mm)
    return uv_px


def _degree(balls: int) -> int:
    """Return the degree of the polynomial that is fitted to so many balls."""
    return max((d for d in range(MAX_DEGREE + 1) if BALLS_PER_TERM * terms(d) <= balls), default=0)


@lru_cache(maxsize=32)
def _place(frame: Frame, view: str, plate: int) -> dict[str, int]:
    """Return the index of each ball of one of `_plates` by its id."""
    return {name: k for k, name in enumerate(_plates(frame, view)[plate].ids)}


@lru_cache(maxsize=32)
def _balls(frame: Frame, view: str, plate: int, degree: int) -> _Balls:
    """Return the balls of one of `_plates`; by the frame, because the hash of a plate takes long."""
    return _Balls.of(_plates(frame, view)[plate], degree)


def _plates(frame: Frame, view: str) -> tuple[Plate, ...]:
    """Return the plates whose balls an image of a view shows."""
    if frame.solid is not None:
        return () if frame.detector is None else (frame.detector,)
    return (frame.views[view].xrii, frame.views[view].source) if view in frame.views else ()
