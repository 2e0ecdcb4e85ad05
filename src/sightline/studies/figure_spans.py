"""Drawing of distributions or values as rows: range as a bar, middle as a tick, on one logarithmic axis."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, log10

from sightline.case.report.drawing import svg

# What a row's bar and tick show, in its hint.
MEDIAN = "90 % lie between {low:.3g} and {high:.3g} {unit}, median {middle:.3g}"
RMS = "rms {middle:.3g} {unit}, 95 % interval {low:.3g} to {high:.3g}"
WIDTH, ROW, LEFT, RIGHT, FOOT, BAR = 760.0, 24.0, 250.0, 30.0, 36.0, 12.0
LETTER = 7.0  # mean width of a letter of a row's name, px


@dataclass(frozen=True)
class Span:
    """One row. `mark`: a value from another source to compare with."""

    name: str
    low: float
    middle: float
    high: float
    mark: float | None = None
    colour: str = "beads"


def spans(rows: Sequence[Span], unit: str, description: str, mark: str = "", words: str = MEDIAN) -> str:
    """Draw all rows on one axis. `mark`: the meaning of a mark. `words`: MEDIAN or RMS."""
    values = [v for row in rows for v in (row.low, row.high, row.mark) if v]
    first, last = log10(min(values)) - 0.05, log10(max(values)) + 0.05
    foot = len(rows) * ROW
    left = max(LEFT, 12 + LETTER * max(len(row.name) for row in rows))

    def x(value: float) -> float:
        return left + (WIDTH - left - RIGHT) * (log10(value) - first) / (last - first)

    parts = [_tick(x(value), foot, f"{value:g}") for value in _round_values(first, last)]
    parts.append(svg.text(unit, WIDTH - RIGHT, foot + 30, class_="unit"))
    for k, row in enumerate(rows):
        hint = f"{row.name}: {words.format(low=row.low, middle=row.middle, high=row.high, unit=unit)}"
        parts += _row(
            row, (left - 12, k * ROW + ROW / 2), x, hint, f"{mark}: {row.mark:.3g} {unit}" if row.mark else ""
        )
    return svg.figure((0, 0, WIDTH, foot + FOOT), description, parts, class_="spans")


def _row(row: Span, name_at: tuple[float, float], x, hint: str, mark: str) -> list[str]:
    y, width = name_at[1], max(x(row.high) - x(row.low), 1.0)
    parts = [
        svg.text(row.name, *name_at, class_="row-name"),
        svg.element(
            "rect", svg.hint(hint), x=x(row.low), y=y - BAR / 2, width=width, height=BAR, class_=f"source-{row.colour}"
        ),
        svg.element("line", x1=x(row.middle), x2=x(row.middle), y1=y - BAR / 2, y2=y + BAR / 2, class_="median"),
    ]
    if row.mark:
        at = x(row.mark)
        diamond = f"M{at:.1f} {y - 8:.1f}l6 8l-6 8l-6-8z"
        parts.append(svg.element("path", svg.hint(mark), d=diamond, class_="mark"))
    return parts


def _tick(x: float, foot: float, words: str) -> str:
    line = svg.element("line", x1=x, x2=x, y1=0.0, y2=foot, class_="grid")
    return line + svg.text(words, x, foot + 14, class_="tick-name")


def _round_values(first: float, last: float) -> list[float]:
    """Return 1, 2 and 5 times powers of ten within a range of logarithms."""
    values = [m * 10.0**e for e in range(floor(first), ceil(last) + 1) for m in (1, 2, 5)]
    return [v for v in values if first <= log10(v) <= last]
