"""Named points from 3D Slicer's markups (.mrk.json) and from tables (CSV). Readers raise UnusableInputError."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sightline.calibration.exchange import reading
from sightline.common.bounded import MAX_TEXT_BYTES
from sightline.common.tables import read_rows
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


def read_table(file: Path, needed: Sequence[str]) -> list[Mapping[str, str]]:
    """Return the cells of each row of a table with these columns and perhaps more. Raises UnusableInputError."""
    columns, rows = read_rows(file, MAX_TEXT_BYTES, UnusableInputError, f"give a table of {','.join(needed)}")
    if not set(needed) <= set(columns):
        raise UnusableInputError(
            f"{file.name} has the columns {','.join(columns)[:200] or 'none'}; {','.join(needed)} are needed"
        )
    return [row.cells for row in rows]


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
