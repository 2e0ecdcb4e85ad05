"""Frame files (docs/frame-file.md) and frame specifications of XMALab: their schema, read with strict checks.

A frame specification of XMALab has a header line, then x, y, z of each ball, in mm or cm. The first line is never a
ball. A header of four or more cells of which the first three start with "s" gives factors of x, y and z
("s10,s10,s10,"); any other text is ignored ("x,y,z", "white"). Balls are numbered from 1 in file order, which is how
XMALab's references file names them. The format states neither a unit nor diameters.
"""

import csv
import re
from datetime import date
from io import StringIO
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from sightline.common.bounded import MAX_JSON_BYTES, read_bounded
from sightline.common.strict import explain, read_strictly
from sightline.common.tables import read_csv
from sightline.errors import FrameError
from sightline.frame.designs import FRAME_NAMES, SMALL_MM
from sightline.frame.plate import Fiducial, Shape

MIN_BEADS = 4  # the perspective image of a plate has eight unknowns: four balls
MIN_SOLID_BEADS = 6  # a view of a solid has 9 to 11 unknowns: six balls give twelve equations
MIN_DETECTOR_BEADS = 12  # the smooth map has ten unknowns for each coordinate
MAX_SOLID_BEADS = 200  # [ours] their labels are searched for without a pattern, in a time that grows with their cube

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


DIAMETER_MM = SMALL_MM  # the small Lego cube's are 3.2 mm, the large one's 5 mm
UNITS_MM = {"mm": 1.0, "cm": 10.0}
MAX_ACROSS_CM, MIN_ACROSS_MM = (
    40.0,
    50.0,
)  # [ours] diagonal of the box about the balls; between these the unit is unclear


def cube_document(text: str, name: str, diameter_mm: float = DIAMETER_MM, unit: str | None = None) -> dict[str, Any]:
    """Return a frame's document, unchecked, from the text of a frame specification.

    `unit`: mm or cm; None: by the size of the object. Raises FrameError.
    """
    header, *lines = list(csv.reader(StringIO(text, newline=""))) or [[]]
    if "id" in {cell.strip() for cell in header}:
        raise FrameError("it is a table of measured balls; make a frame of it: 'sightline frame new FILE --csv TABLE'")
    if _numbers(header[:3]) is not None:
        raise FrameError("the first line is a ball, which XMALab would skip; write a header line (x,y,z) above it")
    balls = [_ball(cells, line) for line, cells in enumerate(lines, 2) if any(cell.strip() for cell in cells)]
    if not balls:
        raise FrameError("the file has no ball below the header line; write x, y and z of each ball")
    xyz = np.array(balls) * _factors(header)
    if unit is None:
        unit = _unit(float(np.linalg.norm(np.ptp(xyz, axis=0))))
    if unit not in UNITS_MM:
        raise FrameError(f"the unit is {unit!r}; give mm or cm")
    xyz *= UNITS_MM[unit]
    return {
        "name": re.sub(r"[^\w.:+/-]", "-", name)[:64],
        "units": "mm",
        "solid": tuple(
            {"id": str(n), "xyz": tuple(place), "diameter": float(diameter_mm)}
            for n, place in enumerate(xyz.round(6).tolist(), 1)
        ),
    }


def _ball(cells: list[str], line: int) -> list[float]:
    values = _numbers(cells[:3])
    if values is None or any(cell.strip() for cell in cells[3:]):
        raise FrameError(f"line {line}: {','.join(cells)!r} is not a ball; write x, y and z, separated by commas")
    return values


def _numbers(cells: list[str]) -> list[float] | None:
    """Return three finite numbers, or None."""
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        return None
    return values if len(values) == 3 and all(map(isfinite, values)) else None


def _factors(header: list[str]) -> np.ndarray:
    """Return the factors (3,) of a header; ones where it states none."""
    cells = [cell.strip() for cell in header[:3]]
    if len(header) <= 3 or not all(cell.startswith("s") for cell in cells):
        return np.ones(3)
    if (factors := _numbers([cell[1:] for cell in cells])) is None or min(factors) <= 0:
        raise FrameError(f"the factors {','.join(cells)} in the header are not three numbers above zero; correct them")
    return np.array(factors)


def _unit(across: float) -> str:
    if MAX_ACROSS_CM < across < MIN_ACROSS_MM:
        raise FrameError(
            f"the balls are {across:.3g} units across, which may be mm or cm; state it with 'sightline frame new "
            "FILE --csv CUBE --units mm' (or cm)"
        )
    return "cm" if across <= MAX_ACROSS_CM else "mm"


ADVICE = {
    "extra_forbidden": "is not a key of the frame file; correct its spelling or remove it",
    "missing": "is missing; add it",
    "finite_number": "is not a finite number; leave out the ball if it could not be measured",
    "float_type": "is not a number; write it without quotes",
    "too_short": "has too few entries; a plate needs four fiducials, a position three numbers, a frame one view",
    "too_long": "has too many entries; a position is three numbers",
    "string_pattern_mismatch": "must be 1 to 64 letters, digits or any of _ . : + / -",
}


def read_document(path: Path) -> FrameDocument:
    """Return the document in a frame file, or in a frame specification of XMALab (CSV). Raises FrameError."""
    if not path.is_file():
        raise FrameError(
            f"there is no frame file {path.name!r}; give a file, or one of the built-in frames: "
            f"{', '.join(FRAME_NAMES)}"
        )
    if path.suffix.lower() == ".csv":
        return read_cube(path)
    data = read_bounded(path, MAX_JSON_BYTES, FrameError, "give a frame file")
    try:
        return document_from_json(data)
    except FrameError as error:
        raise FrameError(f"{path.name}: {error}") from None


def read_cube(path: Path, diameter_mm: float = DIAMETER_MM, unit: str | None = None) -> FrameDocument:
    """Return the document of a frame specification of XMALab, whose balls have one diameter. Raises FrameError.

    `unit`: mm or cm; None: by the size of the object.
    """
    text = read_csv(path, MAX_JSON_BYTES, FrameError, "give a frame specification of XMALab")
    try:
        return FrameDocument.model_validate(cube_document(text, path.stem, diameter_mm, unit))
    except ValidationError as error:
        raise FrameError(f"{path.name}: {explain(error, ADVICE)}") from None
    except (FrameError, csv.Error) as error:
        raise FrameError(f"{path.name}: {error}") from None


def document_from_json(text: bytes) -> FrameDocument:
    """Return the document in the text of a frame file. Raises FrameError."""
    return read_strictly(text, FrameDocument, FrameError, ADVICE)
