"""The bodies of a calibration frame, plates or a solid, and their fiducials. All coordinates are CFCS, mm.

A view also knows the nominal C-arm, which frames are designed and checked for; no result is computed with it.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from sightline.common.geometry.lines import unit
from sightline.common.geometry.planes import Plane

Shape = Literal["ball", "washer"]
ROLES = ("xrii", "source")
# physics.md, C-arm and image chain.
SOURCE_TO_HIP_MM = 620.0
SOURCE_TO_DETECTOR_MM = 1000.0  # ARCADIS Varic 968 [src manual]
FIELD_DIAMETER_MM = 215.0  # useful field of a 9 inch (229 mm) intensifier, its rim left out


@dataclass(frozen=True)
class Fiducial:
    """One bead: `xyz_mm` in CFCS; a `datum` is a marker that identifies the plate and its orientation."""

    id: str
    xyz_mm: tuple[float, float, float]
    diameter_mm: float
    datum: bool = False
    shape: Shape = "ball"


@dataclass(frozen=True)
class RigidBody:
    """Fiducials in one piece, in the order of the frame file: a plate, or a solid that every image shows."""

    fiducials: tuple[Fiducial, ...]

    @cached_property
    def ids(self) -> tuple[str, ...]:
        """The ids of the fiducials."""
        return tuple(f.id for f in self.fiducials)

    @cached_property
    def xyz_mm(self) -> np.ndarray:
        """(N, 3) coordinates, CFCS."""
        out = np.array([f.xyz_mm for f in self.fiducials], dtype=np.float64).reshape(-1, 3)
        out.flags.writeable = False
        return out

    @cached_property
    def diameter_mm(self) -> np.ndarray:
        """(N,) diameters."""
        out = np.array([f.diameter_mm for f in self.fiducials], dtype=np.float64)
        out.flags.writeable = False
        return out


@dataclass(frozen=True)
class Plate(RigidBody):
    """A body whose fiducials lie in one plane."""

    @cached_property
    def is_datum(self) -> np.ndarray:
        """(N,) bool: which fiducials are datums."""
        return np.array([f.datum for f in self.fiducials], dtype=bool)

    @cached_property
    def plane(self) -> Plane:
        """The least-squares plane of the beads."""
        return Plane.fit(self.xyz_mm)


@dataclass(frozen=True)
class FrameView:
    """The two plates of one view: `xrii` nearer to the intensifier, `source` nearer to the X-ray source."""

    xrii: Plate
    source: Plate

    @cached_property
    def fiducials(self) -> tuple[Fiducial, ...]:
        """All fiducials, XRII plate first: the order of every covariance of a view."""
        return self.xrii.fiducials + self.source.fiducials

    @cached_property
    def by_id(self) -> dict[str, Fiducial]:
        """Fiducials by id."""
        return {f.id: f for f in self.fiducials}

    @property
    def axis(self) -> np.ndarray:
        """The unit vector (3,) of the nominal beam from source to intensifier, through the plates' centroids."""
        return unit(self.xrii.xyz_mm.mean(axis=0) - self.source.xyz_mm.mean(axis=0))

    @property
    def nominal_focal_point_mm(self) -> np.ndarray:
        """The expected focal point (3,), with the hip at the origin."""
        return -SOURCE_TO_HIP_MM * self.axis

    def depth_mm(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return (N,): distances of points (N, 3) from the nominal source along the beam."""
        return (xyz_mm - self.nominal_focal_point_mm) @ self.axis

    def at_distance_mm(self, xyz_mm: np.ndarray, distance_mm: float) -> np.ndarray:
        """Return (N, 2): points (N, 3) in front of the nominal source, projected to a plane across the beam."""
        plane = Plane.across(self.axis, self.nominal_focal_point_mm)
        return plane.to_plane(xyz_mm) * (distance_mm / self.depth_mm(xyz_mm))[:, None]

    def in_field(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return (N,) bool: whether points (N, 3) lie between nominal source and intensifier, inside its field."""
        depth = self.depth_mm(xyz_mm)
        inside = (depth > 0) & (depth < SOURCE_TO_DETECTOR_MM)
        on_detector = self.at_distance_mm(xyz_mm[inside], SOURCE_TO_DETECTOR_MM)
        inside[inside] = np.linalg.norm(on_detector, axis=1) <= FIELD_DIAMETER_MM / 2
        return inside
