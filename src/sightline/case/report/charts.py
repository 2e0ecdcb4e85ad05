"""Charts of a report: the bars of an error budget, and the force along a drilled wire."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sightline.case.report import svg

WIDTH, BAR, GAP, LEFT, RIGHT = 760.0, 28.0, 12.0, 84.0, 118.0
MIN_LABELLED_WIDTH = 40.0


@dataclass(frozen=True)
class Bar:
    """One bar: the rms error of each source, in `unit`; the total is their root sum of squares."""

    name: str
    unit: str
    rms: dict[str, float]

    @property
    def gap(self) -> str:
        """The space between a number and the unit; none before a degree sign."""
        return "" if self.unit == "°" else " "

    @property
    def total(self) -> float:
        """Root sum of squares of all sources."""
        return sum(v**2 for v in self.rms.values()) ** 0.5


def _bar(bar: Bar, y: float) -> list[str]:
    middle = y + BAR / 2
    parts = [svg.text(bar.name, LEFT - 10, middle, class_="row-name")]
    x = LEFT
    for source, rms in bar.rms.items():
        share = (rms / bar.total) ** 2
        width = (WIDTH - LEFT - RIGHT) * share
        says = svg.hint(f"{source.replace('_', ' ')}: {rms:.3f}{bar.gap}{bar.unit} rms, {share:.0%} of the variance")
        parts.append(svg.element("rect", says, x=x, y=y, width=width, height=BAR, class_=f"source-{source}"))
        if width > MIN_LABELLED_WIDTH:
            parts.append(svg.text(f"{share:.0%}", x + width / 2, middle, class_=f"share on-{source}"))
        x += width
    return [*parts, svg.text(f"{bar.total:.2f}{bar.gap}{bar.unit} rms", x + 10, middle, class_="total")]


def budget(bars: Sequence[Bar], description: str) -> str:
    """Draw one bar per error, divided into the share of each source in the variance."""
    parts = [part for row, bar in enumerate(bars) for part in _bar(bar, 2.0 + row * (BAR + GAP))]
    return svg.figure((0, 0, WIDTH, len(bars) * (BAR + GAP)), description, parts, class_="budget")


HEIGHT, AXIS_LEFT, AXIS_RIGHT, TOP, FOOT = 270.0, 56.0, 20.0, 44.0, 40.0
NAME_ROWS, NAME_PITCH = 3, 13.0  # event names alternate between rows, so that near ones do not overlap
NAME_WIDTH = 110.0  # with less space on the right of an event, its name stands on the left
MAX_POINTS = 700  # of the line, about one per pixel
_STEPS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


def force_trace(
    depth_mm: np.ndarray, force_n: np.ndarray, events: Mapping[str, float], description: str, width: float = WIDTH
) -> str:
    """Plot force (N,) over depth (N,) beyond the entry point. `events`: the depth at which each was detected, by name.

    `width`: in units of the drawing, in which text is 12 to 14 high.
    """
    depth, force = np.asarray(depth_mm, dtype=np.float64), np.asarray(force_n, dtype=np.float64)
    low, high = float(min(depth.min(), 0.0)), float(max(depth.max(), 1.0))
    top = float(max(force.max() * 1.05, 5.0))

    def x(value: float | np.ndarray) -> np.ndarray:
        return AXIS_LEFT + (np.asarray(value) - low) / (high - low) * (width - AXIS_LEFT - AXIS_RIGHT)

    def y(value: float | np.ndarray) -> np.ndarray:
        return HEIGHT - FOOT - np.maximum(value, 0.0) / top * (HEIGHT - FOOT - TOP)

    parts = [*_axes(x, y, (low, high), top, width)]
    for number, (name, at) in enumerate(events.items()):
        where = float(x(at))
        parts.append(svg.element("line", x1=where, x2=where, y1=TOP, y2=HEIGHT - FOOT, class_="event"))
        level = TOP - 4 - NAME_PITCH * (NAME_ROWS - 1 - number % NAME_ROWS)
        right = where < width - NAME_WIDTH
        words = svg.text(name, where + (3 if right else -3), level, class_="event-name" if right else "event-name end")
        parts.append(svg.group([svg.hint(f"{name} at {at:.2f} mm"), words]))
    line = _thinned(np.column_stack([x(depth), y(force)]))
    parts.append(svg.element("polyline", points=svg.points(line), class_="force"))
    return svg.figure((0, 0, width, HEIGHT), description, parts, class_="force-trace")


def _axes(x, y, depths: tuple[float, float], top: float, width: float) -> list[str]:
    left, foot = float(x(depths[0])), float(y(0.0))
    parts = []
    for value in _ticks(*depths):
        parts.append(svg.element("line", x1=float(x(value)), x2=float(x(value)), y1=foot, y2=foot + 4, class_="axis"))
        parts.append(svg.text(f"{value:g}", float(x(value)), foot + 16, class_="tick middle"))
    for value in _ticks(0.0, top):
        parts.append(
            svg.element("line", x1=left, x2=width - AXIS_RIGHT, y1=float(y(value)), y2=float(y(value)), class_="grid")
        )
        parts.append(svg.text(f"{value:g}", left - 8, float(y(value)) + 4, class_="tick end"))
    parts.append(
        svg.text(
            "depth beyond the entry point, mm", (AXIS_LEFT + width - AXIS_RIGHT) / 2, HEIGHT - 6, class_="tick middle"
        )
    )
    parts.append(svg.text("thrust, N", 4, TOP - 8, class_="tick"))
    return parts


def _ticks(low: float, high: float) -> np.ndarray:
    """Return at most eleven round values from low to high."""
    step = next((step for step in _STEPS if (high - low) / step <= 10), _STEPS[-1])
    return np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step + 0.0  # no -0


def _thinned(points: np.ndarray) -> np.ndarray:
    """Keep the lowest and the highest point of every stretch, so that no peak is lost."""
    size = -(-2 * len(points) // MAX_POINTS)
    if size <= 2:
        return points
    keep = []
    for start in range(0, len(points), size):
        part = points[start : start + size, 1]
        keep += sorted({start + int(part.argmin()), start + int(part.argmax())})
    return points[keep]
