"""The beads of one view: image centres, coordinates in the frame, and the frame's errors there."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Self

import numpy as np

from sightline.calibration.maps.hull import refuse_collinear
from sightline.calibration.maps.polynomial import monomial_gradients
from sightline.common.fitting import minimum_norm, monomials, terms
from sightline.common.geometry.outlines import centroids
from sightline.common.geometry.planes import Plane
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, ObservationsError
from sightline.frame import Frame, Plate

MAX_DEGREE = 5  # leaves 0.004 px rms of 0.018 in the twin's images; degree 3 leaves 0.005 [twin]
BALLS_PER_TERM = 3  # at least [ours]; with fewer than 18 balls of a plate nothing is known of the bending
_FLOOR_PX = 0.05  # [ours] s.d. added to each centre's, for what the polynomial does not follow: no single ball rules it
_NEWTON_STEPS = 4  # [ours] from the nearest ball: over half a pitch the scale changes by a few per cent
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


# Noise assumed where none is stated and the beads are too few to estimate it: a careful click (physics.md, Picks).
UNKNOWN_NOISE_PX = 0.5
MIN_SD_PX, MAX_SD_PX = 1e-6, 1e3  # of a bead's centre: far below any measurement's, about the size of an image [ours]


@dataclass(frozen=True, eq=False)
class Beads:
    """N beads of one view, in the order of the frame: XRII plate first.

    `uv_px` (N, 2): images of their centres; `covariance_px2` (N, 2, 2), None where the noise is unknown; `xyz_mm`
    (N, 3), CFCS; `on_xrii` (N,) bool; `rows` (N,): their indices among the fiducials of the view; `radius_px` (N,) of
    their shadows, None where not measured.
    """

    frame: Frame
    view: str
    ids: tuple[str, ...]
    uv_px: np.ndarray
    covariance_px2: np.ndarray | None
    xyz_mm: np.ndarray
    on_xrii: np.ndarray
    rows: np.ndarray
    radius_px: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def plane(self) -> Plane:
        """The reference plane: that of the whole XRII plate, whichever of its beads were detected."""
        return self.frame.view(self.view).xrii.plane

    def where(self, keep: np.ndarray) -> "Beads":
        """Return the beads for which `keep` (N,) is true."""
        if keep.all():
            return self
        noise = None if self.covariance_px2 is None else self.covariance_px2[keep]
        ids = tuple(i for i, k in zip(self.ids, keep, strict=True) if k)
        return replace(
            self,
            ids=ids,
            uv_px=self.uv_px[keep],
            covariance_px2=noise,
            xyz_mm=self.xyz_mm[keep],
            on_xrii=self.on_xrii[keep],
            rows=self.rows[keep],
            radius_px=None if self.radius_px is None else self.radius_px[keep],
        )

    def frame_factor(self) -> np.ndarray:
        """Return the beads' rows (3N, K) of `Frame.error_factor`, mm."""
        whole = self.frame.error_factor[self.frame.rows(self.view)]
        return whole.reshape(-1, 3, whole.shape[1])[self.rows].reshape(-1, whole.shape[1])

    @cached_property
    def frame_covariance(self) -> np.ndarray:
        """(3N, 3N) covariance, mm², of the beads' coordinates in the frame."""
        rows = (3 * self.rows[:, None] + np.arange(3)).ravel()
        return _view_covariance(self.frame, self.view)[rows][:, rows]


@lru_cache(maxsize=16)
def _view_covariance(frame: Frame, view: str) -> np.ndarray:
    """Return the covariance (3M, 3M) of all beads of a view, the same for every image of the frame."""
    factor = frame.error_factor[frame.rows(view)]
    return factor @ factor.T


def match(observations: Observations, frame: Frame, view: str | None) -> Beads:
    """Return the observations joined with their frame, at the images of the beads' centres (`centres_px`). `view`: the
    expected view; None: that of the observations.

    Raises ObservationsError for another view, an unknown fiducial or an impossible covariance; FrameError where the
    frame has no such view; CalibrationRefusedError where fewer than 4 beads of a plate are seen, or all on one line.
    """
    if view is not None and view != observations.view:
        raise ObservationsError(
            f"the observations are of view {observations.view!r}, not {view!r}; "
            "check that the PA and the lateral image are not swapped"
        )
    frame_view = frame.view(observations.view)
    place, xyz_mm = _places(frame, observations.view)
    unknown = [i for i in observations.ids if i not in place]
    if unknown:
        raise ObservationsError(
            f"view {observations.view!r} of frame {frame.name!r} has no fiducial {', '.join(map(repr, unknown[:5]))}; "
            "check that the observations belong to this frame and view"
        )
    rows = np.array([place[i] for i in observations.ids], dtype=int)
    order = np.argsort(rows)
    rows = rows[order]
    noise = observations.covariance_px2
    if noise is not None:
        noise = noise[order]
        _refuse_stated(noise)
    xyz, uv = xyz_mm[rows], centres_px(observations, frame)[order]
    ids = tuple(observations.ids[k] for k in order.tolist())
    on_xrii = rows < len(frame_view.xrii.fiducials)
    radius = None if observations.radius_px is None else observations.radius_px[order]
    beads = Beads(frame, observations.view, ids, uv, noise, xyz, on_xrii, rows, radius)
    for mine, plate, name in ((on_xrii, frame_view.xrii, "XRII"), (~on_xrii, frame_view.source, "source")):
        _refuse_unusable(uv[mine], xyz[mine], plate, name)
    return beads


@lru_cache(maxsize=16)
def _places(frame: Frame, view: str) -> tuple[dict[str, int], np.ndarray]:
    """Return the row of each fiducial of a view by its id, and their coordinates (M, 3), mm."""
    fiducials = frame.view(view)
    xyz_mm = np.concatenate([fiducials.xrii.xyz_mm, fiducials.source.xyz_mm])
    return {fiducial.id: row for row, fiducial in enumerate(fiducials.fiducials)}, xyz_mm


def _refuse_stated(covariance_px2: np.ndarray) -> None:
    """Raise ObservationsError for covariances (N, 2, 2) that no measurement has and that give no usable weights."""
    u2, v2, uv = covariance_px2[:, 0, 0], covariance_px2[:, 1, 1], covariance_px2[:, 1, 0]
    middle, apart = (u2 + v2) / 2, np.hypot((u2 - v2) / 2, uv)
    smallest = float((middle - apart).min(initial=np.inf))
    largest = float((middle + apart).max(initial=0.0))
    if smallest < MIN_SD_PX**2 or largest > MAX_SD_PX**2:
        raise ObservationsError(
            f"a bead's stated error is not between {MIN_SD_PX:g} and {MAX_SD_PX:g} px in every direction; "
            "give variances in px²"
        )


def _refuse_unusable(uv_px: np.ndarray, xyz_mm: np.ndarray, plate: Plate, name: str) -> None:
    """Raise CalibrationRefusedError for a plate with too few beads detected for any method."""
    of = f"of the {len(plate.fiducials)} beads of the {name} plate"
    if len(xyz_mm) == 0:
        raise CalibrationRefusedError(
            f"none {of} is seen; both plates are needed: move the frame so that both lie in the field"
        )
    if len(xyz_mm) < 4:
        raise CalibrationRefusedError(
            f"only {len(xyz_mm)} {of} are seen (at least 4 are needed, 20 or more are good): move the frame so that "
            "more of the plate lies in the field"
        )
    for points, where in ((xyz_mm, "in the frame,"), (uv_px, "in the image,")):
        refuse_collinear(points, f"{where} the {len(points)} beads seen of the {name} plate")
