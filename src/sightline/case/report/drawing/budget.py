"""Bar chart of an error budget."""

from collections.abc import Sequence
from dataclasses import dataclass

from sightline.case.report.drawing import svg

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
