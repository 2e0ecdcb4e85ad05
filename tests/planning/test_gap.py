"""A failed gap: its point has no stated error, and the result says so; arrays that can and cannot be confused."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.common.checks import failed
from sightline.errors import ErrorUnknownError, UnusableInputError
from sightline.planning import Trajectory, corridor, error_shares, plan, reconstruct
from sightline.planning.points.results import MAX_GAP_SIGMA

from .standin import pair, wire_px

VIEWS = pair(0.05)
WRONG = {
    "point before view": lambda uv: uv.swapaxes(0, 1),
    "views exchanged": lambda uv: uv[::-1],
    "row before column": lambda uv: uv[..., ::-1],
}


@pytest.mark.parametrize("how", WRONG)
def test_arrays_in_another_order_fail_their_gap_and_get_no_error(how):
    right, wrong = (reconstruct(VIEWS, uv) for uv in (wire_px(VIEWS), WRONG[how](wire_px(VIEWS))))
    assert not failed(right.checks)
    assert [check.name for check in right.checks] == ["error known", "gap", "gap"]
    assert "gap" in {check.name for check in failed(wrong.checks)}
    assert np.linalg.norm(wrong.xyz_mm - right.xyz_mm, axis=1).max() > 5.0
    trajectory = Trajectory(wrong)
    for what in ("covariance_mm2", "entry_error_95_mm", "end_error_95_mm", "direction_error_95_rad"):
        with pytest.raises(ErrorUnknownError, match=r"pass .* mm apart"):
            getattr(trajectory, what)
    for ask in (trajectory.budget_rms, lambda: error_shares(trajectory)):
        with pytest.raises(ErrorUnknownError):
            ask()
    document = trajectory.document()
    assert all(document[key] is None for key in ("error_95", "covariance_mm2", "budget_rms"))
    assert corridor(VIEWS[0], trajectory, 2.5).half_95_px is None


def test_one_failed_gap_rules_out_both_points_of_a_plan_and_their_error_checks():
    uv = wire_px(VIEWS)
    uv[1, 1] += 12.0
    made = plan(VIEWS, uv[:, 0], uv[:, 1])
    assert made.seen.gap_failed.tolist() == [False, True]
    assert made.seen.error_stated.tolist() == [True, False]
    assert not made.trajectory.error_stated
    checks = {check.name: check for check in made.verdict.checks}
    assert not {"entry error", "end error", "direction error"} & set(checks)
    assert "gap" in {check.name for check in failed(made.verdict.checks)}
    assert checks["gap"].limit == MAX_GAP_SIGMA


def test_the_limit_is_where_a_gap_begins_to_fail():
    points = reconstruct(pair(0.05), wire_px(pair(0.05)))
    for sigma, fails in ((MAX_GAP_SIGMA, False), (np.nextafter(MAX_GAP_SIGMA, 4.0), True), (np.nan, True)):
        at = replace(points, gap_sigma=np.ma.masked_array([0.1, sigma]))
        assert at.gap_failed.tolist() == [False, fails]
        assert bool(failed(at.checks)) == fails
        untested = replace(at, gap_tested=np.array([True, False]))
        assert not untested.gap_failed.any()
        assert len(untested.checks) == 2


def test_pixels_by_name_cannot_be_exchanged():
    uv = wire_px(VIEWS)
    covariance = 0.04 * np.broadcast_to(np.eye(2), (2, 2, 2, 2)) * np.array([1.0, 4.0])[:, None, None, None]
    stated = reconstruct(VIEWS, uv, covariance)
    named = {"lateral": uv[1], "pa": uv[0]}
    for order in (VIEWS, VIEWS[::-1]):
        points = reconstruct(order, named, {"pa": covariance[0], "lateral": covariance[1]})
        np.testing.assert_allclose(points.xyz_mm, stated.xyz_mm, atol=1e-9)
        np.testing.assert_allclose(points.covariance_mm2, stated.covariance_mm2, atol=1e-9)
    again = [VIEWS[0], replace(VIEWS[1], name="pa")]
    cases = (
        (VIEWS, {"pa": uv[0]}, "an entry for each view"),
        (VIEWS, {"pa": uv[0], "AP": uv[1]}, "'AP'"),
        (again, {"pa": uv[0]}, "different names"),
        (VIEWS, {"pa": uv[0], "lateral": uv[1, :1]}, "same points"),
    )
    for given, pixels, message in cases:
        with pytest.raises(UnusableInputError, match=message):
            reconstruct(given, pixels)


@pytest.mark.parametrize("snapped", [False, True])
def test_exchanged_images_are_named_and_a_wrong_pick_or_a_moved_bone_is_not(snapped):
    """With the wire picked freely, and with it snapped, as clicks beside their curves."""
    marks_mm = np.array([[-21.0, -18.0, 4.0], [12.0, 30.0, -17.0]])

    def planned(wrong):
        uv, marks = wire_px(VIEWS), np.stack([view.project(marks_mm) for view in VIEWS])
        wrong(uv, marks)
        return plan(VIEWS, uv[:, 0], uv[:, 1], landmarks_uv_px=marks, snapped=snapped)

    def exchange(uv, marks):
        uv[:], marks[:] = uv[::-1].copy(), marks[::-1].copy()

    def shift(uv, marks):  # of the bone between the images
        uv[1] += 0.0 if snapped else 60.0
        marks[1] += 60.0

    def slip(_, marks):
        marks[1, 0] += 200.0

    with pytest.raises(UnusableInputError, match="images of pa and lateral are exchanged"):
        planned(exchange)
    for wrong in (shift, slip):
        assert "gap" in {check.name for check in failed(planned(wrong).verdict.checks)}
