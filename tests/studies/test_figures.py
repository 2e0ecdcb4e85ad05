"""Drawings of studies: what stands where."""

import re
from xml.etree import ElementTree

import pytest

from sightline.studies.figure_spans import LEFT, RIGHT, WIDTH, Span, spans
from sightline.studies.figure_xy import PlotAxis, PlotPoint, PlotSeries, xy


def elements(drawing: str, css: str) -> list[ElementTree.Element]:
    found = ElementTree.fromstring(drawing).iter()  # noqa: S314 - drawn by ourselves
    return [one for one in found if css in (one.get("class") or "").split()]


def test_spans_lie_on_one_logarithmic_axis():
    rows = [Span("a <b>", 0.1, 0.2, 0.4, mark=0.8), Span("c", 0.2, 0.4, 0.8)]
    drawing = spans(rows, "mm", "two spreads", "the paper")
    first, second = elements(drawing, "source-beads")
    octave = float(first.get("width")) / 2  # 0.1 to 0.4
    assert float(second.get("x")) - float(first.get("x")) == pytest.approx(octave, abs=0.02)
    assert float(second.get("width")) == pytest.approx(2 * octave, abs=0.02)
    mark = re.match(r"M([\d.]+)", elements(drawing, "mark")[0].get("d")).group(1)
    assert float(mark) == pytest.approx(float(first.get("x")) + 3 * octave, abs=0.1)
    assert float(first.get("x")) > LEFT
    assert float(mark) < WIDTH - RIGHT
    assert "a &lt;b&gt;" in drawing


def test_points_stand_where_their_axes_say():
    drawing = xy(
        [PlotSeries("one", [PlotPoint(0.0, 1.0), PlotPoint(2.0, 3.0, 2.5, 3.5)])],
        PlotAxis("x", log=False),
        PlotAxis("y"),
        "d",
    )
    points = elements(drawing, "point")
    ticks = {t.text: float(t.get("x")) for t in elements(drawing, "tick-name") if t.text not in ("x", "y")}
    assert float(points[0].get("cx")) == pytest.approx(ticks["0"])
    assert float(points[1].get("cx")) == pytest.approx(ticks["2"])
    assert float(points[1].get("cy")) < float(points[0].get("cy"))  # up is more


@pytest.mark.parametrize(
    ("axis", "values", "numbers"),
    [
        (PlotAxis("x"), [0.3, 4.0], [0.2, 0.5, 1.0, 2.0, 5.0]),
        (PlotAxis("x"), [1.0], [0.5, 1.0, 2.0]),
        (PlotAxis("x", log=False), [0.0, 0.35], [0.0, 0.1, 0.2, 0.3, 0.4]),
        (PlotAxis("x", log=False), [0.2, 0.8], [0.0, 0.2, 0.4, 0.6, 0.8]),
        (PlotAxis("x", log=False), [3.0, 12.0], [0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0]),
    ],
)
def test_axes_have_round_numbers_that_enclose_the_values(axis, values, numbers):
    assert axis.numbers(values) == pytest.approx(numbers)


def test_a_diagonal_needs_one_scale_for_both_axes():
    drawing = xy(
        [PlotSeries("one", [PlotPoint(0.1, 0.4), PlotPoint(0.2, 0.8)])],
        PlotAxis("x"),
        PlotAxis("y"),
        "d",
        diagonal=True,
    )
    diagonal = elements(drawing, "dash")[0]
    first, second = elements(drawing, "point")
    slope = (float(diagonal.get("y2")) - float(diagonal.get("y1"))) / (
        float(diagonal.get("x2")) - float(diagonal.get("x1"))
    )
    # Both points are four times above it: the line through them runs beside the diagonal.
    rise = (float(second.get("cy")) - float(first.get("cy"))) / (float(second.get("cx")) - float(first.get("cx")))
    assert rise == pytest.approx(slope, rel=0.01)
