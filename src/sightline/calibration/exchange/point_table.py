"""Pixels of points in every frame of a run, as CSV: our own rows, or the columns of XMALab and DLTdv.

Wide: a column pair `NAME_cam1_X,NAME_cam1_Y` for each point and camera, a row a frame, NaN or empty where not seen.
XMALab counts pixels from 0 or 1, with y up or down, and exports distorted or undistorted points; DLTdv 8 counts from 1.
The file states none of it.
"""

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import TextIOWrapper
from itertools import islice
from pathlib import Path

import numpy as np

from sightline.common.bounded import regular_file
from sightline.errors import UnusableInputError

MAX_BYTES = 2**28  # [ours] three million points in two views
MAX_PIXEL = 1e5  # larger than any image; other units give it away [ours]
_CHUNK = 2**12  # rows parsed at once: with more, their cells leave the cache [measured]
_LONG, _SD = ("frame", "point", "view", "u_px", "v_px"), "sd_px"
_WIDE = re.compile(r"(.+)_cam(\d{1,2})_([xy])", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class PointTable:
    """N points of a run: `frames` (N,) int; `names` of all points, `points` (N,) int the index of each into them;
    `uv_px` (V, N, 2), NaN where a view does not show one; `sd_px` (V, N), NaN where not stated.

    `pixels_stated`: whether the file's kind says that pixels are those of the views' own images, counted from 0.
    """

    frames: np.ndarray
    names: tuple[str, ...]
    points: np.ndarray
    uv_px: np.ndarray
    sd_px: np.ndarray
    pixels_stated: bool


def read_points(path: Path, views: Sequence[str]) -> PointTable:
    """Return the points of a CSV file, in long or wide form. Raises UnusableInputError.

    `views`: the names of the views of a long table; the cameras of a wide one are in their order.
    """
    try:
        with regular_file(path) as stream:
            if stream.seek(0, 2) > MAX_BYTES:
                raise UnusableInputError(f"it is larger than {MAX_BYTES >> 20} MiB; split it by frames")
            stream.seek(0)
            with TextIOWrapper(stream, "utf-8-sig", newline="") as text:
                return _table(text, views)
    except OSError as error:
        raise UnusableInputError(f"cannot read {path.name}: {error.strerror}") from error
    except UnicodeDecodeError:
        raise UnusableInputError(f"{path.name} is not a text file in UTF-8; export it again as CSV") from None
    except (UnusableInputError, csv.Error) as error:
        raise UnusableInputError(f"{path.name}: {error}") from None


def _table(stream: TextIOWrapper, views: Sequence[str]) -> PointTable:
    first = stream.readline(2**20)
    mark = next((mark for mark in ";\t" if mark in first), ",")
    header = [cell.strip() for cell in next(csv.reader([first], delimiter=mark, strict=True), [])]
    columns = [name.lower() for name in header]
    if twice := [name for name in columns if columns.count(name) > 1]:
        raise UnusableInputError(f"it has the column {twice[0]!r} twice; remove one")
    chunks = _chunks(csv.reader(stream, delimiter=mark, strict=True), len(header))
    if set(_LONG) <= set(columns):
        return _long(chunks, columns, views)
    if any(map(_WIDE.fullmatch, header)):
        return _wide(chunks, header, views)
    missing = ", ".join(name for name in _LONG if name not in columns)
    raise UnusableInputError(
        f"the columns {missing} are missing; give {', '.join(_LONG)}, or NAME_cam1_X, NAME_cam1_Y, NAME_cam2_X, ... "
        "with a header line"
    )


_Column = tuple[str, ...]


def _chunks(reader: Iterator[list[str]], width: int) -> Iterator[list[_Column]]:
    """Yield the columns of some rows at once; lines without cells are dropped. Raises UnusableInputError."""
    line = 2
    while some := list(islice(reader, _CHUNK)):
        for wrong in (k for k, row in enumerate(some) if row and len(row) != width):
            raise UnusableInputError(f"line {line + wrong}: {len(some[wrong])} cells where {width} were expected")
        line += len(some)
        if rows := [row for row in some if any(row)]:
            yield list(zip(*rows, strict=True))


def _numbers(cells: _Column, name: str) -> np.ndarray:
    """Return the numbers of a column, NaN where empty. Raises UnusableInputError for others, and for large ones."""
    try:
        values = np.array([float(cell) for cell in cells])
    except ValueError:
        values = _other_numbers(cells, name)
    if (np.abs(values) > MAX_PIXEL).any():
        raise UnusableInputError(
            f"{name} is {np.nanmax(np.abs(values)):g}; at most {MAX_PIXEL:g} is possible: check it"
        )
    return values


def _other_numbers(cells: _Column, name: str) -> np.ndarray:
    """Return the numbers of a column with empty cells or decimal commas. Raises UnusableInputError."""
    comma, point = (next((cell for cell in cells if mark in cell), None) for mark in ",.")
    if comma and point:
        raise UnusableInputError(f"{name} has {comma.strip()} and {point.strip()}; write all numbers alike")
    try:
        return np.array([float(cell.replace(",", ".").strip() or "nan") for cell in cells])
    except ValueError as error:
        raise UnusableInputError(f"{name}: {error}; write numbers, NaN or nothing") from None


def _long(chunks: Iterator[list[_Column]], columns: list[str], views: Sequence[str]) -> PointTable:
    """Return the points of rows in any order. Raises UnusableInputError for unknown views and for repeated rows."""
    if unknown := [name for name in columns if name not in (*_LONG, _SD)]:
        raise UnusableInputError(f"the column {unknown[0]!r} is unknown; give {', '.join(_LONG)}, and {_SD} if known")
    names: dict[str, int] = {}
    order, parts = {name: k for k, name in enumerate(views)}, []
    for cells in chunks:
        of = dict(zip(columns, cells, strict=True))
        seen_in = [name.strip() for name in of["view"]]
        if other := set(seen_in) - set(order):
            raise UnusableInputError(f"the view {min(other)!r} is not one of {', '.join(views)}; name the views alike")
        point = [names.setdefault(name.strip(), len(names)) for name in of["point"]]
        stated = _numbers(of[_SD], _SD) if _SD in of else np.full(len(point), np.nan)
        numbers = [_numbers(of[name], name) for name in ("frame", "u_px", "v_px")]
        parts.append(np.array([point, [order[name] for name in seen_in], *numbers, stated]))
    point, view, frame, u, v, sd = np.concatenate([np.zeros((6, 0)), *parts], axis=1)
    if np.isnan(frame).any() or (frame % 1).any() or (frame < 0).any():
        raise UnusableInputError("a frame is not a whole number from 0; number the frames")
    if (sd <= 0).any():
        raise UnusableInputError(f"{_SD} is not above zero; give a standard deviation in px")
    key = (frame * max(len(names), 1) + point).astype(np.int64)
    each, row = np.unique(key, return_inverse=True)
    at = view.astype(np.int64), row
    count = np.zeros((len(views), len(each)), dtype=np.int64)
    np.add.at(count, at, 1)
    if (count > 1).any():
        k, i = np.argwhere(count > 1)[0]
        name = list(names)[each[i] % len(names)]
        raise UnusableInputError(
            f"frame {each[i] // len(names)} has point {name!r} twice in view {views[k]}; remove one"
        )
    uv, known = np.full((*count.shape, 2), np.nan), np.full(count.shape, np.nan)
    uv[at], known[at] = np.column_stack([u, v]), sd
    frames, points = np.divmod(each, max(len(names), 1))
    return _checked(PointTable(frames, tuple(names), points, uv, known, pixels_stated=True))


def _wide(chunks: Iterator[list[_Column]], header: list[str], views: Sequence[str]) -> PointTable:
    """Return the points of a row a frame, numbered from 1 without a column `frame`. Raises UnusableInputError."""
    place: dict[tuple[str, int, str], int] = {}
    for k, name in enumerate(header):
        if found := _WIDE.fullmatch(name):
            place[found[1].strip(), int(found[2]), found[3].lower()] = k
        elif name.lower() != "frame":
            raise UnusableInputError(f"the column {name!r} is unknown; export without offset columns, and one file")
    names = tuple(dict.fromkeys(name for name, _, _ in place))
    cameras = {camera for _, camera, _ in place}
    if cameras != set(range(1, len(views) + 1)):
        raise UnusableInputError(
            f"it has cameras {', '.join(map(str, sorted(cameras)))}, and there are {len(views)} views"
        )
    wanted = [(name, camera, axis) for camera in sorted(cameras) for name in names for axis in "xy"]
    if missing := [f"{n}_cam{c}_{a.upper()}" for n, c, a in wanted if (n, c, a) not in place]:
        raise UnusableInputError(f"the column {missing[0]} is missing; export both coordinates for every camera")
    parts, count = [np.zeros((len(wanted) + 1, 0))], 1
    frame = next((k for k, name in enumerate(header) if name.lower() == "frame"), None)
    for cells in chunks:
        rows = np.arange(count, count := count + len(cells[0]), dtype=np.float64)
        counted = rows if frame is None else _numbers(cells[frame], "frame")
        parts.append(np.array([counted, *(_numbers(cells[place[key]], "_".join(map(str, key))) for key in wanted)]))
    frames, *values = np.concatenate(parts, axis=1)
    if np.isnan(frames).any() or (frames % 1).any() or len(np.unique(frames)) < len(frames):
        raise UnusableInputError("the column frame holds a number twice, or none; number the frames")
    uv = np.array(values).reshape(len(views), len(names), 2, -1).transpose(0, 3, 1, 2).reshape(len(views), -1, 2)
    points = np.tile(np.arange(len(names)), len(frames))
    table = PointTable(
        np.repeat(frames.astype(np.int64), len(names)), names, points, uv, np.full(uv.shape[:2], np.nan),
        pixels_stated=False,
    )  # fmt: skip
    return _checked(table)


def _checked(table: PointTable) -> PointTable:
    """Return the table. Raises UnusableInputError where it is empty, or has one coordinate of a pixel alone."""
    if not len(table.frames):
        raise UnusableInputError("it holds no points; give a row for each")
    half = np.isnan(table.uv_px).sum(axis=2) == 1
    if half.any():
        i = int(np.flatnonzero(half.any(axis=0))[0])
        name = table.names[table.points[i]]
        raise UnusableInputError(
            f"frame {table.frames[i]}, point {name!r}: one coordinate is missing; give both or none"
        )
    return table
