"""A frame from a table of measured balls (CSV; docs/frame-file.md lists the columns)."""

import csv
from collections.abc import Mapping
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from sightline.common.bounded import read_text
from sightline.common.strict import explain
from sightline.errors import FrameError
from sightline.frame.document import FrameDocument
from sightline.frame.files import ADVICE, SIZE_LIMIT_BYTES, read_cube
from sightline.frame.model import Frame
from sightline.frame.plate import ROLES
from sightline.frame.tolerances import Tolerances
from sightline.frame.xmalab import DIAMETER_MM

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
