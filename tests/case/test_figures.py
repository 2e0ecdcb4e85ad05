"""What the pictures draw, read back from the markup."""

from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from sightline.case.report import radiographs, scene, svg
from sightline.case.report.charts import WIDTH, Bar, budget
from sightline.imaging import Radiograph

SPACE = "{http://www.w3.org/2000/svg}"


@given(st.text(alphabet=st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), max_size=60))
def test_any_words_survive_as_words(words: str) -> None:
    drawn = svg.figure((0, 0, 10, 10), words, [svg.text(words, 1, 2), svg.element("circle", svg.hint(words), r=1.0)])
    root = ElementTree.fromstring(drawn)  # noqa: S314 - our own markup
    assert root.get("aria-label") == words
    assert [e.text or "" for e in root.iter() if e.tag in (f"{SPACE}text", f"{SPACE}title")] == [words, words]


@given(st.floats(-1e5, 1e5))
def test_coordinates_are_written_to_a_hundredth(value: float) -> None:
    assert float(svg.number(value)) == pytest.approx(value, abs=0.00501)


def test_grey_spans_the_field_and_is_not_darkened_by_what_is_saturated() -> None:
    pixels = np.full((64, 64), 4095, np.uint16)
    pixels[16:48, 16:48] = np.linspace(200, 800, 32).astype(np.uint16)
    image = Radiograph(pixels, 4095.0)
    object.__setattr__(image, "field_mask", np.ones((64, 64), bool))
    shown = radiographs.grey(image)
    assert shown[0, 0] == 255
    inside = shown[16:48, 16:48]
    assert inside.min() < 10
    assert inside.max() > 245


def test_a_bead_that_was_left_out_is_dashed() -> None:
    sizes, used = np.array([[0.01, 0.0], [0.3, 0.4]]), np.array([True, False])
    marks: Any = SimpleNamespace(ids=("a", "b"), uv_px=np.array([[1.0, 2], [3, 4]]), residual_mm=sizes, used=used)
    group = ElementTree.fromstring(radiographs.beads(marks, np.full(2, 5.0), 0.1))  # noqa: S314 - our own markup
    assert [c.get("stroke-dasharray") for c in group] == [None, "3 3"]
    assert group[0].get("stroke") != group[1].get("stroke")
    assert [c[0].text for c in group] == ["a: residual 0.010 mm", "b: residual 0.500 mm, left out of the fit"]


def test_the_shares_of_a_budget_fill_the_bar() -> None:
    bar = Bar("tip", "mm", {"beads": 0.3, "picks": 0.4})
    assert bar.total == pytest.approx(0.5)
    root = ElementTree.fromstring(budget([bar], "where it comes from"))  # noqa: S314 - our own markup
    widths = [float(e.get("width")) for e in root.iter("{http://www.w3.org/2000/svg}rect")]
    assert widths[0] / widths[1] == pytest.approx(0.09 / 0.16, rel=1e-3)
    assert 0.5 * WIDTH < sum(widths) < WIDTH


def test_ellipsoids_are_drawn_as_large_as_stated() -> None:
    covariance = np.diag([0.04, 0.09, 0.16])
    times = scene.magnification(covariance[None], 12.0)
    reach = np.sqrt(0.16 * chi2.ppf(0.95, 3))
    assert 12.0 / 2.5 < times * reach <= 12.0
    assert times in {1.0, 2.0, 5.0, 10.0, 20.0, 50.0}
    points = np.vstack([s.xyz_mm for s in scene.ellipsoid(np.zeros(3), covariance, times, "")])
    inside = np.einsum("ij,jk,ik->i", points, np.linalg.inv(covariance), points) / times**2
    np.testing.assert_allclose(inside, chi2.ppf(0.95, 3), rtol=1e-9)


def test_what_lies_in_front_is_drawn_inside_the_picture() -> None:
    shapes = [scene.line(np.array([0.0, 0, -600]), np.array([0.0, 0, 300]), "sight")]
    root = ElementTree.fromstring(scene.space(shapes, "a line of sight, and the axes"))  # noqa: S314
    for line in root.iter(f"{SPACE}polyline"):
        xy = np.array([p.split(",") for p in line.get("points").split()], float)
        assert (xy >= 0).all()
        assert (xy <= [scene.WIDTH, scene.HEIGHT]).all()
        assert len(line.get("data-xyz").split(";")) == len(xy)


def test_curve_and_wire_pass_the_points_that_they_are_of(report) -> None:
    curve = ElementTree.fromstring(radiographs.curve(report.plan.entry_curve, "entry"))  # noqa: S314
    line = next(e for e in curve.iter("polyline"))
    xy = np.array([p.split(",") for p in line.get("points").split()], float)
    snapped = report.plan.picks[0][1].uv_px
    assert np.linalg.norm(xy - snapped, axis=1).min() < 10.0  # samples are about 10 px apart
    labels = [int(e.text) for e in curve.iter("text")]
    assert labels
    assert all(label % 50 == 0 for label in labels)
    wire = ElementTree.fromstring(radiographs.wire(report.images[0].view, report.plan.trajectory))  # noqa: S314
    ends = np.array([p.split(",") for p in next(wire.iter("polyline")).get("points").split()], float)[[0, -1]]
    picked = np.array([pair[0].uv_px for pair in report.plan.picks])
    np.testing.assert_allclose(ends, picked, atol=3.0)  # the lateral pick draws the point along the PA line, not across
    assert len(list(wire.iter("ellipse"))) == 2
