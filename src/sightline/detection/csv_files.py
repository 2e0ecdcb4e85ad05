"""Beads as CSV, labelled or not: the schemas of docs/observations-csv.md."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from sightline.common.atomic import write_whole
from sightline.common.bounded import MAX_TEXT_BYTES, regular_file
from sightline.common.tables import Row, csv_bytes, read_rows
from sightline.detection.labelling import label
from sightline.detection.results import Detections, Observations
from sightline.errors import ObservationsError
from sightline.frame import Frame

_COLUMNS = ("view", "id", "u_px", "v_px")
_COVARIANCE = ("suu_px2", "suv_px2", "svv_px2")
_RADIUS = ("radius_px",)
_HEADERS = (_COLUMNS, _COLUMNS + _COVARIANCE, _COLUMNS + _RADIUS, _COLUMNS + _COVARIANCE + _RADIUS)
_MAX_TEXT = 64  # characters in the name of a view or fiducial, as in a frame file
# Of beads that are not labelled.
_NEEDED = ("u_px", "v_px", "radius_px")
_OPTIONAL = ("sd_px", *_COVARIANCE, "kind", "contrast")
_KINDS = ("ball", "washer", "hole")
# Error of a centre where the file states none [physics.md, Picks: a centred ball].
_USUAL_SD_PX = 0.1


def read_observations(path: str | Path) -> dict[str, Observations]:
    """Return the observations in a CSV file, by view. Raises ObservationsError, which names the line."""
    file = Path(path)
    header, rows = read_rows(file, MAX_TEXT_BYTES, ObservationsError, "give the beads of one pair of images as CSV")
    if header not in _HEADERS:
        expected = f"{','.join(_COLUMNS)}[,{','.join(_COVARIANCE)}][,{','.join(_RADIUS)}]"
        raise ObservationsError(f"{file.name}, line 1: the columns are {','.join(header)!r}; {expected} was expected")
    beads: dict[str, list[tuple[str, list[float]]]] = {}
    for row in rows:
        view, fiducial = row.text("view"), row.text("id")
        if not (0 < len(view) <= _MAX_TEXT and 0 < len(fiducial) <= _MAX_TEXT):
            raise row.error(f"the view and the fiducial each need a name of 1 to {_MAX_TEXT} characters")
        beads.setdefault(view, []).append((fiducial, _numbers(row, header[2:])))
    if not beads:
        raise ObservationsError(f"{file.name} holds no observations; give one line for each bead seen")
    return {view: _observations(view, seen, header) for view, seen in beads.items()}


def write_observations(observations: Iterable[Observations], path: str | Path) -> Path:
    """Write the views' observations to one CSV file, with covariances and radii only if every view has them; return its
    path."""
    views = list(observations)
    header = _COLUMNS
    header += _COVARIANCE if all(view.covariance_px2 is not None for view in views) else ()
    header += _RADIUS if all(view.radius_px is not None for view in views) else ()
    return write_whole(path, csv_bytes(header, [line for view in views for line in _lines(view, header)]))


def _lines(view: Observations, header: tuple[str, ...]) -> Iterator[list[str]]:
    for i, fiducial in enumerate(view.ids):
        numbers = list(view.uv_px[i])
        if _COVARIANCE[0] in header and view.covariance_px2 is not None:
            numbers += list(view.covariance_px2[i][[0, 0, 1], [0, 1, 1]])
        if _RADIUS[0] in header and view.radius_px is not None:
            numbers.append(view.radius_px[i])
        yield [view.view, fiducial, *(repr(float(number)) for number in numbers)]


def _numbers(row: Row, columns: tuple[str, ...]) -> list[float]:
    """Return the numbers of one bead. Raises ObservationsError."""
    numbers = [row.number(column) for column in columns]
    if _RADIUS[0] in columns and numbers[-1] <= 0:
        raise row.error("the radius is not above zero; give that of the bead's shadow, px")
    if _COVARIANCE[0] in columns:
        suu, suv, svv = numbers[2:5]
        if suu <= 0 or svv <= 0 or suv * suv >= suu * svv:
            raise row.error("the covariance is not positive definite; check suu, suv and svv")
    return numbers


def _observations(view: str, beads: list[tuple[str, list[float]]], header: tuple[str, ...]) -> Observations:
    table = np.array([numbers for _, numbers in beads])
    covariance = table[:, [2, 3, 3, 4]].reshape(-1, 2, 2) if _COVARIANCE[0] in header else None
    radius = table[:, -1] if _RADIUS[0] in header else None
    return Observations(view, tuple(fiducial for fiducial, _ in beads), table[:, :2], covariance, radius_px=radius)


def are_detections(path: Path) -> bool:
    """Return whether a CSV file holds unlabelled beads: its header has `u_px` and no `id`."""
    try:
        with regular_file(path) as stream:
            header = stream.readline(4096).decode("utf-8-sig", "replace")
    except OSError:
        return False  # reading the file reports the error
    columns = [cell.strip() for cell in re.split("[,;\\t]", header)]
    return "u_px" in columns and "id" not in columns


def label_csv(
    path: Path, frame: Frame, view: str | None = None, datums: dict[str, tuple[float, float]] | None = None
) -> Observations:
    """Return the beads of a file, labelled by `label`. They have a covariance only if the file states errors.

    Raises ObservationsError, which names the line, and the errors of `label`.
    """
    detections, known = read_detections(path)
    labelled = label(detections, frame, view, datums)
    # The image's size is unknown; the value made up for labelling must not be passed on.
    return replace(labelled, covariance_px2=labelled.covariance_px2 if known else None, image_shape=None)


def read_detections(path: Path) -> tuple[Detections, bool]:
    """Return the detections of a file, and whether it states the errors of their centres. Raises ObservationsError."""
    columns, given = read_rows(path, MAX_TEXT_BYTES, ObservationsError, "give one image's beads as CSV")
    _refuse_columns(columns, path.name)
    rows = [_detection(row, columns) for row in given]
    if not rows:
        raise ObservationsError(f"{path.name} holds no beads; give one line for each")
    uv = np.array([[row["u_px"], row["v_px"]] for row, _ in rows])
    known = "sd_px" in columns or _COVARIANCE[0] in columns
    beads = Detections(
        uv_px=uv,
        radius_px=np.array([row["radius_px"] for row, _ in rows]),
        covariance_px2=np.array([_stated_covariance(row) for row, _ in rows]),
        kind=tuple(kind for _, kind in rows),
        contrast=np.array([row.get("contrast", 0.0) for row, _ in rows]),
        image_shape=(int(uv[:, 1].max()) + 2, int(uv[:, 0].max()) + 2),
    )
    return beads, known


def _refuse_columns(columns: tuple[str, ...], name: str) -> None:
    missing = [column for column in _NEEDED if column not in columns]
    if missing:
        raise ObservationsError(
            f"{name} does not state {', '.join(missing)}; a bead's radius tells datum markers from the others. "
            "Where it is not known, name each bead instead (docs/observations-csv.md)"
        )
    unknown = [column for column in columns if column not in _NEEDED + _OPTIONAL]
    some = [column in columns for column in _COVARIANCE]
    if unknown or any(some) != all(some) or (any(some) and "sd_px" in columns):
        raise ObservationsError(
            f"{name}: the columns are {','.join(columns)!r}; besides {','.join(_NEEDED)} there may be sd_px or "
            f"{','.join(_COVARIANCE)}, and kind and contrast, each once"
        )


def _detection(row: Row, columns: tuple[str, ...]) -> tuple[dict[str, float], str]:
    """Return the numbers and the kind of a line. Raises ObservationsError."""
    numbers = {column: row.number(column) for column in columns if column != "kind"}
    kind = row.text("kind") or "ball"
    if kind not in _KINDS:
        raise row.error(f"the kind is {kind!r}; write one of {', '.join(_KINDS)}")
    if not 0 < numbers["radius_px"] < 1e4 or max(abs(numbers["u_px"]), abs(numbers["v_px"])) > 1e5:
        raise row.error("a radius above zero and a pixel of an image were expected")
    (a, b), (_, d) = _stated_covariance(numbers)
    if not (a > 0 and d > 0 and b * b < a * d):
        raise row.error("the error is not positive; check sd_px, or suu, suv and svv")
    return numbers, kind


def _stated_covariance(row: dict[str, float]) -> list[list[float]]:
    if _COVARIANCE[0] in row:
        suu, suv, svv = (row[column] for column in _COVARIANCE)
        return [[suu, suv], [suv, svv]]
    sd = row.get("sd_px", _USUAL_SD_PX)
    return [[sd * abs(sd), 0.0], [0.0, sd * abs(sd)]]
