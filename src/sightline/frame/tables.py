"""Tables of balls (CSV): measured frames (docs/frame-file.md), and measurements to be fitted (docs/own-frame.md)."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from io import StringIO
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from sightline.common.bounded import read_text
from sightline.common.strict import explain
from sightline.errors import FrameError
from sightline.frame.document import ADVICE, DIAMETER_MM, SIZE_LIMIT_BYTES, FrameDocument, read_cube
from sightline.frame.model import Frame
from sightline.frame.plate import ROLES
from sightline.frame.tolerances import Tolerances

_PLATE = ("view", "plate")  # both are left out for a solid
_NEEDED = ("id", "x_mm", "y_mm", "z_mm", "diameter_mm")
_COVARIANCE = ("xx_mm2", "xy_mm2", "xz_mm2", "yy_mm2", "yz_mm2", "zz_mm2")
_OPTIONAL = ("datum", "shape", "sd_mm", *_COVARIANCE)
_TRUTH = {"": False, "0": False, "false": False, "no": False, "1": True, "true": True, "yes": True}

Row = Mapping[str, Any]


def frame_from_csv(path: str | Path, name: str, diameter_mm: float | None = None, unit: str | None = None) -> Frame:
    """Return a frame of measured balls; without the columns `view` and `plate`, a solid. Raises FrameError.

    Errors stated in the table (`sd_mm`, or a covariance) replace the default bead tolerance. The default plate and arm
    tolerances remain, since the frame deforms after its measurement (load, moisture expansion).

    A CSV with none of the columns is a frame specification of XMALab: `diameter_mm` of its balls (default 3) and its
    `unit`, mm or cm (default: by its size), hold for that alone.
    """
    file = Path(path)
    text = read_text(file, SIZE_LIMIT_BYTES, FrameError, "give a table of measured balls as CSV")
    columns = {cell.strip() for cell in text.partition("\n")[0].split(",")}
    if not columns & {*_PLATE, *_NEEDED, *_OPTIONAL}:
        cube = read_cube(file, DIAMETER_MM if diameter_mm is None else diameter_mm, unit)
        return replace(Frame.from_document(cube), name=name)
    if diameter_mm is not None or unit is not None:
        raise FrameError(f"{file.name} states its diameters in mm; leave out --diameter-mm and --units")
    rows = _rows(text, file.name)
    try:
        frame = Frame.from_document(FrameDocument.model_validate(_document(rows, name)))
    except ValidationError as error:
        raise FrameError(f"{file.name}: {explain(error, ADVICE)}") from None
    row_of = {row["id"].strip(): (line, row) for line, row in rows}
    blocks = [_ball_covariance(row, line) for line, row in (row_of[f.id] for f in frame.fiducials)]
    stated = [block for block in blocks if block is not None]
    if not stated:
        return frame
    if len(stated) < len(blocks):
        raise FrameError("some balls state an error and some do not; fill in the column for all balls, or leave it out")
    return replace(frame, covariance_mm2=_whole_covariance(frame, np.array(stated)))


def _rows(text: str, file: str) -> list[tuple[int, Row]]:
    """Return the rows with their line numbers. Raises FrameError for missing or unknown columns."""
    try:
        reader = csv.DictReader(StringIO(text, newline=""), strict=True)
        columns = [column.strip() for column in reader.fieldnames or ()]
        reader.fieldnames = columns
        rows: list[tuple[int, Row]] = [(reader.line_num, row) for row in reader]
    except csv.Error as error:
        raise FrameError(f"{file} is not a CSV file: {error}") from None
    needed = (*_PLATE, *_NEEDED) if set(columns) & set(_PLATE) else _NEEDED
    if missing := [column for column in needed if column not in columns]:
        raise FrameError(f"{file} lacks the columns {', '.join(missing)}; give {', '.join(needed)}")
    if unknown := [column for column in columns if column not in (*needed, *_OPTIONAL)]:
        raise FrameError(f"{file} has the unknown column {unknown[0]!r}; it may have {', '.join(_OPTIONAL)}")
    for line, row in rows:
        if None in row or None in row.values():
            raise FrameError(f"{file}, line {line}: the number of cells differs from that of the columns")
    return rows


def _document(rows: list[tuple[int, Row]], name: str) -> dict[str, Any]:
    """Return the document of a frame with these balls, unchecked."""
    document: dict[str, Any] = {"name": name, "units": "mm"}
    if rows and "plate" not in rows[0][1]:
        return document | {"solid": tuple(_fiducial(row, line) for line, row in rows)}
    views: dict[str, Any] = {}
    for line, row in rows:
        _plate(views, row, line).append(_fiducial(row, line))
    return document | {
        "views": {view: {role: tuple(balls) for role, balls in plates.items()} for view, plates in views.items()}
    }


def _plate(views: dict[str, Any], row: Row, line: int) -> list[dict[str, Any]]:
    role = row["plate"].strip().lower()
    if role not in ROLES:
        raise FrameError(f"line {line}: the plate is {row['plate']!r}; write xrii or source")
    return views.setdefault(row["view"].strip(), {role: [] for role in ROLES})[role]


def _fiducial(row: Row, line: int) -> dict[str, Any]:
    datum = row.get("datum", "").strip().lower()
    if datum not in _TRUTH:
        raise FrameError(f"line {line}: datum is {datum!r}; write true or false")
    return {
        "id": row["id"].strip(),
        "xyz": tuple(_number(row, column, line) for column in ("x_mm", "y_mm", "z_mm")),
        "diameter": _number(row, "diameter_mm", line),
        "datum": _TRUTH[datum],
        "shape": row.get("shape", "").strip() or "ball",
    }


def _number(row: Row, column: str, line: int) -> float:
    try:
        return float(row[column])
    except ValueError:
        raise FrameError(f"line {line}: {column} is {row[column]!r}, not a number") from None


def _ball_covariance(row: Row, line: int) -> np.ndarray | None:
    """Return the covariance (3, 3) of a ball, None where the row states none."""
    full = [column for column in _COVARIANCE if row.get(column, "").strip()]
    single = row.get("sd_mm", "").strip()
    if not full and not single:
        return None
    if single and full:
        raise FrameError(f"line {line}: state sd_mm or the covariance of a ball, not both")
    if single:
        if not (sd := _number(row, "sd_mm", line)) >= 0:
            raise FrameError(f"line {line}: sd_mm is {sd:g}; give a standard deviation of zero or more")
        return np.diag([sd * sd] * 3)
    if len(full) < len(_COVARIANCE):
        raise FrameError(f"line {line}: give all of {', '.join(_COVARIANCE)} for a covariance")
    xx, xy, xz, yy, yz, zz = (_number(row, column, line) for column in _COVARIANCE)
    return np.array([(xx, xy, xz), (xy, yy, yz), (xz, yz, zz)])


def _whole_covariance(frame: Frame, blocks: np.ndarray) -> np.ndarray:
    """Return the measured balls' covariance plus the shared errors of the default tolerances. Raises FrameError."""
    smallest = np.linalg.eigvalsh(blocks)[:, 0] if np.isfinite(blocks).all() else np.array([-np.inf])
    if (smallest < -1e-9 * np.abs(blocks).max(axis=(1, 2))).any():
        raise FrameError("a ball's covariance is not finite or not positive semi-definite; correct its row")
    shared = replace(frame, tolerances=replace(Tolerances(), bead_mm=0.0)).error_factor
    out = shared @ shared.T
    for ball, block in enumerate(blocks):
        rows = slice(3 * ball, 3 * ball + 3)
        out[rows, rows] += block
    out.flags.writeable = False
    return out


AXES = ("x", "y", "z")
_SD = ("sd_mm",)
_SD_PER_AXIS = ("sd_x_mm", "sd_y_mm", "sd_z_mm")
_COVARIANCE_COLUMNS = ("xx_mm2", "xy_mm2", "xz_mm2", "yy_mm2", "yz_mm2", "zz_mm2")
_ERRORS = (_SD, _SD_PER_AXIS, _COVARIANCE_COLUMNS)
# Columns of the inspection sheet with nominal values, not measurements.
SHEET_ONLY = (
    "view", "plate", "nominal_x_mm", "nominal_y_mm", "nominal_z_mm", "nominal_diameter_mm", "tolerance_mm", "remark",
)  # fmt: skip
_COORDINATE = re.compile(r"^([xyz])(?:[ _]*[\[(]?([a-zµ\"]+)[\])]?)?$")

MIN_SD_MM, MAX_SD_MM = 1e-5, 10.0  # of a measured centre: better than an interferometer, worse than a ruler [ours]


@dataclass(frozen=True, eq=False)
class Series:
    """One measurement of a frame: ball `ids[i]` at `xyz_mm[i]` (N, 3), in the instrument's own axes.

    `covariance_mm2` (3N, 3N), None where no error is stated; `diameter_mm` (N,), NaN where not measured.
    Raises FrameError for a stated error that no instrument has and that gives no usable weights.
    """

    name: str
    ids: tuple[str, ...]
    xyz_mm: np.ndarray
    covariance_mm2: np.ndarray | None
    diameter_mm: np.ndarray

    def __post_init__(self) -> None:
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
        ids = tuple(i for i, kept in zip(self.ids, keep, strict=True) if kept)
        rows = np.repeat(keep, 3)
        covariance = None if self.covariance_mm2 is None else self.covariance_mm2[np.ix_(rows, rows)]
        return Series(self.name, ids, self.xyz_mm[keep], covariance, self.diameter_mm[keep])


def read_measurements(path: str | Path, covariance: str | Path | None = None) -> tuple[Series, ...]:
    """Return the series of a table of measured balls (docs/own-frame.md lists the columns).

    `covariance`: a CSV of numbers only, the full covariance of x, y, z of every measured row, mm².
    Raises FrameError, which names the line.
    """
    file = Path(path)
    rows = [(line, row) for line, row in _measured_rows(file) if _measured(row, line)]
    if not rows:
        raise FrameError(f"fill in x_mm, y_mm and z_mm: {file.name} has no measured ball")
    xyz = np.array([[_finite_number(row, f"{axis}_mm", line) for axis in AXES] for line, row in rows])
    blocks = [_block(row, line) for line, row in rows]
    whole = None if covariance is None else _matrix(Path(covariance), 3 * len(rows))
    if whole is not None and any(block is not None for block in blocks):
        raise FrameError("errors are stated in the table and in a covariance file; give one of them")
    if any(b is None for b in blocks) and any(b is not None for b in blocks):
        raise FrameError("some balls state an error and some do not; fill in the columns for all balls or for none")
    stated = [block for block in blocks if block is not None]
    if stated:
        whole = _block_diagonal(stated)
    diameters = np.array([_diameter(row, line) for line, row in rows])
    names = [(row.get("series") or "").strip() or "1" for _, row in rows]
    out = []
    for name in dict.fromkeys(names):
        own = np.array([other == name for other in names])
        everything = Series(name, tuple(row["id"].strip() for _, row in rows), xyz, whole, diameters)
        out.append(everything.where(own))
        _refuse_repeats(out[-1])
    _refuse_mixed(out, whole, np.array(names))
    return tuple(out)


def _measured_rows(file: Path) -> list[tuple[int, Row]]:
    reader = csv.DictReader(StringIO(_text(file)), strict=True)
    try:
        columns = [_column(name) for name in reader.fieldnames or ()]
        reader.fieldnames = columns
        rows: list[tuple[int, Row]] = [(reader.line_num, row) for row in reader]
    except csv.Error as error:
        raise FrameError(f"{file.name} is not a CSV file: {error}") from None
    needed = ("id", *(f"{axis}_mm" for axis in AXES))
    if missing := [name for name in needed if name not in columns]:
        raise FrameError(f"{file.name} lacks the columns {', '.join(missing)}; give {', '.join(needed)}")
    if len(set(columns)) < len(columns):
        raise FrameError(f"{file.name} has a column twice; remove one")
    known = {*needed, "series", "diameter_mm", *SHEET_ONLY, *(name for kind in _ERRORS for name in kind)}
    if unknown := [name for name in columns if name not in known]:
        raise FrameError(f"{file.name} has the unknown column {unknown[0]!r}; docs/own-frame.md lists the columns")
    for line, row in rows:
        if None in row or None in row.values():
            raise FrameError(f"{file.name}, line {line}: the number of cells differs from that of the columns")
    return rows


def _text(file: Path) -> str:
    return read_text(file, SIZE_LIMIT_BYTES, FrameError, "give a table of balls as CSV")


def _column(name: str) -> str:
    """Return a header cell's column name: `x`, `X [mm]` and `x_mm` are the same. Raises FrameError for other units."""
    plain = name.strip().lower()
    if (found := _COORDINATE.match(plain)) is None:
        return plain
    if (unit := found[2] or "mm") != "mm":
        raise FrameError(
            f"the coordinates are in {unit} (column {name.strip()!r}); convert them and their errors to millimetres, "
            "and write x_mm, y_mm, z_mm"
        )
    return f"{found[1]}_mm"


def _measured(row: Row, line: int) -> bool:
    """Return whether a row has a measurement: on an inspection sheet, an unmeasured ball has empty cells."""
    filled = [bool(row[f"{axis}_mm"].strip()) for axis in AXES]
    if any(filled) and not all(filled):
        raise FrameError(f"line {line}: fill in all of x, y and z, or leave all three empty for no measurement")
    return all(filled)


def _finite_number(row: Row, column: str, line: int) -> float:
    try:
        value = float(row[column])
    except ValueError:
        raise FrameError(
            f"line {line}: {column} is {row[column]!r}, not a number; write it with a decimal point"
        ) from None
    if not isfinite(value):
        raise FrameError(f"line {line}: {column} is {row[column]!r}, which is not finite; leave the ball out")
    return value


def _diameter(row: Row, line: int) -> float:
    if not row.get("diameter_mm", "").strip():
        return float("nan")
    if (value := _finite_number(row, "diameter_mm", line)) <= 0:
        raise FrameError(f"line {line}: diameter_mm is {value:g}; give a diameter above zero")
    return value


def _block(row: Row, line: int) -> np.ndarray | None:
    """Return the covariance (3, 3) of one row, None where it states none."""
    stated = [kind for kind in _ERRORS if any(row.get(name, "").strip() for name in kind)]
    if not stated:
        return None
    if len(stated) > 1 or not all(row.get(name, "").strip() for name in stated[0]):
        raise FrameError(
            f"line {line}: state a ball's error in one way: {', '.join(_SD)}, or {', '.join(_SD_PER_AXIS)}, or "
            f"{', '.join(_COVARIANCE_COLUMNS)}"
        )
    values = [_finite_number(row, name, line) for name in stated[0]]
    if stated[0] is _COVARIANCE_COLUMNS:
        xx, xy, xz, yy, yz, zz = values
        block = np.array([(xx, xy, xz), (xy, yy, yz), (xz, yz, zz)])
        positive = np.linalg.eigvalsh(block)[0] > 0
    else:
        block = np.diag(np.square(np.broadcast_to(values, 3)))
        positive = min(values) > 0
    if not positive:
        raise FrameError(f"line {line}: state an error above zero in every direction; no instrument is exact")
    return block


def _block_diagonal(blocks: Sequence[np.ndarray]) -> np.ndarray:
    n = len(blocks)
    out = np.zeros((n, 3, n, 3))
    out[range(n), :, range(n), :] = blocks
    return out.reshape(3 * n, 3 * n)


def _matrix(file: Path, size: int) -> np.ndarray:
    """Return the covariance (size, size) in a CSV of numbers. Raises FrameError."""
    try:
        rows: list[Any] = [[float(cell) for cell in row] for row in csv.reader(StringIO(_text(file))) if row]
    except (ValueError, csv.Error):
        raise FrameError(f"{file.name} must contain only numbers, separated by commas") from None
    if len(rows) != size or any(len(row) != size for row in rows):
        raise FrameError(f"{file.name} must contain {size} x {size} numbers: x, y, z of every measured row, in mm²")
    out = np.array(rows)
    scale = np.abs(out).max()
    if not np.isfinite(scale) or np.abs(out - out.T).max() > 1e-6 * scale:
        raise FrameError(f"{file.name} is not finite and symmetric; entry [i][j] must equal [j][i]")
    if np.linalg.eigvalsh(out)[0] <= 1e-9 * scale:
        raise FrameError(f"{file.name} is not positive definite; state an error above zero in every direction")
    return (out + out.T) / 2


def _refuse_repeats(series: Series) -> None:
    if twice := sorted({i for i in series.ids if series.ids.count(i) > 1}):
        raise FrameError(
            f"series {series.name!r} has ball {twice[0]!r} twice; give repeated measurements another name in a column "
            "`series`"
        )


def _refuse_mixed(series: Sequence[Series], whole: np.ndarray | None, names: np.ndarray) -> None:
    """Raise FrameError for a covariance between series: each is weighted by itself, so shared errors would be lost."""
    if whole is None or len(series) == 1:
        return
    different = np.repeat(names, 3)[:, None] != np.repeat(names, 3)
    if np.abs(whole[different]).max(initial=0.0) > 0:
        raise FrameError(
            "give each series its own covariance: this one correlates different series, and errors that series share "
            "cannot be found from their differences"
        )
