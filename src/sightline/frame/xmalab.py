"""Frame specifications of XMALab: a header line, then x, y, z of each ball, in mm or cm.

The first line is never a ball. A header of four or more cells of which the first three start with "s" gives factors of
x, y and z ("s10,s10,s10,"); any other text is ignored ("x,y,z", "white"). Balls are numbered from 1 in file order,
which is how XMALab's references file names them. The format states neither a unit nor diameters.
"""

import csv
import re
from io import StringIO
from math import isfinite
from typing import Any

import numpy as np

from sightline.errors import FrameError

DIAMETER_MM = 3.0  # [ours] the small Lego cube's are 3.2 mm, the large one's 5 mm
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
