"""Tables as text, CSV: their rows by column, with the line in every refusal."""

import csv
import io
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from sightline.common.bounded import read_bounded
from sightline.errors import UnusableInputError


@dataclass(frozen=True)
class Row:
    """One row of a table: its cells by column; `where`: file and line, for messages."""

    cells: Mapping[str, str]
    where: str
    refuse: type[UnusableInputError]

    def text(self, column: str) -> str:
        """Return a cell; empty where the table lacks the column."""
        return self.cells.get(column, "")

    def number(self, column: str) -> float:
        """Return the finite number in a cell. Raises `refuse`."""
        with suppress(ValueError):
            if isfinite(value := float(self.cells[column])):
                return value
        raise self.error(f"{column} is {self.cells[column]!r}, not a finite number; write it with a decimal point")

    def error(self, words: str) -> UnusableInputError:
        """Return the refusal of this row."""
        return self.refuse(f"{self.where}: {words}")


def read_rows(
    file: Path, max_bytes: int, refuse: type[UnusableInputError], hint: str, column: Callable[[str], str] = str.strip
) -> tuple[tuple[str, ...], list[Row]]:
    """Return the columns and the rows of a table; empty lines are left out.

    `max_bytes`, `refuse`, `hint`: as of `read_bounded`. `column`: returns a header cell's column name. Raises `refuse`,
    also for a column that stands twice and for a row with more or fewer cells than columns.
    """
    reader = csv.reader(
        io.StringIO(read_csv(file, max_bytes, refuse, hint), newline=""), strict=True, skipinitialspace=True
    )
    rows: list[Row] = []
    try:
        columns = tuple(column(cell) for cell in next(reader, []))
        if len(set(columns)) < len(columns):
            raise refuse(f"{file.name} has a column twice; remove one")
        for cells in filter(None, reader):
            where = f"{file.name}, line {reader.line_num}"
            if len(cells) != len(columns):
                raise refuse(f"{where}: {len(cells)} cells; {len(columns)} are needed, one for each column")
            rows.append(Row(dict(zip(columns, map(str.strip, cells), strict=True)), where, refuse))
    except csv.Error as error:
        raise refuse(f"{file.name}, line {reader.line_num}: {error}; write plain comma-separated text") from None
    return columns, rows


def read_csv(file: Path, max_bytes: int, refuse: type[UnusableInputError], hint: str) -> str:
    """Return the text of a table of at most `max_bytes`, in UTF-8, with commas between cells and decimal points.

    Raises `refuse`.
    """
    try:
        text = read_bounded(file, max_bytes, refuse, hint).decode("utf-8-sig")
        return _with_commas(text)
    except UnicodeDecodeError as error:
        raise refuse(f"{file.name} is not a text file in UTF-8; {hint}") from error
    except csv.Error as error:
        raise refuse(f"{file.name} is not a table (CSV): {error}") from None
    except ValueError as error:
        raise refuse(f"{file.name}: {error}") from None


def csv_bytes(head: Iterable[str], rows: Iterable[Iterable[object]]) -> bytes:
    """Return a table as CSV in UTF-8, with lines that end as on Unix."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    return text.getvalue().encode()


_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+(?:[eE][+-]?\d+)?\s*")
_DECIMAL_POINT = re.compile(r"\s*[+-]?\d*\.\d+(?:[eE][+-]?\d+)?\s*")


def _with_commas(text: str) -> str:
    """Return a table whose cells are separated by semicolons or tabs with commas instead, and its decimal commas as
    points. Raises ValueError where it has numbers of both kinds: one of them may separate thousands."""
    first = text.partition("\n")[0]
    separator = next((mark for mark in ";\t" if mark in first), None)
    if separator is None:
        return text
    rows = list(csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True))
    cells = [cell for row in rows for cell in row]
    comma = next((cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell)), None)
    point = next((cell for cell in cells if _DECIMAL_POINT.fullmatch(cell)), None)
    if comma and point:
        raise ValueError(f"{comma.strip()} has a decimal comma and {point.strip()} a point; write all numbers alike")
    written = io.StringIO()
    csv.writer(written, lineterminator="\n").writerows(
        [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in row] for row in rows
    )
    return written.getvalue()
