"""Detections as CSV: beads from other software or `sightline detect --csv`, found but not labelled."""

import csv
import io
from dataclasses import replace
from math import isfinite
from pathlib import Path

import numpy as np

from sightline.bounded import read_text, regular_file
from sightline.detection.labelling import label
from sightline.detection.results import Detections, Observations
from sightline.errors import ObservationsError
from sightline.frame import Frame

_NEEDED = ("u_px", "v_px", "radius_px")
_COVARIANCE = ("suu_px2", "suv_px2", "svv_px2")
_OPTIONAL = ("sd_px", *_COVARIANCE, "kind", "contrast")
_KINDS = ("ball", "washer", "hole")
_MAX_BYTES = 2**22  # [ours] forty thousand beads
# Error of a centre where the file states none [physics.md, Picks: a centred ball].
_USUAL_SD_PX = 0.1


def are_detections(path: Path) -> bool:
    """Return whether a CSV file holds unlabelled beads: its header has `u_px` and no `id`."""
    try:
        with regular_file(path) as stream:
            header = stream.readline(4096).decode("utf-8-sig", "replace")
    except OSError:
        return False  # reading the file reports the error
    columns = [cell.strip() for cell in header.split(",")]
    return "u_px" in columns and "id" not in columns


def label_csv(
    path: Path, frame: Frame, view: str | None = None, datums: dict[str, tuple[float, float]] | None = None
) -> Observations:
    """Return the beads of a file, labelled by `label`. They have a covariance only if the file states errors.

    Raises ObservationsError, which names the line, and the errors of `label`.
    """
    detections, known = read_detections(path)
    found = label(detections, frame, view, datums)
    # The image's size is unknown; the value made up for labelling must not be passed on.
    return replace(found, covariance_px2=found.covariance_px2 if known else None, image_shape=None)


def read_detections(path: Path) -> tuple[Detections, bool]:
    """Return the detections of a file, and whether it states the errors of their centres. Raises ObservationsError."""
    text = read_text(path, _MAX_BYTES, ObservationsError, "give one image's beads as CSV")
    try:
        if not text:
            raise ObservationsError(f"{path.name} is empty; give one image's beads as CSV")
        reader = csv.DictReader(io.StringIO(text), strict=True, skipinitialspace=True)
        columns = _columns(reader, path.name)
        rows = [_row(row, columns, f"{path.name}, line {reader.line_num}") for row in reader]
    except csv.Error:
        raise ObservationsError(f"{path.name} is not plain comma-separated text in UTF-8") from None
    if not rows:
        raise ObservationsError(f"{path.name} holds no beads; give one line for each")
    uv = np.array([[row["u_px"], row["v_px"]] for row, _ in rows])
    known = "sd_px" in columns or _COVARIANCE[0] in columns
    found = Detections(
        uv_px=uv,
        radius_px=np.array([row["radius_px"] for row, _ in rows]),
        covariance_px2=np.array([_covariance(row) for row, _ in rows]),
        kind=tuple(kind for _, kind in rows),
        contrast=np.array([row.get("contrast", 0.0) for row, _ in rows]),
        image_shape=(int(uv[:, 1].max()) + 2, int(uv[:, 0].max()) + 2),
    )
    return found, known


def _columns(reader: "csv.DictReader[str]", name: str) -> list[str]:
    columns = [column.strip() for column in reader.fieldnames or ()]
    missing = [column for column in _NEEDED if column not in columns]
    if missing:
        raise ObservationsError(
            f"{name} does not state {', '.join(missing)}; a bead's radius tells datum markers from the others. "
            "Where it is not known, name each bead instead (docs/observations-csv.md)"
        )
    unknown = [column for column in columns if column not in _NEEDED + _OPTIONAL]
    some = [column in columns for column in _COVARIANCE]
    if unknown or len(set(columns)) != len(columns) or any(some) != all(some) or (any(some) and "sd_px" in columns):
        raise ObservationsError(
            f"{name}: the columns are {','.join(columns)!r}; besides {','.join(_NEEDED)} there may be sd_px or "
            f"{','.join(_COVARIANCE)}, and kind and contrast, each once"
        )
    reader.fieldnames = columns
    return columns


def _row(row: dict[str, str], columns: list[str], where: str) -> tuple[dict[str, float], str]:
    """Return the numbers and the kind of a line."""
    kind = (row.get("kind") or "ball").strip()
    try:
        numbers = {column: float(row[column]) for column in columns if column != "kind"}
    except (TypeError, ValueError):
        numbers = {}
    if None in row or kind not in _KINDS or not numbers or not all(map(isfinite, numbers.values())):
        raise ObservationsError(
            f"{where}: {len(columns)} finite numbers were expected, and a kind of {'/'.join(_KINDS)}"
        )
    if not 0 < numbers["radius_px"] < 1e4 or max(abs(numbers["u_px"]), abs(numbers["v_px"])) > 1e5:
        raise ObservationsError(f"{where}: a radius above zero and a pixel of an image were expected")
    (a, b), (_, d) = _covariance(numbers)
    if not (a > 0 and d > 0 and b * b < a * d):
        raise ObservationsError(f"{where}: the error is not positive; check sd_px, or suu, suv and svv")
    return numbers, kind


def _covariance(row: dict[str, float]) -> list[list[float]]:
    if _COVARIANCE[0] in row:
        suu, suv, svv = (row[column] for column in _COVARIANCE)
        return [[suu, suv], [suv, svv]]
    sd = row.get("sd_px", _USUAL_SD_PX)
    return [[sd * abs(sd), 0.0], [0.0, sd * abs(sd)]]
