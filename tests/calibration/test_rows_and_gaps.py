"""Torn rows and dropped beads: found from the beads alone, in the view and about each point of a plan."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import GAMMA, Camera, choose

from sightline.calibration import calibrate
from sightline.calibration.bead_checks import Support
from sightline.detection.results import Observations, RejectedCandidate
from sightline.planning import plan
from sightline.twin import bead_images

POINT_PX = np.array([[520.0, 470.0]])


def rows_check(view):
    return next(check for check in view.checks if check.name == "image rows")


def torn(observations, row: float, shift_px: tuple[float, float]):
    below = observations.uv_px[:, 1] > row
    return replace(observations, uv_px=observations.uv_px + below[:, None] * np.array(shift_px))


@pytest.mark.parametrize("method", ["smooth", "polynomial"])
@pytest.mark.parametrize("shift_px", [(2.0, 0.0), (0.0, -2.0)])
def test_a_torn_image_is_found_with_its_row_and_shift(method, shift_px):
    whole = Camera.pa(bend=0.03).observe(GAMMA, np.random.default_rng(3))
    assert rows_check(calibrate(whole, GAMMA, method=method)).passed
    check = rows_check(calibrate(torn(whole, 480.0, shift_px), GAMMA, method=method))
    assert not check.passed
    row = float(check.sentence.split("row ")[1].split(":")[0])
    shift = float(check.sentence.split("shifted by ")[1].split(" px")[0])
    assert abs(row - 480.0) < 40.0  # half a pitch of the beads, 90 px, parts the rows of two beads
    assert shift == pytest.approx(2.0, abs=0.5)
    assert ("along" if shift_px[0] else "across") in check.sentence


def test_balls_beside_their_places_are_not_a_torn_image():
    """Half of a plate is 0.5 mm aside: a tear would explain a part of it."""
    seen = Camera.pa(bend=0.03).observe(GAMMA, np.random.default_rng(3))
    aside = [0.5 * (f.id.startswith("pa-x") and f.xyz_mm[1] > 20) for f in GAMMA.fiducials]
    wrong = GAMMA.with_beads_at(GAMMA.xyz_mm + np.outer(aside, [1.0, 0.0, 0.0]))
    checks = {check.name: check for check in calibrate(seen, wrong).checks}
    assert not checks["chi-square"].passed and "another frame" in checks["chi-square"].sentence
    assert checks["image rows"].passed


def near(view, uv_px=POINT_PX) -> float:
    used, hidden, shown = view.lines_of_sight(uv_px).beads_near[0]
    assert hidden == 0  # unknown what else was detected
    return used / shown


@pytest.mark.parametrize("method", ["smooth", "polynomial"])
def test_dropped_beads_are_counted_where_they_are_missed(method):
    """Beads of one strip were not labelled: missed by a point in it, not by one elsewhere."""
    whole = Camera.pa().observe(GAMMA)
    strip = choose(whole, lambda i: abs(dict(zip(whole.ids, whole.uv_px[:, 1], strict=True))[i] - 470.0) > 60.0)
    assert 10 < len(whole) - len(strip) < 30
    assert near(calibrate(whole, GAMMA, method=method)) == 1.0
    view = calibrate(strip, GAMMA, method=method)
    assert near(view) < 0.7
    assert near(view, np.array([[520.0, 750.0]])) > 0.8


def test_a_bead_left_out_as_wrong_counts_as_missing():
    whole = Camera.pa().observe(GAMMA)
    moved = whole.uv_px.copy()
    nearest = np.argsort(np.linalg.norm(moved - POINT_PX, axis=1))[[0, 5]]
    moved[nearest] += [(9.0, -7.0), (-8.0, -8.0)]
    view = calibrate(replace(whole, uv_px=moved), GAMMA)
    assert len(view.residuals.left_out) == 2
    assert near(view) == 0.75


def test_beads_that_touch_are_not_expected_nor_those_beyond_the_field():
    grid = 50.0 * np.stack(np.meshgrid(np.arange(6), np.arange(6)), axis=-1).reshape(-1, 2)
    places = np.concatenate([grid, [[102.0, 109.0]]])  # its neighbour at (100, 100)
    used = np.ones(len(places), dtype=bool)
    used[-1] = False
    support = Support.of(places, np.full(len(places), 6.0), used, None)
    assert len(support.places_px) == 35
    outside = used.copy()
    outside[places[:, 0] > 220.0] = False  # the field ends before the last column
    cut = Support.of(places, np.full(len(places), 6.0), outside, None)
    used_near, _, shown = cut.near(np.array([[190.0, 120.0]]))[0]
    assert used_near == shown
    used_near, _, shown = cut.near(np.array([[275.0, 120.0]]))[0]  # a pick beyond it: the field does not end there
    assert used_near < shown


def test_where_the_used_beads_span_nothing_all_count_as_missing():
    places = 50.0 * np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2)
    for count in (0, 1, 2):
        support = Support.of(places, np.full(16, 6.0), np.arange(16) < count, None)
        used, _, shown = support.near(np.array([[75.0, 75.0]]))[0]
        assert (used <= count, shown) == (True, 8)


def rejected(uv_px: np.ndarray, by_px: tuple[float, float]) -> tuple[RejectedCandidate, ...]:
    return tuple(
        RejectedCandidate(tuple(uv), 8.0, "no bead of the frame is expected there") for uv in (uv_px + by_px).tolist()
    )


def test_a_hidden_bead_contradicts_nothing_and_counts_half():
    """Metal hides three of the eight beads about a point, or they were seen elsewhere and not labelled."""
    whole = replace(Camera.pa().observe(GAMMA), rejected=())
    order = np.argsort(np.linalg.norm(whole.uv_px - POINT_PX, axis=1))
    gone = {whole.ids[k] for k in order[:3]}
    hidden = choose(whole, lambda i: i not in gone)
    assert calibrate(hidden, GAMMA).lines_of_sight(POINT_PX).beads_near[0].tolist() == [5, 3, 8]
    strays = rejected(whole.uv_px[order[:3]], (25.0, 0.0))
    for known, counts in ((strays, [5, 0, 8]), (strays[:1], [5, 2, 8]), (None, [5, 0, 8])):
        view = calibrate(replace(hidden, rejected=known), GAMMA)
        assert view.lines_of_sight(POINT_PX).beads_near[0].tolist() == counts
    far = rejected(whole.uv_px[order[-3:]], (25.0, 0.0))
    assert calibrate(replace(hidden, rejected=far), GAMMA).lines_of_sight(POINT_PX).beads_near[0].tolist() == [5, 3, 8]


def test_a_detection_on_two_touching_beads_is_not_a_stray():
    grid = 50.0 * np.stack(np.meshgrid(np.arange(6), np.arange(6)), axis=-1).reshape(-1, 2)
    places, stray = np.concatenate([grid, [[102.0, 109.0]]]), np.array([[101.0, 104.0]])
    used = np.ones(len(places), dtype=bool)
    used[[6 * 2 + 2, 6 * 2 + 3, len(grid)]] = False  # both of the pair, and a neighbour that is hidden
    counts = Support.of(places, np.full(len(places), 6.0), used, stray).near(np.array([[125.0, 125.0]]))[0]
    assert counts.tolist() == [7, 1, 8]


@pytest.mark.parametrize(("by_mm", "hidden", "passes"), [(11, True, True), (18, True, False), (11, False, False)])
def test_a_retractor_is_not_taken_for_a_torn_strip(setup, frame, by_mm: int, hidden: bool, passes: bool):
    """`by_mm`: half the width of what covers the beads about the entry point, or of the strip whose beads moved."""
    views, uv = [], []
    wire = np.array([[22.0, 14.0, -7.0], [-20.0, -24.0, 9.0]])
    for name in ("pa", "lateral"):
        ids, px = bead_images(setup, name, np.random.default_rng(13), 0.1)
        ends = setup.views[name].project(wire)
        uv.append(ends)
        whole = Observations(name, tuple(ids), px, np.repeat(0.01 * np.eye(2)[None], len(ids), axis=0), rejected=())
        covered = np.abs(px - ends[0]).max(axis=1) < by_mm / 0.15
        gone = {i for i, one in zip(ids, covered, strict=True) if one}
        seen = choose(whole, lambda i, gone=gone: i not in gone)
        views.append(calibrate(seen if hidden else replace(seen, rejected=rejected(px[covered], (14.0, 0.0))), frame))
    made = plan(views, np.array(uv)[:, 0], np.array(uv)[:, 1])
    check = next(check for check in made.verdict.checks if check.name == "beads near")
    assert check.passed is passes, check.sentence
    counts = np.concatenate([n[:2] for n in (made.trajectory.points.beads_near or {}).values()])
    assert check.figure == (counts @ [1.0, 0.5, 0.0] / counts[:, 2]).min()  # hidden ones count half
    if hidden:  # and the error stated without these beads is sufficient
        assert np.linalg.norm(made.trajectory.entry_mm - wire[0]) < made.trajectory.entry_error_95_mm


def strip_moved(whole, shift_px: float):
    """The beads of a strip are detected beside their places and not labelled."""
    inside = {i for i, (_, v) in zip(whole.ids, whole.uv_px, strict=True) if 200.0 < v < 380.0}
    stray = [(u + shift_px, v) for i, (u, v) in zip(whole.ids, whole.uv_px, strict=True) if i in inside]
    rejected = tuple(RejectedCandidate(tuple(uv), 5.0, "no bead of the frame") for uv in stray)
    return replace(choose(whole, lambda i: i not in inside), rejected=rejected)


@pytest.mark.parametrize("shift_px", [-25.0, 11.9])
def test_a_shifted_strip_whose_beads_were_dropped_is_found(shift_px):
    whole = Camera.pa(bend=0.03).observe(GAMMA, np.random.default_rng(3))
    check = rows_check(calibrate(strip_moved(whole, shift_px), GAMMA))
    assert not check.passed
    assert check.figure == pytest.approx(abs(shift_px), abs=2.0)  # the map is extrapolated into the strip
    assert "A strip" in check.sentence


def test_beads_that_something_hides_beside_other_round_things_are_no_strip():
    whole = Camera.pa(bend=0.03).observe(GAMMA, np.random.default_rng(3))
    rng = np.random.default_rng(8)
    for _ in range(10):
        hidden = strip_moved(whole, 0.0)
        count = len(hidden.rejected)
        places = rng.uniform([100.0, 200.0], [900.0, 380.0], (count, 2))
        scattered = tuple(RejectedCandidate(tuple(uv), 5.0, "no bead of the frame") for uv in places)
        assert rows_check(calibrate(replace(hidden, rejected=scattered), GAMMA)).passed
