"""The plates of a frame as planar patterns of large and small fiducials, as labelling needs them."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from sightline.common.fitting import distances, exact_squares
from sightline.common.geometry.planes import Plane
from sightline.frame import Frame, Plate

NEIGHBOUR = 1.2  # pitches between neighbours at most, which excludes the diagonal of a square [ours]


@dataclass(frozen=True, eq=False)
class Pattern:
    """One plate of one view: `xy_mm` (N, 2) in `plane`'s axes, with the plate's centre as the origin.

    `neighbours` (M, 2): ordered pairs of neighbours; `pitch_mm`: their median distance.
    `bead_sd_mm`: s.d. per axis of each fiducial's own position error, relative to the frame file.
    """

    view: str
    role: str
    ids: tuple[str, ...]
    plane: Plane
    xyz_mm: np.ndarray
    xy_mm: np.ndarray
    diameter_mm: np.ndarray
    datum: np.ndarray
    washer: np.ndarray
    neighbours: np.ndarray
    pitch_mm: float
    bead_sd_mm: float

    @property
    def role_name(self) -> str:
        """The plate's name in a message."""
        return {"xrii": "XRII", "source": "source", "detector": "detector's"}[self.role]

    @cached_property
    def log_half(self) -> np.ndarray:
        """Log radii (N,), mm."""
        return np.log(self.diameter_mm / 2)

    @cached_property
    def log_sizes(self) -> np.ndarray:
        """The different values of `log_half` in order."""
        return np.log(np.unique(self.diameter_mm) / 2)

    @cached_property
    def size_of(self) -> np.ndarray:
        """Which of `log_sizes` each fiducial has (N,)."""
        return np.unique(self.diameter_mm, return_inverse=True)[1]

    @cached_property
    def z(self) -> np.ndarray:
        """`xy_mm` as complex numbers x + iy (N,)."""
        return self.xy_mm @ np.array([1.0, 1j])

    @cached_property
    def beyond_mm(self) -> np.ndarray:
        """Points (K, 3) of the grid one step beyond the plate's edge, mm."""
        steps = self.xy_mm[self.neighbours[:, 1]] - self.xy_mm[self.neighbours[:, 0]]
        steps = np.unique(np.round(steps / self.pitch_mm, 1), axis=0) * self.pitch_mm
        at = (self.xy_mm[:, None] + steps).reshape(-1, 2)
        at = np.unique(np.round(at / self.pitch_mm, 1), axis=0) * self.pitch_mm
        off2 = exact_squares(at, self.xy_mm).min(axis=1)
        return self.plane.to_space(at[off2 > (self.pitch_mm / 2) ** 2])

    @cached_property
    def neighbouring(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Both columns of `neighbours` (M,), and the points half-way between the two as complex numbers (M,)."""
        first, second = np.ascontiguousarray(self.neighbours.T)
        return first, second, (self.z[first] + self.z[second]) / 2

    @cached_property
    def datum_kind(self) -> str:
        """The kind as which its datum markers are detected: "washer" or "ball"."""
        return "washer" if self.washer[self.datums].all() else "ball"

    @cached_property
    def datums(self) -> np.ndarray:
        """Rows of the datum markers."""
        return np.flatnonzero(self.datum)


def _pattern(view: str, role: str, plate: Plate, factor: np.ndarray) -> Pattern:
    xy = plate.plane.to_plane(plate.xyz_mm)
    apart = distances(xy, xy)
    np.fill_diagonal(apart, np.inf)
    pitch = float(np.median(apart.min(axis=1)))
    pairs = np.argwhere(np.triu(apart <= NEIGHBOUR * pitch))
    return Pattern(
        view=view,
        role=role,
        ids=plate.ids,
        plane=plate.plane,
        xyz_mm=plate.xyz_mm,
        xy_mm=np.ascontiguousarray(xy),
        diameter_mm=np.array([f.diameter_mm for f in plate.fiducials]),
        datum=np.asarray(plate.is_datum),
        washer=np.array([f.shape == "washer" for f in plate.fiducials]),
        neighbours=np.concatenate([pairs, pairs[:, ::-1]]),
        pitch_mm=pitch,
        bead_sd_mm=_bead_sd_mm(xy, plate.plane, factor),
    )


def _bead_sd_mm(xy_mm: np.ndarray, plane: Plane, factor: np.ndarray) -> float:
    """Return the rms of a plate's errors (factor (3N, K)) in its plane, after removing an affine motion."""
    errors = np.einsum("ai,nik->ank", plane.axes, factor.reshape(len(xy_mm), 3, -1))
    whole = np.linalg.qr(np.column_stack([np.ones(len(xy_mm)), xy_mm]))[0]
    rest = errors - whole @ (whole.T @ errors)
    return float(np.sqrt((rest**2).sum() / (2 * (len(xy_mm) - 3))))


@lru_cache(maxsize=8)
def patterns(frame: Frame) -> tuple[Pattern, ...]:
    """Return the patterns of all views, in each view XRII before source."""
    every = []
    for name, view in frame.views.items():
        factor = frame.error_factor[frame.rows(name)]
        split = 3 * len(view.xrii.fiducials)
        every.append(_pattern(name, "xrii", view.xrii, factor[:split]))
        every.append(_pattern(name, "source", view.source, factor[split:]))
    return tuple(every)


@lru_cache(maxsize=8)
def detector_pattern(frame: Frame) -> Pattern:
    """Return the pattern of the plate on the detector, of a frame that has one."""
    assert frame.detector is not None  # noqa: S101 - the caller asks
    factor = frame.error_factor[3 * (len(frame.fiducials) - len(frame.detector.fiducials)) :]
    return _pattern("", "detector", frame.detector, factor)
