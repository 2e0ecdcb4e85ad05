"""The interface of a calibrated view (plane map and focal point with their joint covariance), and lines of sight."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from sightline.common.checks import Check
from sightline.common.geometry.lines import unit
from sightline.common.geometry.planes import Plane
from sightline.errors import CalibrationRefusedError, OutsideRegionError, UnusableInputError

# Limits for the ratio of a bead's height above the reference plane to that of F [ours]; 0.16 on a Γ frame's source
# plate. Beads as high as F have no image, and with none above the plane F is not determined.
MIN_SOURCE_DISTANCE = 0.05  # of 1 - ratio
MIN_PARALLAX = 0.01  # of |ratio|


@dataclass(frozen=True, eq=False)
class Pencil:
    """The pencil of lines through F = plane.origin + (p / q) @ axes + normal / q, as `pq` = (p_x, p_y, q).

    A point at x in the plane's axes and height h is projected to y = (x - h p) / (1 - h q): linear in p, nearly so in
    q, and regular for a focal point at infinity (q = 0), where F itself is not.
    """

    plane: Plane
    pq: np.ndarray

    @staticmethod
    def through(plane: Plane, focal_point_mm: np.ndarray) -> "Pencil":
        """Return the pencil of a focal point (3,), CFCS."""
        q = 1 / plane.height_mm(focal_point_mm)
        return Pencil(plane, np.append(q * plane.to_plane(focal_point_mm), q))

    @property
    def focal_point_mm(self) -> np.ndarray:
        """(3,) F, CFCS."""
        p, q = self.pq[:2], self.pq[2]
        return self.plane.origin_mm + (p / q) @ self.plane.axes + self.plane.normal / q

    @property
    def focal_point_by_pq(self) -> np.ndarray:
        """(3, 3): derivative of F by pq."""
        p, q = self.pq[:2], self.pq[2]
        by_q = -(p @ self.plane.axes + self.plane.normal) / q**2
        return np.column_stack([self.plane.axes.T / q, by_q])

    def project(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the plane coordinates (N, 2), mm, of points (N, 3), CFCS."""
        return self._placed(xyz_mm)[0]

    def by_pq(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return (N, 2, 3): the derivative of `project` by pq."""
        y, h, depth = self._placed(xyz_mm)
        derivative = np.zeros((len(y), 2, 3))
        derivative[:, 0, 0] = derivative[:, 1, 1] = -h / depth
        derivative[:, :, 2] = (h / depth)[:, None] * y
        return derivative

    def by_point(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return (N, 2, 3): the derivative of `project` by the points."""
        return self.projected(xyz_mm)[1]

    def projected(self, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return `project`, `by_point`, and (N,) the depth of the points from F over that of the plane."""
        y, _, depth = self._placed(xyz_mm)
        lift = self.pq[2] * y - self.pq[:2]
        return y, (self.plane.axes + lift[:, :, None] * self.plane.normal) / depth[:, None, None], depth

    def _placed(self, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return `project`, and the points' heights (N,), mm, and depths (N,) from F, over that of the plane."""
        h = self.plane.height_mm(xyz_mm)
        depth = 1 - h * self.pq[2]
        return (self.plane.to_plane(xyz_mm) - h[:, None] * self.pq[:2]) / depth[:, None], h, depth


def refuse_misplaced(pencil: Pencil, xyz_mm: np.ndarray) -> None:
    """Raise CalibrationRefusedError for a focal point between the planes of the beads (N, 3) or at infinity.

    It may lie on either side of both planes.
    """
    ratio = pencil.plane.height_mm(xyz_mm) * pencil.pq[2]
    largest, smallest = float(ratio.max()), float(ratio.min())
    if not 1 - largest > MIN_SOURCE_DISTANCE:
        raise CalibrationRefusedError(
            "the beads put the X-ray source between the plates; check that the labels of the two plates are not "
            "exchanged, and that frame and view are those in the image"
        )
    if not max(largest, -smallest) > MIN_PARALLAX:
        raise CalibrationRefusedError(
            "the beads put the X-ray source at infinity: the plates' images show no parallax; check that both plates "
            "are in the image and that their distance in the frame file is correct"
        )


# The sources of a line of sight's error; their covariances add up to the total.
SOURCES = ("beads", "map", "focal_point", "frame")


def finite_pixels(uv_px: np.ndarray) -> np.ndarray:
    """Return pixels (N, 2) as float64. Raises UnusableInputError for another shape and values that are not finite."""
    uv = np.asarray(uv_px, dtype=np.float64)
    if uv.ndim != 2 or uv.shape[1] != 2 or not np.isfinite(uv).all():
        raise UnusableInputError(f"give finite pixels of the shape (N, 2); got the shape {uv.shape}")
    return uv


class PlaneMap(Protocol):
    """A smooth map between an image (IDCS, px) and a plane (mm)."""

    def linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `to_plane` and `jacobian` at pixels (N, 2)."""
        ...

    def to_plane(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the plane coordinates (N, 2), mm, of pixels (N, 2). Raises OutsideRegionError."""
        return self.linearised(uv_px)[0]

    def jacobian(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N, 2, 2) d(to_plane) / d(uv), mm/px, at pixels (N, 2)."""
        return self.linearised(uv_px)[1]

    def find_image(self, xy_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the plane coordinates (N, 2) that have one, and which do, (N,) bool."""
        ...

    def to_image(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of plane coordinates (N, 2). Raises OutsideRegionError where there is none."""
        target = np.asarray(xy_mm, dtype=np.float64)
        uv, mapped = self.find_image(target)
        if not mapped.all():
            where = ", ".join(f"({x:.1f}, {y:.1f})" for x, y in target[~mapped][:3])
            raise OutsideRegionError(
                f"{(~mapped).sum()} points lie outside the region the beads calibrate (plane coordinates {where} mm); "
                "choose points inside the beads' convex hull, or move the frame"
            )
        return uv


class Deferred(Mapping[str, np.ndarray]):
    """A mapping that `compute` returns when it is first read: a line of sight is often needed without its errors."""

    def __init__(self, compute: Callable[[], Mapping[str, np.ndarray]]) -> None:
        self._compute = compute

    @cached_property
    def _content(self) -> Mapping[str, np.ndarray]:
        return self._compute()

    def __getitem__(self, key: str) -> np.ndarray:
        """Return one value."""
        return self._content[key]

    def __iter__(self) -> Iterator[str]:
        """Return the keys."""
        return iter(self._content)

    def __len__(self) -> int:
        """Return the number of keys."""
        return len(self._content)


@dataclass(frozen=True, eq=False)
class LinesOfSight:
    """The lines of sight of N pixels of one view, CFCS.

    Line i runs from `focal_point_mm` (3,) through `points_mm` (N, 3), which lie in `plane` at `xy_mm` (N, 2).
    `jacobian` (N, 2, 2) is d xy / d uv, mm/px: it propagates a pick's covariance to the plane.
    `covariance`: for each of SOURCES the (3 + 2N, 3 + 2N) covariance, mm², of (focal point, xy of line 1, ..., xy of
    line N), without the picks' own noise; None where the error is unknown.
    `shared`: for each source whose errors other views share, the response (3 + 2N, K) of the same numbers to its K
    independent unit-variance errors: covariance[s] includes shared[s] @ shared[s].T, and the cross-covariance of two
    views a and b is the sum of a.shared[s] @ b.shared[s].T over `a.sources_shared_with(b)`. The errors of "frame" are
    those of `Frame.error_factor`; other sources are shared by the views of one `adjustment` only. Empty without a
    frame. `frame_key`: `Frame.fingerprint`, None for a view without a frame; views with different keys are not
    combined.
    `inside_hull` (N,) bool: within the convex hull of the beads. `upright`: whether the image shows the frame file's
    beads not mirrored, with a display allowed for that a person stated to be mirrored; None without a frame.
    `count_beads`: computes `beads_near`; None without a frame.
    """

    view: str
    plane: Plane
    focal_point_mm: np.ndarray
    xy_mm: np.ndarray
    jacobian: np.ndarray
    covariance: Mapping[str, np.ndarray] | None
    shared: Mapping[str, np.ndarray]
    frame_key: str | None
    inside_hull: np.ndarray
    upright: bool | None = None
    count_beads: Callable[[], np.ndarray] | None = None
    adjustment: str | None = None

    @cached_property
    def beads_near(self) -> np.ndarray | None:
        """(N, 3) int: of the frame's beads nearest to each pixel, how many the calibration uses, how many seem to be
        hidden, and how many the image should show (`Support`); None without a frame."""
        return None if self.count_beads is None else self.count_beads()

    @cached_property
    def total_covariance(self) -> np.ndarray | None:
        """The sum of `covariance` over its sources; None where the error is unknown."""
        return None if self.covariance is None else np.sum(list(self.covariance.values()), axis=0)

    @cached_property
    def pencil(self) -> Pencil:
        """The pencil of lines through the focal point."""
        return Pencil.through(self.plane, self.focal_point_mm)

    @cached_property
    def points_mm(self) -> np.ndarray:
        """(N, 3) on the reference plane, CFCS."""
        return self.plane.to_space(self.xy_mm)

    @cached_property
    def directions(self) -> np.ndarray:
        """(N, 3) unit vectors from the focal point to the points on the plane."""
        return unit(self.points_mm - self.focal_point_mm)

    def sources_shared_with(self, other: "LinesOfSight") -> list[str]:
        """Return the sources whose errors are the same in both views."""
        together = self.adjustment == other.adjustment
        common = [source for source in self.shared if source in other.shared]
        return [source for source in common if together or (source == "frame" and self.frame_key == other.frame_key)]

    def first(self, count: int) -> "LinesOfSight":
        """Return the first `count` lines with their part of the covariance."""
        each, kept = self.covariance, 3 + 2 * count
        return replace(
            self,
            xy_mm=self.xy_mm[:count],
            jacobian=self.jacobian[:count],
            covariance=None if each is None else {source: c[:kept, :kept] for source, c in each.items()},
            shared={source: response[:kept] for source, response in self.shared.items()},
            inside_hull=self.inside_hull[:count],
            count_beads=None if (counted := self.count_beads) is None else lambda: counted()[:count],
        )


class CalibratedView(Protocol):
    """One image with its geometry: the only interface of a view that planning and later stages use.

    >>> pa, lateral = sl.load("out/demo/views.json")
    >>> lines = pa.lines_of_sight([[512.0, 512.0]])
    >>> lines.points_mm.shape
    (1, 3)
    >>> ax = pa.plot()  # residuals as arrows
    """

    @property
    def name(self) -> str:
        """ "pa", "lateral", or another view of the frame."""
        ...

    @property
    def method(self) -> str:
        """ "smooth", "polynomial", "localized", or "matrix"."""
        ...

    @property
    def focal_point_mm(self) -> np.ndarray:
        """(3,) the effective focal point, CFCS."""
        ...

    @property
    def checks(self) -> tuple[Check, ...]:
        """The checks of the calibration."""
        ...

    def project(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of points (N, 3), CFCS. Raises OutsideRegionError."""
        ...

    def project_seen(self, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the points (N, 3), CFCS, that `project` accepts, and which, (N,) bool."""
        ...

    def lines_of_sight(self, uv_px: np.ndarray) -> LinesOfSight:
        """Return the lines of sight of pixels (N, 2). Raises OutsideRegionError."""
        ...


@dataclass(frozen=True, eq=False)
class LineErrors:
    """Errors of (focal point, xy of line 1, ..., xy of line N), 3 + 2N numbers, mm.

    `noise`, `misfit` (3 + 2N, 3 + 2N): covariances from the beads' measurement and from the map's own misfit.
    `frame_factor` (3 + 2N, K): response to the unit-variance errors of `Frame.error_factor`.
    """

    noise: np.ndarray
    misfit: np.ndarray
    frame_factor: np.ndarray

    def shared(self) -> dict[str, np.ndarray]:
        """Return `LinesOfSight.shared`: views of one frame share its errors."""
        return {"frame": self.frame_factor}

    def by_source(self) -> dict[str, np.ndarray]:
        """Return the covariance for each of `view.SOURCES`; they add up to the total, and none has negative variances.

        "beads" and "map" are conditional on the focal point; "focal_point" is what its uncertainty adds.
        """
        own = self.noise + self.misfit
        gain = own[:, :3] @ _pseudo_inverse(own[:3, :3])  # (3 + 2N, 3): regression on the focal point
        rest = np.eye(len(own))
        rest[:, :3] -= gain
        return {
            "beads": _symmetric(rest @ self.noise @ rest.T),
            "map": _symmetric(rest @ self.misfit @ rest.T),
            "focal_point": _symmetric(gain @ own[:3, :3] @ gain.T),
            "frame": self.frame_factor @ self.frame_factor.T,
        }


def _pseudo_inverse(covariance: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse of a covariance that may be singular or zero."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-15 * values[-1]
    return (vectors[:, kept] / values[kept]) @ vectors[:, kept].T


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)


class StatedErrors(Protocol):
    """Errors of (focal point, xy of line 1, ..., xy of line N), 3 + 2N numbers, mm."""

    def by_source(self) -> dict[str, np.ndarray]:
        """Return the covariance (3 + 2N, 3 + 2N) for each of `view.SOURCES`; they add up to the total."""
        ...

    def shared(self) -> dict[str, np.ndarray]:
        """Return `LinesOfSight.shared`, (3 + 2N, K) for each source whose errors other views share."""
        ...


class Posterior(Protocol):
    """A method's fit, which states the errors of its lines of sight."""

    def line_errors(self, uv_px: np.ndarray) -> StatedErrors:
        """Return the errors of focal point and lines of sight of pixels (N, 2)."""
        ...


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of N beads of a view, on the reference plane, mm.

    `residual_mm` (N, 2): the bead's place by the map minus its place by the frame. `leave_one_out_mm` (N, 2): the same
    without the bead in the calibration; `predicted` (N,) bool: False in rows that are not valid because the method
    cannot predict the bead without itself. `sigma` (N,): length of the leave-one-out error over its own standard
    deviation. `used` (N,) bool: False where the bead was left out as wrong.
    """

    ids: tuple[str, ...]
    uv_px: np.ndarray
    residual_mm: np.ndarray
    leave_one_out_mm: np.ndarray
    predicted: np.ndarray
    sigma: np.ndarray
    used: np.ndarray

    def __post_init__(self) -> None:
        for name in ("uv_px", "residual_mm", "leave_one_out_mm", "predicted", "sigma", "used"):
            getattr(self, name).flags.writeable = False

    @property
    def left_out(self) -> tuple[str, ...]:
        """Ids of the beads left out as wrong."""
        return tuple(i for i, used in zip(self.ids, self.used, strict=True) if not used)

    @property
    def rms_mm(self) -> float:
        """Rms residual per axis over the beads used: 0.7 times the rms of the residuals' lengths."""
        return float(np.sqrt(np.mean(self.residual_mm[self.used] ** 2)))

    @property
    def leave_one_out_rms_mm(self) -> float:
        """Rms leave-one-out error per axis over the beads that were used and could be predicted."""
        rows = self.used & self.predicted
        return float(np.sqrt(np.mean(self.leave_one_out_mm[rows] ** 2)))
