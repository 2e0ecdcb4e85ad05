"""Drawings of studies: valid XML, the same for the same values, with every name in it."""

from xml.etree import ElementTree

import numpy as np

from sightline.studies.runs.plots import PlotAxis, PlotPoint, PlotSeries, Span, field, spans, xy


def test_drawings_name_their_rows_and_lines_and_repeat() -> None:
    rows = [Span("a <b>", 0.1, 0.2, 0.4, mark=0.8), Span("c", 0.2, 0.4, 0.8)]
    lines = [PlotSeries("d & e", [PlotPoint(0.5, 1.0), PlotPoint(2.0, 3.0, 2.5, 3.5)], dashed=True)]
    axes = PlotAxis("x", log=False), PlotAxis("y")
    holes = np.array([[0.0, 0.0], [20.0, 0.0]])
    drawings = {
        "mm, a <b>, c, the paper, rows": lambda: spans(rows, "mm", "rows", "the paper"),
        "d & e, x, y, lines": lambda: xy(lines, *axes, "lines", diagonal=True),
        "moved": lambda: field(holes, holes + 1.0, 107.5, "moved"),
    }
    for names, draw in drawings.items():
        svg = draw()
        assert svg == draw()
        root = ElementTree.fromstring(svg)  # noqa: S314 - drawn by ourselves
        shown = {element.text for element in root.iter()} | {root.get("aria-label")}
        assert set(names.split(", ")) <= shown
