"""The force's picture: it says what it shows, and loses no peak."""

import re
from types import SimpleNamespace
from typing import Any

import numpy as np

from sightline.case.report.charts import MAX_POINTS, force_trace
from sightline.case.report.drilled import BEFORE_MM, force_figure


def points_of(drawing: str) -> np.ndarray:
    line = re.search(r'<polyline points="([^"]+)"', drawing)
    assert line is not None
    return np.array([[float(v) for v in pair.split(",")] for pair in line[1].split()])


def test_every_event_stands_at_its_depth():
    depth = np.linspace(-5.0, 95.0, 51)
    drawing = force_trace(depth, np.zeros(51), {"contact": -5.0, "break-through": 95.0}, "a trace")
    x = points_of(drawing)[:, 0]
    lines = [float(v) for v in re.findall(r'<line x1="([\d.]+)"[^>]*class="event"', drawing)]
    assert np.allclose(lines, [x.min(), x.max()], atol=0.01)
    assert "contact at -5.00 mm" in drawing
    assert 'aria-label="a trace"' in drawing


def test_a_single_peak_among_many_samples_is_drawn():
    force = np.zeros(20_000)
    force[12_345] = 40.0
    drawn = points_of(force_trace(np.linspace(0.0, 100.0, 20_000), force, {}, "a peak"))
    assert len(drawn) <= MAX_POINTS + 2
    highest = drawn[drawn[:, 1].argmin()]
    level = np.median(drawn[:, 1])
    assert level - highest[1] > 150.0
    assert np.isclose(highest[0], 56.0 + 0.617 * (760.0 - 76.0), atol=2.0)


def test_names_are_escaped():
    assert "<b>" not in force_trace(np.array([0.0, 1.0]), np.array([0.0, 1.0]), {"<b>": 0.5}, "<b>")


def test_the_trace_begins_before_bone_that_begins_before_the_entry():
    """Fails where it begins 10 mm before the entry point of a nail's hole, whose cortex is 12 mm before it."""
    cortex_mm = -11.7
    record: Any = SimpleNamespace(
        depth_mm=np.linspace(-60.0, 26.0, 200),
        force_n=np.zeros(200),
        events=[SimpleNamespace(name="cortex", depth_mm=cortex_mm)],
    )
    drawing = force_figure(record)
    line = re.search(r'<line x1="([\d.]+)"[^>]*class="event"', drawing)
    assert line is not None
    left, right = points_of(drawing)[:, 0].min(), points_of(drawing)[:, 0].max()
    share = BEFORE_MM / (26.0 - cortex_mm + BEFORE_MM)
    assert np.isclose((float(line[1]) - left) / (right - left), share, atol=0.02)


def test_a_drilling_that_met_nothing_has_a_trace():
    """A program that seeks the first of no events raises an error, in the report and in the app's panel."""
    record: Any = SimpleNamespace(depth_mm=np.linspace(-60.0, -2.0, 200), force_n=np.zeros(200), events=[])
    drawing = force_figure(record)
    assert len(points_of(drawing)) > 2
    assert 'class="event"' not in drawing
