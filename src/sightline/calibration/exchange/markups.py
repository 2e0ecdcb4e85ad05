"""Named points from 3D Slicer's markups (.mrk.json) and from tables (CSV). Readers raise UnusableInputError."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sightline.calibration.exchange import reading
from sightline.common.bounded import MAX_TEXT_BYTES, read_csv
from sightline.errors import UnusableInputError

COLUMNS = ("name", "coordinates", "x_mm", "y_mm", "z_mm")
_TO_LPS = {"LPS": np.array([1.0, 1.0, 1.0]), "RAS": np.array([-1.0, -1.0, 1.0])}


def read_points(path: str | Path) -> dict[str, np.ndarray]:
    """Return the points (3,) of a file by name, LPS, mm, which are a CT's or mesh's own coordinates.

    Slicer's markups, of one list, line or curve; or a table of COLUMNS, whose coordinates are LPS or RAS.
    """
    file = Path(path)
    points = _of_table(file) if file.suffix.lower() == ".csv" else _of_slicer(file)
    names = [name for name, _ in points]
    if len(set(names)) < len(names) or not all(names):
        raise UnusableInputError(f"{file.name} names its points {', '.join(names)[:200]}; give each a name of its own")
    return dict(points)


def read_table(file: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    """Return the rows of a table with these columns and perhaps more, by column."""
    text = read_csv(file, MAX_TEXT_BYTES, UnusableInputError, f"give a table of {','.join(columns)}")
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(io.StringIO(text), strict=True) if row]
    except csv.Error as error:
        raise UnusableInputError(f"{file.name} is not a table (CSV): {error}") from None
    header = rows[0] if rows else []
    if not set(columns) <= set(header) or any(len(row) != len(header) for row in rows):
        raise UnusableInputError(
            f"{file.name} has the columns {','.join(header)[:200] or 'none'}; {','.join(columns)} are needed, and as "
            "many cells in each line"
        )
    return [dict(zip(header, row, strict=True)) for row in rows[1:]]


def _of_table(file: Path) -> list[tuple[str, np.ndarray]]:
    return [
        (row["name"], _lps([row[axis] for axis in COLUMNS[2:]], row["coordinates"], f"{file.name}: {row['name']}"))
        for row in read_table(file, COLUMNS)
    ]


def _of_slicer(file: Path) -> list[tuple[str, np.ndarray]]:
    try:
        markups = reading.entry(reading.json_object(reading.read_bytes(file)), "markups")
        if not isinstance(markups, list) or len(markups) != 1 or not isinstance(markups[0], dict):
            raise UnusableInputError("it must hold one list of points, or one line")
        (markup,) = markups
        if markup.get("coordinateUnits", "mm") != "mm":
            raise UnusableInputError("its points must be in mm")
        system, points = reading.entry(markup, "coordinateSystem"), reading.entry(markup, "controlPoints")
        if not isinstance(points, list) or not all(isinstance(point, dict) for point in points):
            raise UnusableInputError("its control points must be a list")
        return [
            (str(point.get("label", "")), _lps(reading.entry(point, "position"), system, "a point")) for point in points
        ]
    except UnusableInputError as error:
        raise UnusableInputError(f"{file.name}: {error}; save the markups again from 3D Slicer") from None


def _lps(xyz: Any, system: Any, what: str) -> np.ndarray:
    if system not in _TO_LPS:
        raise UnusableInputError(f"{what} is in {str(system)[:20]!r}; its coordinates must be LPS or RAS")
    return _TO_LPS[system] * reading.array(xyz, (3,), what)
