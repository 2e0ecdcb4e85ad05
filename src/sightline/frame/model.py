"""A calibration frame as data: views, plates, fiducials, tolerances. All coordinates are CFCS, mm."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Literal

import numpy as np

from sightline.errors import FrameError
from sightline.geometry.planes import Plane

Shape = Literal["ball", "washer"]
ROLES = ("xrii", "source")


@dataclass(frozen=True)
class Fiducial:
    """One bead: `xyz_mm` in CFCS; a `datum` is a marker that tells the plate and its orientation."""

    id: str
    xyz_mm: tuple[float, float, float]
    diameter_mm: float
    datum: bool = False
    shape: Shape = "ball"


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of a frame's errors: bead (independent), plate (its beads share it), arm (a view shares it).

    Defaults: physics.md, section Frame [ours].
    """

    bead_mm: float = 0.02
    plate_mm: float = 0.05
    plate_rad: float = 0.2e-3
    arm_mm: float = 0.1
    arm_rad: float = 0.3e-3


@dataclass(frozen=True)
class InUse:
    """What befalls a frame between its measurement and its use, one s.d. each: kelvin that the plates (PMMA) are warmer
    or colder, share of their mass taken up or given off as water, newtons of drapes on an arm."""

    warmer_k: float = 0.0
    water_share: float = 0.0
    drape_n: float = 0.0


@dataclass(frozen=True)
class Plate:
    """One calibration plate: its fiducials, in the order of the frame file."""

    fiducials: tuple[Fiducial, ...]

    @cached_property
    def ids(self) -> tuple[str, ...]:
        """The ids of the fiducials."""
        return tuple(f.id for f in self.fiducials)

    @cached_property
    def xyz_mm(self) -> np.ndarray:
        """(N, 3), CFCS."""
        out = np.array([f.xyz_mm for f in self.fiducials], dtype=np.float64).reshape(-1, 3)
        out.flags.writeable = False
        return out

    @cached_property
    def is_datum(self) -> np.ndarray:
        """(N,) bool."""
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
        """All fiducials, XRII plate first. This order is the order of every covariance of a view."""
        return self.xrii.fiducials + self.source.fiducials

    @cached_property
    def by_id(self) -> dict[str, Fiducial]:
        """Fiducials by id."""
        return {f.id: f for f in self.fiducials}


@dataclass(frozen=True, eq=False)
class Frame:
    """A calibration frame.

    `tolerances` is None where the file states none: then `effective_tolerances` are the defaults, and reports say so.
    `covariance_mm2` (3M, 3M), or None: full covariance of all bead coordinates, views in file order, in each
    view XRII before source; it replaces the tolerances. `in_use`: what is added to either, or None.
    """

    name: str
    views: dict[str, FrameView]
    serial: str | None = None
    measured_on: str | None = None
    temperature_c: float | None = None
    tolerances: Tolerances | None = None
    covariance_mm2: np.ndarray | None = field(default=None, repr=False)
    in_use: InUse | None = None

    @property
    def effective_tolerances(self) -> Tolerances:
        """The stated tolerances, or the defaults."""
        return self.tolerances or Tolerances()

    def view(self, name: str) -> FrameView:
        """The view called `name`. Raises FrameError, naming the views there are."""
        try:
            return self.views[name]
        except KeyError:
            known = ", ".join(self.views)
            raise FrameError(f"frame {self.name!r} has no view {name!r}; it has: {known}") from None

    def rows(self, view: str) -> slice:
        """Which rows of `error_factor` and `covariance_mm2` are the bead coordinates of one view."""
        start = 0
        for name, one in self.views.items():
            if name == view:
                return slice(start, start + 3 * len(one.fiducials))
            start += 3 * len(one.fiducials)
        raise FrameError(f"frame {self.name!r} has no view {view!r}; it has: {', '.join(self.views)}")

    @cached_property
    def error_factor(self) -> np.ndarray:
        """(3M, K) matrix L: the coordinates of all beads err by L @ e with K independent unit-variance numbers e.

        M beads, views in file order, in each view XRII before source. Bead errors are independent; a plate's shift and
        rotation (about the centroid of its beads) are shared by its beads; an arm's (about the centroid of the
        view's beads) by the view. With `covariance_mm2`, a factor of that; with `in_use`, columns more. mm.
        """
        from sightline.frame.tolerances import error_factor

        return error_factor(self)

    @property
    def key(self) -> str:
        """Tells this physical frame from others: name and serial."""
        return f"{self.name}/{self.serial or ''}"

    @cached_property
    def fingerprint(self) -> str:
        """Tells this frame as its file describes it from others: key, and a hash of the file.

        One frame measured twice has one key and two fingerprints: its coordinates differ.
        """
        from sightline.frame.files import frame_to_json

        return f"{self.key}#{sha256(frame_to_json(self)).hexdigest()[:16]}"

    @staticmethod
    def load(source: str | Path, before: "Iterable[Frame]" = ()) -> "Frame":
        """A frame from a JSON file, or "gamma", "biplane", "stereo".

        `before`: frames that were used earlier; the mirror image of one with the same name and serial is refused, since
        it would calibrate as well and mirror every point. Raises FrameError.
        """
        from sightline.frame.files import load_frame
        from sightline.frame.handed import refuse_mirror_image

        frame = load_frame(source)
        refuse_mirror_image(frame, before)
        return frame

    def save(self, path: str | Path) -> None:
        """Write the frame file of docs/frame-file.md."""
        from sightline.frame.files import save_frame

        save_frame(self, path)
