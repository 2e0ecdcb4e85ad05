"""Drawings of studies as SVG: values with their intervals as rows or lines, and a displaced pattern of holes."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from io import StringIO
from typing import Any

import numpy as np

COLOURS = {"beads": "tab:blue", "frame": "tab:orange", "focal": "tab:green", "picks": "tab:pink", "map": "tab:purple"}
PER_INCH = 100.0  # px of the page per inch of a drawing


@dataclass(frozen=True)
class Span:
    """One row: a bar from `low` to `high` with a tick at `middle`. `mark`: a value from another source."""

    name: str
    low: float
    middle: float
    high: float
    mark: float | None = None
    colour: str = "beads"


@dataclass(frozen=True)
class PlotAxis:
    """An axis: logarithmic if `log`, else linear from zero."""

    name: str
    log: bool = True


@dataclass(frozen=True)
class PlotPoint:
    """A point; `low` and `high`: the interval of y, if there is one."""

    x: float
    y: float
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class PlotSeries:
    """The points of one line, in the order of x. `colour`: index into COLOURS; default: the next one."""

    name: str
    points: Sequence[PlotPoint]
    dashed: bool = False
    colour: int | None = None


def spans(rows: Sequence[Span], unit: str, description: str, mark: str = "") -> str:
    """Draw all rows on one logarithmic axis. `mark`: the meaning of a mark."""
    axes = _axes(760.0, 60.0 + 24.0 * len(rows))
    for k, row in enumerate(rows):
        axes.barh(k, row.high - row.low, 0.5, row.low, color=COLOURS[row.colour], alpha=0.6)
        axes.plot([row.middle] * 2, [k - 0.25, k + 0.25], color="black")
    marked = [(row.mark, k) for k, row in enumerate(rows) if row.mark]
    if marked:
        axes.plot(*zip(*marked, strict=True), "kD", fillstyle="none", label=mark)
    if mark and marked:
        axes.legend()
    axes.set(xscale="log", xlabel=unit, yticks=range(len(rows)), yticklabels=[row.name for row in rows])
    axes.invert_yaxis()
    return _svg(axes, description)


def xy(
    series: Sequence[PlotSeries], across: PlotAxis, up: PlotAxis, description: str, *, diagonal: bool = False
) -> str:
    """Draw lines with their intervals; `diagonal`: also the line of equal values."""
    axes = _axes(760.0, 420.0)
    for k, line in enumerate(series):
        x, y = [p.x for p in line.points], [p.y for p in line.points]
        below = [0.0 if p.low is None else p.y - p.low for p in line.points]
        above = [0.0 if p.high is None else p.high - p.y for p in line.points]
        colour = list(COLOURS.values())[(k if line.colour is None else line.colour) % len(COLOURS)]
        style = "--" if line.dashed else "-"
        axes.errorbar(x, y, [below, above], fmt=f"o{style}", color=colour, label=line.name)
    for axis, which in ((across, "x"), (up, "y")):
        axes.set(**{f"{which}label": axis.name, f"{which}scale": "log" if axis.log else "linear"})
        if not axis.log:
            axes.set(**{f"{which}lim": (0.0, None)})
    if diagonal:
        first, last = (f(p.x for line in series for p in line.points) for f in (min, max))
        axes.plot([first, last], [first, last], "k:")
    axes.legend()
    return _svg(axes, description)


def field(before_mm: np.ndarray, after_mm: np.ndarray, radius_mm: float, description: str) -> str:
    """Draw holes at `before_mm` (hollow) and `after_mm` (filled), (N, 2), y down, on a round field; the first is the
    centre hole."""
    axes = _axes(560.0, 560.0)
    angle = np.linspace(0.0, 2 * np.pi, 200)
    axes.plot(radius_mm * np.cos(angle), radius_mm * np.sin(angle), color="grey")
    for k, (start, end) in enumerate(zip(before_mm, after_mm, strict=True)):
        colour = COLOURS["beads" if k else "picks"]
        axes.plot(*np.stack([start, end]).T, color=colour)
        axes.plot(*start, "o", color=colour, fillstyle="none")
        axes.plot(*end, "o", color=colour)
    axes.set(aspect="equal")
    axes.invert_yaxis()
    axes.axis("off")
    return _svg(axes, description)


def _axes(width_px: float, height_px: float) -> Any:
    from matplotlib.figure import Figure

    axes: Any = Figure((width_px / PER_INCH, height_px / PER_INCH), layout="constrained").add_subplot()
    axes.grid(visible=True, alpha=0.3)
    return axes


def _svg(axes: Any, description: str) -> str:
    """Return the drawing as an SVG element, the same for the same values."""
    from matplotlib import rc_context

    text = StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": description}):
        axes.figure.savefig(text, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    element = text.getvalue()[text.getvalue().index("<svg") :]
    return re.sub("^<svg", f'<svg role="img" aria-label="{escape(description, quote=True)}"', element)
