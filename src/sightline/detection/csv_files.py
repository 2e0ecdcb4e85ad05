"""Observations as CSV: the schema of docs/observations-csv.md."""

import csv
import io
from collections.abc import Iterable, Iterator
from math import isfinite
from pathlib import Path

import numpy as np

from sightline.atomic import write_whole
from sightline.bounded import read_text
from sightline.detection.results import Observations
from sightline.errors import ObservationsError

_COLUMNS = ("view", "id", "u_px", "v_px")
_COVARIANCE = ("suu_px2", "suv_px2", "svv_px2")
_RADIUS = ("radius_px",)
_HEADERS = (_COLUMNS, _COLUMNS + _COVARIANCE, _COLUMNS + _RADIUS, _COLUMNS + _COVARIANCE + _RADIUS)
_MAX_BYTES = 2**22  # [ours] forty thousand beads
_MAX_TEXT = 64  # [ours] characters in the name of a view or fiducial


def read_observations(path: str | Path) -> dict[str, Observations]:
    """Return the observations in a CSV file, by view. Raises ObservationsError, which names the line."""
    name = Path(path).name
    reader = csv.reader(
        io.StringIO(
            read_text(Path(path), _MAX_BYTES, ObservationsError, "give the beads of one pair of images as CSV")
        ),
        strict=True,
    )
    rows: dict[str, list[tuple[str, list[float]]]] = {}
    try:
        header = tuple(cell.strip() for cell in next(reader, []))
        if header not in _HEADERS:
            expected = f"{','.join(_COLUMNS)}[,{','.join(_COVARIANCE)}][,{','.join(_RADIUS)}]"
            raise ObservationsError(f"{name}, line 1: the columns are {','.join(header)!r}; {expected} was expected")
        for cells in reader:
            if cells:
                view, fiducial, numbers = _row(cells, header, f"{name}, line {reader.line_num}")
                rows.setdefault(view, []).append((fiducial, numbers))
    except csv.Error as error:
        raise ObservationsError(f"{name}, line {reader.line_num}: {error}; write plain comma-separated text") from None
    if not rows:
        raise ObservationsError(f"{name} holds no observations; give one line for each bead seen")
    return {view: _observations(view, beads, header) for view, beads in rows.items()}


def write_observations(observations: Iterable[Observations], path: str | Path) -> Path:
    """Write the views' observations to one CSV file, with covariances and radii only if every view has them; return its
    path."""
    views = list(observations)
    header = _COLUMNS
    header += _COVARIANCE if all(view.covariance_px2 is not None for view in views) else ()
    header += _RADIUS if all(view.radius_px is not None for view in views) else ()
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for view in views:
        writer.writerows(_lines(view, header))
    return write_whole(path, text.getvalue().encode())


def _lines(view: Observations, header: tuple[str, ...]) -> Iterator[list[str]]:
    for i, fiducial in enumerate(view.ids):
        numbers = list(view.uv_px[i])
        if _COVARIANCE[0] in header and view.covariance_px2 is not None:
            numbers += list(view.covariance_px2[i][[0, 0, 1], [0, 1, 1]])
        if _RADIUS[0] in header and view.radius_px is not None:
            numbers.append(view.radius_px[i])
        yield [view.view, fiducial, *(repr(float(number)) for number in numbers)]


def _row(cells: list[str], header: tuple[str, ...], where: str) -> tuple[str, str, list[float]]:
    if len(cells) != len(header):
        raise ObservationsError(f"{where}: {len(cells)} values where {len(header)} were expected")
    view, fiducial = cells[0].strip(), cells[1].strip()
    if not (0 < len(view) <= _MAX_TEXT and 0 < len(fiducial) <= _MAX_TEXT):
        raise ObservationsError(f"{where}: the view and the fiducial each need a name of 1 to {_MAX_TEXT} characters")
    try:
        numbers = [float(cell) for cell in cells[2:]]
    except ValueError:
        raise ObservationsError(f"{where}: {', '.join(cells[2:])} are not all numbers") from None
    if not all(isfinite(number) for number in numbers):
        raise ObservationsError(f"{where}: a value is not finite; leave out beads that were not measured")
    if _RADIUS[0] in header and numbers[-1] <= 0:
        raise ObservationsError(f"{where}: the radius is not above zero; give that of the bead's shadow, px")
    if _COVARIANCE[0] in header:
        suu, suv, svv = numbers[2:5]
        if suu <= 0 or svv <= 0 or suv * suv >= suu * svv:
            raise ObservationsError(f"{where}: the covariance is not positive definite; check suu, suv and svv")
    return view, fiducial, numbers


def _observations(view: str, beads: list[tuple[str, list[float]]], header: tuple[str, ...]) -> Observations:
    table = np.array([numbers for _, numbers in beads])
    covariance = table[:, [2, 3, 3, 4]].reshape(-1, 2, 2) if _COVARIANCE[0] in header else None
    radius = table[:, -1] if _RADIUS[0] in header else None
    return Observations(view, tuple(fiducial for fiducial, _ in beads), table[:, :2], covariance, radius_px=radius)
