"""Lengths and angles in one image: exact in their plane, and known as well as they say."""

from contextlib import suppress

import numpy as np
import pytest

from sightline.calibration import BeadView, calibrate
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.errors import UnusableInputError
from sightline.frame import Frame
from sightline.planning.points.reconstruct import measured_in_plane, measured_in_space
from sightline.studies.scenes import measure
from sightline.twin import SetUp, draw_setup

AT = np.array([3.2, -7.1, 11.4])
CORNERS = np.array([[-18.3, 4.1], [12.9, -6.6], [21.7, 30.2]])  # in the plane, mm


@pytest.fixture(scope="module")
def pair() -> tuple[list[BeadView], SetUp]:
    frame = Frame.load("gamma")
    setup = draw_setup(np.random.default_rng(21), frame)
    seen = measure(np.random.default_rng(3), setup, 0.1)
    return [calibrate(one, frame, view=name) for name, one in seen.items()], setup


@pytest.fixture(scope="module")
def view(pair) -> BeadView:
    return pair[0][0]


def _pixels(view: BeadView, off_mm: float = 0.0) -> np.ndarray:
    """The corners, `off_mm` nearer to the focal point than the plane through AT."""
    normal = np.cross(*view.plane.axes)
    nearer = np.sign((view.focal_point_mm - AT) @ normal) * off_mm * normal
    return view.project(AT + nearer + CORNERS @ view.plane.axes)


def test_length_and_angle_in_the_plane_are_those_in_space(view: BeadView) -> None:
    uv = _pixels(view)
    length = measured_in_plane(view, uv[:2], AT)
    assert length.value == pytest.approx(np.hypot(31.2, 10.7), abs=2e-3)  # the map's own inverse is that exact
    one, other = CORNERS[0] - CORNERS[1], CORNERS[2] - CORNERS[1]
    angle = measured_in_plane(view, uv, AT)
    assert angle.value == pytest.approx(np.arccos(one @ other / np.linalg.norm(one) / np.linalg.norm(other)), abs=1e-4)


def test_what_lies_off_the_plane_is_measured_too_long_by_what_it_says(view: BeadView) -> None:
    found = measured_in_plane(view, _pixels(view, 10.0)[:2], AT)
    assert found.value / np.hypot(31.2, 10.7) - 1.0 == pytest.approx(10.0 * found.per_mm, rel=0.03)  # D / (D - 10)
    assert measured_in_plane(view, _pixels(view, 10.0), AT).value == pytest.approx(
        measured_in_plane(view, _pixels(view), AT).value, abs=1e-4
    )


@pytest.mark.parametrize("clicks", [2, 3])
def test_the_error_is_that_of_many_picks(view: BeadView, clicks: int) -> None:
    """Picks of 4 px, against which the calibration's own error is small: 200 draws know the spread to 5 %."""
    uv, rng = _pixels(view)[:clicks], np.random.default_rng(5)
    drawn = [measured_in_plane(view, uv + rng.normal(0.0, 4.0, uv.shape), AT).value for _ in range(200)]
    stated = measured_in_plane(view, uv, AT, pick_sd_px=4.0).error_95
    assert stated == pytest.approx(TWO_SIDED_95 * np.std(drawn), rel=0.15)
    none = measured_in_plane(view, uv, AT, pick_sd_px=0.0).error_95
    assert none is not None and 0.0 < none < 0.2 * stated


def test_two_clicks_in_one_place_are_refused(view: BeadView) -> None:
    with pytest.raises(UnusableInputError, match="one pixel apart"):
        measured_in_plane(view, np.array([[500.0, 500.0], [500.4, 500.0]]), AT)


ENDS = AT + np.array([[-20.0, 6.0, -11.0], [4.0, -3.0, 2.0], [9.0, 17.0, 13.0]])  # in no plane of a plate


@pytest.mark.slow
def test_two_images_measure_in_space_as_well_as_they_say(pair) -> None:
    """Clicks on the truth in one set-up; calibration adds a constant error."""
    views, setup = pair
    true_px = np.array([setup.views[view.name].project(ENDS) for view in views])
    length = np.linalg.norm(ENDS[1] - ENDS[0])
    angle = np.arccos((ENDS[0] - ENDS[1]) @ (ENDS[2] - ENDS[1]) / length / np.linalg.norm(ENDS[2] - ENDS[1]))
    rng, found = np.random.default_rng(8), []
    for _ in range(80):
        uv = true_px + rng.normal(0.0, 0.5, true_px.shape)
        with suppress(UnusableInputError):
            found.append((measured_in_space(views, uv[:, :2]), measured_in_space(views, uv)))
    assert len(found) > 70
    for true, each in zip((length, angle), zip(*found, strict=True), strict=True):
        values, stated = np.array([one.value for one in each]), float(np.mean([one.error_95 for one in each]))
        assert abs(values.mean() - true) < stated
        assert 0.7 < TWO_SIDED_95 * values.std() / stated < 1.2  # the s.d. of 80 is known to 8 %
    alone = measured_in_plane(views[0], true_px[0, :2], AT)
    assert abs(alone.value - length) > 1.0  # what one image cannot see


def test_clicks_on_different_points_are_not_measured_in_space(pair) -> None:
    views, setup = pair
    one, other = (setup.views[view.name].project(ENDS[:2]) for view in views)
    with pytest.raises(UnusableInputError, match="same places"):
        measured_in_space(views, np.array([one, other[::-1]]))
