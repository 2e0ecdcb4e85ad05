"""The bodies of a calibration frame, plates or a solid, and their fiducials. All coordinates are CFCS, mm."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from sightline.common.geometry.planes import Plane

Shape = Literal["ball", "washer"]
ROLES = ("xrii", "source")


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
