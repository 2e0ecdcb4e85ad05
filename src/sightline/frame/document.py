"""The schema of a frame file."""

from datetime import date
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from sightline.frame.plate import Fiducial, Shape

MIN_BEADS = 4  # the perspective image of a plate has eight unknowns: four balls
MIN_SOLID_BEADS = 6  # a view of a solid has 9 to 11 unknowns: six balls give twelve equations
MIN_DETECTOR_BEADS = 12  # the smooth map has ten unknowns for each coordinate
MAX_SOLID_BEADS = 200  # [ours] their labels are searched for without a pattern

Number = Annotated[float, Field(allow_inf_nan=False)]
# [ours] ten metres: a larger number is not a coordinate of a frame in any unit
Coordinate = Annotated[float, Field(allow_inf_nan=False, ge=-1e4, le=1e4)]
Sd = Annotated[float, Field(allow_inf_nan=False, ge=0)]
Name = Annotated[str, Field(pattern=r"^[\w.:+/-]{1,64}$")]


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class FiducialDocument(_Strict):
    """One ball or washer: `xyz` in CFCS and `diameter`, mm."""

    id: Name
    xyz: tuple[Coordinate, Coordinate, Coordinate]
    diameter: Coordinate
    datum: bool = False
    shape: Shape = "ball"

    @field_validator("diameter")
    @classmethod
    def _above_zero(cls, value: float) -> float:
        if value <= 0:
            raise ValueError(f"is {value:g}; give a diameter above zero, in mm")
        return value


PlateDocument = Annotated[tuple[FiducialDocument, ...], Field(min_length=MIN_BEADS)]


class ViewDocument(_Strict):
    """The two plates of a view."""

    xrii: PlateDocument
    source: PlateDocument


class SdMm(_Strict):
    """Standard deviations, mm; of a solid that of its beads alone."""

    bead: Sd
    plate: Sd = 0.0
    arm: Sd = 0.0


class SdRad(_Strict):
    """Standard deviations, rad."""

    plate: Sd
    arm: Sd


class InUseDocument(_Strict):
    """Handling errors added to a frame's errors, 1 s.d. each; limits are far beyond the use of PMMA frames [ours]."""

    warmer_k: Annotated[float, Field(allow_inf_nan=False, ge=0, le=50)]
    water_share: Annotated[float, Field(allow_inf_nan=False, ge=0, le=0.03)]
    drape_n: Annotated[float, Field(allow_inf_nan=False, ge=0, le=1000)]


class FrameDocument(_Strict):
    """A frame file."""

    name: Name
    units: str
    views: dict[Name, ViewDocument] = Field(default_factory=dict)
    solid: Annotated[tuple[FiducialDocument, ...], Field(max_length=MAX_SOLID_BEADS)] | None = None
    detector: Annotated[tuple[FiducialDocument, ...], Field(min_length=MIN_DETECTOR_BEADS)] | None = None
    serial: Annotated[str, Field(max_length=200)] | None = None
    measured_on: date | None = None
    temperature_c: Number | None = None
    sd_mm: SdMm | None = None
    sd_rad: SdRad | None = None
    covariance_mm2: list[list[Number]] | None = None
    in_use: InUseDocument | None = None

    @field_validator("units")
    @classmethod
    def _millimetres(cls, value: str) -> str:
        if value != "mm":
            raise ValueError(f'is {value!r}; convert all coordinates and diameters to millimetres and write "mm"')
        return value

    @model_validator(mode="after")
    def _whole(self) -> Self:
        self._refuse_mixture()
        ids = [f.id for view in self.views.values() for f in (*view.xrii, *view.source)] + [
            f.id for f in (*(self.solid or ()), *(self.detector or ()))
        ]
        if twice := sorted({i for i in ids if ids.count(i) > 1}):
            raise ValueError(f"the fiducial id {twice[0]!r} occurs twice; give every ball of the frame a unique id")
        if self.covariance_mm2 is not None:
            if self.sd_mm is not None:
                raise ValueError('"covariance_mm2" replaces the tolerances; remove it, or "sd_mm" and "sd_rad"')
            _check_covariance(self.covariance_mm2, 3 * len(ids))
        return self

    def _refuse_mixture(self) -> None:
        """Raise ValueError unless the frame has plates with all their tolerances, or a solid with its own."""
        if (self.solid is None) == (not self.views):
            raise ValueError('give the plates of one view or more in "views", or the beads of a "solid", not both')
        if self.solid is not None:
            if len(self.solid) < MIN_SOLID_BEADS:
                raise ValueError(f'has {len(self.solid)} beads in "solid"; give {MIN_SOLID_BEADS} or more')
            if self.sd_rad is not None or (self.sd_mm is not None and self.sd_mm.model_fields_set != {"bead"}):
                raise ValueError('is a solid, which has no plates and no arms; state "sd_mm": {"bead": ...} alone')
            return
        if self.detector is not None:
            raise ValueError('has plates in "views"; a plate on the "detector" goes with a "solid"')
        for key in ("plate", "arm"):
            if self.sd_mm is not None and key not in self.sd_mm.model_fields_set:
                raise ValueError(f"sd_mm.{key} is missing; add it")
        if (self.sd_mm is None) != (self.sd_rad is None):
            raise ValueError('give both "sd_mm" and "sd_rad" for tolerances: add the missing one, or remove both')


def _check_covariance(rows: list[list[float]], size: int) -> None:
    """Raise ValueError unless symmetric and positive semi-definite up to the rounding of six printed digits."""
    if len(rows) != size or any(len(row) != size for row in rows):
        raise ValueError(
            f"covariance_mm2 must be {size} x {size}: x, y, z of every ball in file order, XRII plate first"
        )
    matrix = np.array(rows)
    scale = np.abs(matrix).max()
    if np.abs(matrix - matrix.T).max() > 1e-6 * scale:
        raise ValueError("covariance_mm2 is not symmetric; entry [i][j] must equal [j][i]")
    smallest = np.linalg.eigvalsh(matrix)[0]
    if smallest < -1e-6 * scale:
        raise ValueError(
            f"covariance_mm2 is not positive semi-definite (smallest eigenvalue {smallest:.3g} mm²); write more "
            "digits, or compute it from measured samples"
        )


def fiducials_of(fiducials: tuple[FiducialDocument, ...]) -> tuple[Fiducial, ...]:
    """Return the fiducials that a valid document describes."""
    return tuple(Fiducial(f.id, f.xyz, f.diameter, f.datum, f.shape) for f in fiducials)
