"""Line plot of one quantity against another, with intervals, on linear or logarithmic axes."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, log10

from sightline.case.report.drawing import svg

WIDTH, HEIGHT, LEFT, RIGHT, TOP, FOOT = 760.0, 420.0, 70.0, 190.0, 14.0, 52.0
COLOURS = ("beads", "frame", "focal", "picks", "map")


@dataclass(frozen=True)
class PlotAxis:
    """An axis: logarithmic if `log`, else linear from zero."""

    name: str
    log: bool = True

    def numbers(self, values: Sequence[float]) -> list[float]:
        """Return round tick values that enclose all values."""
        if self.log:
            decades = range(floor(log10(min(values))), ceil(log10(max(values))) + 1)
            rounds = [m * 10.0**e for e in decades for m in (1, 2, 5)]
            first = max((v for v in rounds if v <= min(values)), default=rounds[0])
            last = min((v for v in rounds if v >= max(values)), default=rounds[-1])
            return [v for v in rounds if first <= v <= last] if last > first else [first / 2, first, first * 2]
        step = 10.0 ** floor(log10(max(*values, 1e-9)))
        step = next(s for s in (step / 5, step / 2, step, 2 * step) if max(values) / s <= 6)
        return [k * step for k in range(ceil(max(values) / step) + 1)]

    def place(self, value: float, numbers: Sequence[float]) -> float:
        """Return the position of a value: 0 at the first of `numbers`, 1 at the last."""
        if self.log:
            return log10(value / numbers[0]) / log10(numbers[-1] / numbers[0])
        return (value - numbers[0]) / (numbers[-1] - numbers[0])


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


def xy(
    series: Sequence[PlotSeries], across: PlotAxis, up: PlotAxis, description: str, *, diagonal: bool = False
) -> str:
    """Plot lines over a common pair of axes. `diagonal`: also draw the line y = x."""
    points = [p for one in series for p in one.points]
    x_numbers = across.numbers([p.x for p in points])
    y_numbers = up.numbers([v for p in points for v in (p.y, p.low, p.high) if v is not None and (v > 0 or not up.log)])
    if diagonal:
        x_numbers = y_numbers = across.numbers([*x_numbers, *y_numbers])

    def x(value: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * across.place(value, x_numbers)

    def y(value: float) -> float:
        shown = max(value, y_numbers[0])
        return HEIGHT - FOOT - (HEIGHT - FOOT - TOP) * up.place(shown, y_numbers)

    left, right, top, foot = x(x_numbers[0]), x(x_numbers[-1]), y(y_numbers[-1]), y(y_numbers[0])
    parts = [_across(x(value), top, foot, f"{value:.3g}") for value in x_numbers]
    parts += [_up(y(value), left, right, f"{value:.3g}") for value in y_numbers]
    parts.append(svg.text(across.name, (left + right) / 2, foot + 38, class_="tick-name"))
    parts.append(svg.text(up.name, -(top + foot) / 2, 14, class_="tick-name", transform="rotate(-90)"))
    if diagonal:
        first, last = x_numbers[0], x_numbers[-1]
        parts.append(svg.element("line", x1=x(first), y1=y(first), x2=x(last), y2=y(last), class_="dash"))
    for k, one in enumerate(series):
        colour = COLOURS[(k if one.colour is None else one.colour) % len(COLOURS)]
        parts += _series(one, colour, x, y)
        legend = TOP + 12 + 22 * k
        parts.append(svg.element("circle", cx=WIDTH - RIGHT + 18, cy=legend, r=5.0, class_=f"source-{colour}"))
        parts.append(svg.text(one.name, WIDTH - RIGHT + 30, legend + 4))
    return svg.figure((0, 0, WIDTH, HEIGHT), description, parts, class_="xy")


def _series(one: PlotSeries, colour: str, x, y) -> list[str]:
    line = [(x(p.x), y(p.y)) for p in one.points]
    path = " ".join(f"{svg.number(a)},{svg.number(b)}" for a, b in line)
    dashes = "6 4" if one.dashed else None
    parts = [svg.element("polyline", points=path, class_=f"series line-{colour}", stroke_dasharray=dashes)]
    for p in one.points:
        if p.low is not None and p.high is not None:
            bar = {"x1": x(p.x), "x2": x(p.x), "y1": y(p.low), "y2": y(p.high)}
            parts.append(svg.element("line", **bar, class_=f"series line-{colour}"))
        hint = svg.hint(f"{one.name}: {p.x:.3g}, {p.y:.3g}")
        parts.append(svg.element("circle", hint, cx=x(p.x), cy=y(p.y), r=4.5, class_=f"point source-{colour}"))
    return parts


def _across(x: float, top: float, foot: float, words: str) -> str:
    line = svg.element("line", x1=x, x2=x, y1=top, y2=foot, class_="grid")
    return line + svg.text(words, x, foot + 16, class_="tick-name")


def _up(y: float, left: float, right: float, words: str) -> str:
    line = svg.element("line", x1=left, x2=right, y1=y, y2=y, class_="grid")
    return line + svg.text(words, left - 8, y + 4, class_="unit")
