"""Ball centres measured by an instrument, in its own coordinates: the CSV that `sightline frame fit` reads."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from sightline.common.bounded import read_text
from sightline.errors import FrameError
from sightline.frame.files import SIZE_LIMIT_BYTES

AXES = ("x", "y", "z")
_SD = ("sd_mm",)
_SD_PER_AXIS = ("sd_x_mm", "sd_y_mm", "sd_z_mm")
_COVARIANCE = ("xx_mm2", "xy_mm2", "xz_mm2", "yy_mm2", "yz_mm2", "zz_mm2")
_ERRORS = (_SD, _SD_PER_AXIS, _COVARIANCE)
# Columns of the inspection sheet with nominal values, not measurements.
SHEET_ONLY = (
    "view", "plate", "nominal_x_mm", "nominal_y_mm", "nominal_z_mm", "nominal_diameter_mm", "tolerance_mm", "remark",
)  # fmt: skip
_COORDINATE = re.compile(r"^([xyz])(?:[ _]*[\[(]?([a-zµ\"]+)[\])]?)?$")

MIN_SD_MM, MAX_SD_MM = 1e-5, 10.0  # of a measured centre: better than an interferometer, worse than a ruler [ours]

Row = Mapping[str, str]


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
    rows = [(line, row) for line, row in _rows(file) if _measured(row, line)]
    if not rows:
        raise FrameError(f"fill in x_mm, y_mm and z_mm: {file.name} has no measured ball")
    xyz = np.array([[_number(row, f"{axis}_mm", line) for axis in AXES] for line, row in rows])
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


def _rows(file: Path) -> list[tuple[int, Row]]:
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


def _number(row: Row, column: str, line: int) -> float:
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
    if (value := _number(row, "diameter_mm", line)) <= 0:
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
            f"{', '.join(_COVARIANCE)}"
        )
    values = [_number(row, name, line) for name in stated[0]]
    if stated[0] is _COVARIANCE:
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
