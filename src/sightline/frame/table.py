"""A frame from a table of measured balls (CSV; docs/frame-file.md lists the columns)."""

import csv
from collections.abc import Mapping
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from sightline.bounded import read_text
from sightline.errors import FrameError
from sightline.frame.document import FrameDocument
from sightline.frame.files import SIZE_LIMIT_BYTES, explain
from sightline.frame.model import Frame
from sightline.frame.plate import ROLES
from sightline.frame.tolerances import Tolerances, error_factor

_NEEDED = ("view", "plate", "id", "x_mm", "y_mm", "z_mm", "diameter_mm")
_COVARIANCE = ("xx_mm2", "xy_mm2", "xz_mm2", "yy_mm2", "yz_mm2", "zz_mm2")
_OPTIONAL = ("datum", "shape", "sd_mm", *_COVARIANCE)
_TRUTH = {"": False, "0": False, "false": False, "no": False, "1": True, "true": True, "yes": True}

Row = Mapping[str, Any]


def frame_from_csv(path: str | Path, name: str) -> Frame:
    """Return a frame of measured balls. Raises FrameError.

    Errors stated in the table (`sd_mm`, or a covariance) replace the default bead tolerance. The default plate and arm
    tolerances remain, since the frame deforms after its measurement (load, moisture expansion).
    """
    rows = _rows(Path(path))
    views: dict[str, Any] = {}
    for line, row in rows:
        plate = _plate(views, row, line)
        plate.append((line, row))
    document = {
        "name": name,
        "units": "mm",
        "views": {
            view: {role: tuple(_fiducial(row, line) for line, row in plates[role]) for role in plates}
            for view, plates in views.items()
        },
    }
    try:
        frame = Frame.from_document(FrameDocument.model_validate(document))
    except ValidationError as error:
        raise FrameError(f"{Path(path).name}: {explain(error)}") from None
    in_order = [entry for plates in views.values() for role in ROLES for entry in plates[role]]
    blocks = [_ball_covariance(row, line) for line, row in in_order]
    stated = [block for block in blocks if block is not None]
    if not stated:
        return frame
    if len(stated) < len(blocks):
        raise FrameError("some balls state an error and some do not; fill in the column for all balls, or leave it out")
    return replace(frame, covariance_mm2=_whole_covariance(frame, np.array(stated)))


def _rows(path: Path) -> list[tuple[int, Row]]:
    """Return the rows with their line numbers. Raises FrameError for missing or unknown columns."""
    text = read_text(path, SIZE_LIMIT_BYTES, FrameError, "give a table of measured balls as CSV")
    try:
        reader = csv.DictReader(StringIO(text, newline=""), strict=True)
        columns = [column.strip() for column in reader.fieldnames or ()]
        reader.fieldnames = columns
        rows: list[tuple[int, Row]] = [(reader.line_num, row) for row in reader]
    except csv.Error as error:
        raise FrameError(f"{path.name} is not a CSV file: {error}") from None
    if missing := [column for column in _NEEDED if column not in columns]:
        raise FrameError(f"{path.name} lacks the columns {', '.join(missing)}; give {', '.join(_NEEDED)}")
    if unknown := [column for column in columns if column not in (*_NEEDED, *_OPTIONAL)]:
        raise FrameError(f"{path.name} has the unknown column {unknown[0]!r}; it may have {', '.join(_OPTIONAL)}")
    for line, row in rows:
        if None in row or None in row.values():
            raise FrameError(f"{path.name}, line {line}: the number of cells differs from that of the columns")
    return rows


def _plate(views: dict[str, Any], row: Row, line: int) -> list[tuple[int, Row]]:
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
    shared = error_factor(frame.views, replace(Tolerances(), bead_mm=0.0))
    out = shared @ shared.T
    for ball, block in enumerate(blocks):
        rows = slice(3 * ball, 3 * ball + 3)
        out[rows, rows] += block
    out.flags.writeable = False
    return out
