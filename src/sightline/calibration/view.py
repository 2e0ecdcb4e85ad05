"""The interface of a calibrated view (plane map and focal point with their joint covariance), and lines of sight."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from sightline.calibration.projection import Pencil
from sightline.common.checks import Check
from sightline.common.geometry.planes import Plane

# The sources of a line of sight's error; their covariances add up to the total.
SOURCES = ("beads", "map", "focal_point", "frame")


class PlaneMap(Protocol):
    """A smooth map between an image (IDCS, px) and a plane (mm)."""

    def to_plane(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the plane coordinates (N, 2), mm, of pixels (N, 2). Raises OutsideRegionError."""
        ...

    def to_image(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of plane coordinates (N, 2). Raises OutsideRegionError."""
        ...

    def find_image(self, xy_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the plane coordinates (N, 2) that have one, and which do, (N,) bool."""
        ...

    def jacobian(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N, 2, 2) d(to_plane) / d(uv), mm/px, at pixels (N, 2)."""
        ...

    def linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `to_plane` and `jacobian` at pixels (N, 2)."""
        ...


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
        d = self.points_mm - self.focal_point_mm
        return d / np.linalg.norm(d, axis=-1, keepdims=True)

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
