"""Tables of balls (CSV): measured frames (docs/frame-file.md), and measurements to be fitted (docs/own-frame.md)."""

import csv
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError
from scipy.linalg import block_diag

from sightline.common.bounded import MAX_JSON_BYTES
from sightline.common.strict import explain
from sightline.common.tables import Row, read_csv, read_rows
from sightline.errors import FrameError
from sightline.frame.document import ADVICE, DIAMETER_MM, FrameDocument, read_cube
from sightline.frame.model import Frame
from sightline.frame.plate import ROLES
from sightline.frame.tolerances import Tolerances

_XYZ = ("x_mm", "y_mm", "z_mm")
_SD = ("sd_mm",)
_SD_PER_AXIS = ("sd_x_mm", "sd_y_mm", "sd_z_mm")
_COVARIANCE = ("xx_mm2", "xy_mm2", "xz_mm2", "yy_mm2", "yz_mm2", "zz_mm2")
# Of a frame: view and plate are both left out for a solid.
_PLATE, _BALL, _OPTIONAL = ("view", "plate"), ("id", *_XYZ, "diameter_mm"), ("datum", "shape", *_SD, *_COVARIANCE)
_TRUTH = {"": False, "0": False, "false": False, "no": False, "1": True, "true": True, "yes": True}
# Columns of the inspection sheet with nominal values, not measurements.
SHEET_ONLY = (
    "view", "plate", "nominal_x_mm", "nominal_y_mm", "nominal_z_mm", "nominal_diameter_mm", "tolerance_mm", "remark",
)  # fmt: skip
_MEASURED = ("series", "diameter_mm", *_SD, *_SD_PER_AXIS, *_COVARIANCE, *SHEET_ONLY)
_COORDINATE = re.compile(r"^([xyz])(?:[ _]*[\[(]?([a-zµ\"]+)[\])]?)?$")

MIN_SD_MM, MAX_SD_MM = 1e-5, 10.0  # of a measured centre: better than an interferometer, worse than a ruler [ours]


def _covariance(row: Row, ways: Sequence[tuple[str, ...]]) -> np.ndarray | None:
    """Return the covariance (3, 3) of a row's ball, mm², stated in one of several ways; None without one."""
    stated = [way for way in ways if any(map(row.text, way))]
    if not stated:
        return None
    (way, *others) = stated
    if others or not all(map(row.text, way)):
        names = ", or ".join(", ".join(each) for each in ways)
        raise row.error(f"state a ball's error in one way, with all of its columns: {names}")
    values = [row.number(column) for column in way]
    if way is not _COVARIANCE:
        if min(values) < 0:
            raise row.error(f"{way[0]} is {min(values):g}; give an error above zero")
        return np.diag(np.broadcast_to([value * value for value in values], 3))
    xx, xy, xz, yy, yz, zz = values
    return np.array([(xx, xy, xz), (xy, yy, yz), (xz, yz, zz)])


def _rows(
    file: Path, needed: Sequence[str], optional: Collection[str], column: Callable[[str], str] = str.strip
) -> list[Row]:
    """Return the rows of a table. `column`: returns a header cell's column name. Raises FrameError."""
    columns, rows = read_rows(file, MAX_JSON_BYTES, FrameError, "give a table of balls as CSV", column)
    if missing := [name for name in needed if name not in columns]:
        raise FrameError(f"{file.name} lacks the columns {', '.join(missing)}; give {', '.join(needed)}")
    if unknown := [name for name in columns if name not in (*needed, *optional)]:
        raise FrameError(f"{file.name} has the unknown column {unknown[0]!r}; it may have {', '.join(optional)}")
    return rows


def _all_or_none(blocks: Sequence[np.ndarray | None]) -> list[np.ndarray]:
    """Return the covariances of all balls; none where no ball states one. Raises FrameError."""
    stated = [block for block in blocks if block is not None]
    if stated and len(stated) < len(blocks):
        raise FrameError("some balls state an error and some do not; fill in the columns for all balls or for none")
    return stated


def frame_from_csv(path: str | Path, name: str, diameter_mm: float | None = None, unit: str | None = None) -> Frame:
    """Return a frame of measured balls; without the columns `view` and `plate`, a solid. Raises FrameError.

    Errors stated in the table (`sd_mm`, or a covariance) replace the default bead tolerance. The default plate and arm
    tolerances remain, since the frame deforms after its measurement (load, moisture expansion).

    A CSV with none of the columns is a frame specification of XMALab: `diameter_mm` of its balls (default 3) and its
    `unit`, mm or cm (default: by its size), hold for that alone.
    """
    file = Path(path)
    text = read_csv(file, MAX_JSON_BYTES, FrameError, "give a table of measured balls as CSV")
    columns = {cell.strip() for cell in text.partition("\n")[0].split(",")}
    if not columns & {*_PLATE, *_BALL, *_OPTIONAL}:
        cube = read_cube(file, DIAMETER_MM if diameter_mm is None else diameter_mm, unit)
        return replace(Frame.from_document(cube), name=name)
    if diameter_mm is not None or unit is not None:
        raise FrameError(f"{file.name} states its diameters in mm; leave out --diameter-mm and --units")
    rows = _rows(file, (*_PLATE, *_BALL) if columns & set(_PLATE) else _BALL, _OPTIONAL)
    try:
        frame = Frame.from_document(FrameDocument.model_validate(_document(rows, name)))
    except ValidationError as error:
        raise FrameError(f"{file.name}: {explain(error, ADVICE)}") from None
    row_of = {row.text("id"): row for row in rows}
    stated = _all_or_none([_covariance(row_of[f.id], (_SD, _COVARIANCE)) for f in frame.fiducials])
    return replace(frame, covariance_mm2=_whole_covariance(frame, np.array(stated))) if stated else frame


def _document(rows: Sequence[Row], name: str) -> dict[str, Any]:
    """Return the document of a frame with these balls, unchecked."""
    document: dict[str, Any] = {"name": name, "units": "mm"}
    if rows and "plate" not in rows[0].cells:
        return document | {"solid": tuple(map(_fiducial, rows))}
    views: dict[str, dict[str, tuple[Any, ...]]] = {}
    for row in rows:
        if (role := row.text("plate").lower()) not in ROLES:
            raise row.error(f"the plate is {row.cells['plate']!r}; write xrii or source")
        views.setdefault(row.text("view"), dict.fromkeys(ROLES, ()))[role] += (_fiducial(row),)
    return document | {"views": views}


def _fiducial(row: Row) -> dict[str, Any]:
    if (datum := row.text("datum").lower()) not in _TRUTH:
        raise row.error(f"datum is {datum!r}; write true or false")
    return {
        "id": row.text("id"),
        "xyz": tuple(map(row.number, _XYZ)),
        "diameter": row.number("diameter_mm"),
        "datum": _TRUTH[datum],
        "shape": row.text("shape") or "ball",
    }


def _whole_covariance(frame: Frame, blocks: np.ndarray) -> np.ndarray:
    """Return the measured balls' covariance plus the shared errors of the default tolerances. Raises FrameError."""
    smallest = np.linalg.eigvalsh(blocks)[:, 0] if np.isfinite(blocks).all() else np.array([-np.inf])
    if (smallest < -1e-9 * np.abs(blocks).max(axis=(1, 2))).any():
        raise FrameError("a ball's covariance is not finite or not positive semi-definite; correct its row")
    shared = replace(frame, tolerances=replace(Tolerances(), bead_mm=0.0)).error_factor
    covariance = shared @ shared.T + block_diag(*blocks)
    covariance.flags.writeable = False
    return covariance


@dataclass(frozen=True, eq=False)
class Series:
    """One measurement of a frame: ball `ids[i]` at `xyz_mm[i]` (N, 3), in the instrument's own axes.

    `covariance_mm2` (3N, 3N), None where no error is stated; `diameter_mm` (N,), NaN where not measured.
    Raises FrameError for a ball that occurs twice, and for a stated error that no instrument has.
    """

    name: str
    ids: tuple[str, ...]
    xyz_mm: np.ndarray
    covariance_mm2: np.ndarray | None
    diameter_mm: np.ndarray

    def __post_init__(self) -> None:
        if twice := sorted({i for i in self.ids if self.ids.count(i) > 1}):
            raise FrameError(
                f"series {self.name!r} has ball {twice[0]!r} twice; give repeated measurements another name in a "
                "column `series`"
            )
        if self.covariance_mm2 is None or not len(self.ids):
            return
        smallest, *_, largest = np.linalg.eigvalsh(self.covariance_mm2)
        if smallest < MIN_SD_MM**2 or largest > MAX_SD_MM**2:
            raise FrameError(
                f"series {self.name!r}: the stated error is not between {MIN_SD_MM:g} and {MAX_SD_MM:g} mm in every "
                "direction; check its unit"
            )

    def where(self, keep: np.ndarray) -> "Series":
        """Return the balls for which `keep` (N,) is true."""
        rows = np.repeat(keep, 3)
        covariance = None if self.covariance_mm2 is None else self.covariance_mm2[np.ix_(rows, rows)]
        ids = tuple(np.array(self.ids, dtype=object)[keep])
        return Series(self.name, ids, self.xyz_mm[keep], covariance, self.diameter_mm[keep])


def read_measurements(path: str | Path, covariance: str | Path | None = None) -> tuple[Series, ...]:
    """Return the series of a table of measured balls (docs/own-frame.md lists the columns).

    `covariance`: a CSV of numbers only, the full covariance of x, y, z of every measured row, mm².
    Raises FrameError, which names the line.
    """
    file = Path(path)
    rows = [row for row in _rows(file, ("id", *_XYZ), _MEASURED, _column) if _is_measured(row)]
    if not rows:
        raise FrameError(f"fill in x_mm, y_mm and z_mm: {file.name} has no measured ball")
    ids = np.array([row.text("id") for row in rows], dtype=object)
    names = np.array([row.text("series") or "1" for row in rows], dtype=object)
    xyz = np.array([[row.number(column) for column in _XYZ] for row in rows])
    diameters = np.array([_diameter(row) for row in rows])
    blocks = _all_or_none([_instrument_error(row) for row in rows])
    whole: np.ndarray | None = np.asarray(block_diag(*blocks)) if blocks else None
    if covariance is not None:
        whole = _matrix(Path(covariance), 3 * len(rows))
        if blocks:
            raise FrameError("errors are stated in the table and in a covariance file; give one of them")
    series = []
    for name in dict.fromkeys(names):
        own, other = (np.flatnonzero(names == name), np.flatnonzero(np.repeat(names, 3) != name))
        coordinates = (3 * own[:, None] + np.arange(3)).ravel()
        if whole is not None and whole[np.ix_(coordinates, other)].any():
            raise FrameError(
                "give each series its own covariance: this one correlates different series, and errors that series "
                "share cannot be found from their differences"
            )
        part = None if whole is None else whole[np.ix_(coordinates, coordinates)]
        series.append(Series(name, tuple(ids[own]), xyz[own], part, diameters[own]))
    return tuple(series)


def _column(name: str) -> str:
    """Return a header cell's column name: `x`, `X [mm]` and `x_mm` are the same. Raises FrameError for other units."""
    plain = name.strip().lower()
    if (coordinate := _COORDINATE.match(plain)) is None:
        return plain
    if (unit := coordinate[2] or "mm") != "mm":
        raise FrameError(
            f"the coordinates are in {unit} (column {name.strip()!r}); convert them and their errors to millimetres, "
            "and write x_mm, y_mm, z_mm"
        )
    return f"{coordinate[1]}_mm"


def _is_measured(row: Row) -> bool:
    """Return whether a row has a measurement: on an inspection sheet, an unmeasured ball has empty cells."""
    filled = [bool(row.text(column)) for column in _XYZ]
    if any(filled) and not all(filled):
        raise row.error("fill in all of x, y and z, or leave all three empty for no measurement")
    return all(filled)


def _diameter(row: Row) -> float:
    if not row.text("diameter_mm"):
        return float("nan")
    if (value := row.number("diameter_mm")) <= 0:
        raise row.error(f"diameter_mm is {value:g}; give a diameter above zero")
    return value


def _instrument_error(row: Row) -> np.ndarray | None:
    block = _covariance(row, (_SD, _SD_PER_AXIS, _COVARIANCE))
    if block is not None and not (np.isfinite(block).all() and np.linalg.eigvalsh(block)[0] > 0):
        raise row.error("state an error above zero in every direction; no instrument is exact")
    return block


def _matrix(file: Path, size: int) -> np.ndarray:
    """Return the covariance (size, size) in a CSV of numbers. Raises FrameError."""
    try:
        rows: list[Any] = [
            [float(cell) for cell in row]
            for row in csv.reader(StringIO(read_csv(file, MAX_JSON_BYTES, FrameError, "give a covariance as CSV")))
            if row
        ]
    except (ValueError, csv.Error):
        raise FrameError(f"{file.name} must contain only numbers, separated by commas") from None
    if len(rows) != size or any(len(row) != size for row in rows):
        raise FrameError(f"{file.name} must contain {size} x {size} numbers: x, y, z of every measured row, in mm²")
    matrix = np.array(rows)
    scale = np.abs(matrix).max()
    if not np.isfinite(scale) or np.abs(matrix - matrix.T).max() > 1e-6 * scale:
        raise FrameError(f"{file.name} is not finite and symmetric; entry [i][j] must equal [j][i]")
    if np.linalg.eigvalsh(matrix)[0] <= 1e-9 * scale:
        raise FrameError(f"{file.name} is not positive definite; state an error above zero in every direction")
    return (matrix + matrix.T) / 2
