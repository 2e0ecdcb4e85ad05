"""Test points: positions in CFCS measured by other means, and their pixels in the images."""

import csv
import io
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np

from sightline.bounded import read_text
from sightline.calibration import CalibratedView
from sightline.detection import Detections, Observations
from sightline.errors import RefusedError, UnusableInputError

_PLACE = ("name", "x_mm", "y_mm", "z_mm")
_PIXELS = ("pa_u_px", "pa_v_px", "lateral_u_px", "lateral_v_px")
_MAX_BYTES = 2**20  # [ours] ten thousand points
# Maximum distance of a detected ball from the projection of its measured position: 3 mm, less than the error of the
# paper's worst calibration, and half the distance of neighbouring beads [ours].
NEAR_PX = 15.0


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """N points: `names`, `xyz_mm` (N, 3) CFCS, and `uv_px` (2, N, 2), PA then lateral, or None without picks."""

    names: tuple[str, ...]
    xyz_mm: np.ndarray
    uv_px: np.ndarray | None = None


def read_points(path: str | Path) -> MeasuredPoints:
    """Read a CSV file with the columns name,x_mm,y_mm,z_mm and, optionally, pa_u_px,pa_v_px,lateral_u_px,lateral_v_px.

    Raises UnusableInputError, which names the line.
    """
    file = Path(path)
    text = read_text(file, _MAX_BYTES, UnusableInputError, "give a table of test points as CSV")
    try:
        rows = list(csv.reader(io.StringIO(text), strict=True))
    except csv.Error:
        raise UnusableInputError(
            f"{file.name} is not CSV text; write {','.join(_PLACE)} and one line per point"
        ) from None
    header = tuple(cell.strip() for cell in rows[0]) if rows else ()
    if header not in (_PLACE, _PLACE + _PIXELS):
        expected = f"{','.join(_PLACE)}[,{','.join(_PIXELS)}]"
        raise UnusableInputError(f"{file.name}, line 1: the columns are {','.join(header)!r}; {expected} was expected")
    numbers = {}
    for line, cells in enumerate(rows[1:], start=2):
        if cells:
            name, values = _row(cells, len(header), f"{file.name}, line {line}")
            if name in numbers:
                raise UnusableInputError(f"{file.name}, line {line}: the point {name!r} occurs twice; rename one")
            numbers[name] = values
    if not numbers:
        raise UnusableInputError(f"{file.name} holds no points; give one line for each")
    table = np.array(list(numbers.values()))
    picks = table[:, 3:].reshape(-1, 2, 2).swapaxes(0, 1) if len(header) > len(_PLACE) else None
    return MeasuredPoints(tuple(numbers), table[:, :3], picks)


def _row(cells: list[str], columns: int, where: str) -> tuple[str, list[float]]:
    if len(cells) != columns:
        raise UnusableInputError(f"{where}: {len(cells)} cells; {columns} were expected")
    try:
        values = [float(cell) for cell in cells[1:]]
    except ValueError:
        values = [float("nan")]
    if not all(isfinite(value) for value in values):
        raise UnusableInputError(f"{where}: a value is not a finite number")
    return cells[0].strip(), values


def find_balls(
    view: CalibratedView, detections: Detections, observations: Observations, points: MeasuredPoints
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (N, 2) of test balls among the detections of one image, and their covariances (N, 2, 2).

    A test ball is the detection near the projection of its measured position that is not a bead of the frame. The
    position only selects the detection; it does not change its pixel. Raises RefusedError if none or several are near.
    """
    beads = {tuple(uv) for uv in observations.uv_px}
    free = np.array([i for i, uv in enumerate(detections.uv_px) if tuple(uv) not in beads], dtype=int)
    expected = view.project(points.xyz_mm)
    distance = np.linalg.norm(expected[:, None] - detections.uv_px[free][None], axis=-1)
    found = []
    for name, row in zip(points.names, distance, strict=True):
        near = free[row < NEAR_PX]
        if len(near) != 1:
            raise RefusedError(
                f"view {view.name!r}: {len(near)} balls are seen within {NEAR_PX:.0f} px of where the test point "
                f"{name!r} should be; give its pixels in the table, and check its coordinates"
            )
        found.append(near[0])
    return detections.uv_px[found], detections.covariance_px2[found]
