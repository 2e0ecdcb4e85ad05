"""The trajectory's predicted errors and their budget; the verdict; the plan that a command makes."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sightline.common.checks import Check, failed
from sightline.errors import ErrorUnknownError, UnusableInputError
from sightline.planning import Limits, Trajectory, judge, kind, plan, reconstruct
from sightline.planning.points.picks import Pick, stack
from sightline.planning.points.results import BUDGET
from sightline.planning.verdict.plan_checks import MAX_GAP_SIGMA

from .standin import END_MM, ENTRY_MM, StandInView, pair, wire_px

VIEWS = pair(0.05)


def _trajectory(views: list[StandInView]) -> Trajectory:
    return Trajectory(reconstruct(views, wire_px(views)))


def test_direction_error_by_sampling():
    trajectory = _trajectory(pair(1.0))
    rng = np.random.default_rng(6)
    ends = rng.multivariate_normal(np.r_[ENTRY_MM, END_MM], trajectory.covariance_mm2, 20_000)
    drawn = ends[:, 3:] - ends[:, :3]
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    angle = np.linalg.norm(np.cross(drawn, trajectory.direction), axis=1)
    assert np.mean(angle < trajectory.direction_error_95_rad) == pytest.approx(0.95, abs=4 * 0.0016)


def test_budget_squares_add_up():
    trajectory = _trajectory(pair())
    budget = trajectory.budget_rms()
    assert tuple(budget) == BUDGET
    for key, total in (
        ("entry_mm", np.trace(trajectory.covariance_mm2[:3, :3])),
        ("end_mm", np.trace(trajectory.covariance_mm2[3:, 3:])),
        ("direction_rad", np.trace(trajectory.direction_covariance_rad2)),
    ):
        assert sum(share[key] ** 2 for share in budget.values()) == pytest.approx(total, rel=1e-10)


def test_trajectory_and_its_document_are_what_was_seen():
    trajectory = _trajectory(pair())
    np.testing.assert_allclose(trajectory.points.xyz_mm, [ENTRY_MM, END_MM], atol=1e-8)
    np.testing.assert_allclose(trajectory.entry_mm + trajectory.length_mm * trajectory.direction, END_MM, atol=1e-8)
    document = json.loads(json.dumps(trajectory.document()))
    assert document["coordinates"] == "CFCS" and "none known" in document["robot"]
    assert document["error_95"]["direction_deg"] == pytest.approx(np.rad2deg(trajectory.direction_error_95_rad))


def test_unknown_error_is_null_not_a_number():
    views = [pair()[0], replace(pair()[1], factors=None)]
    trajectory = _trajectory(views)
    document = trajectory.document()
    assert document["error_95"] is document["covariance_mm2"] is document["budget_rms"] is None
    for what in ("covariance_mm2", "end_error_95_mm", "direction_error_95_rad"):
        with pytest.raises(ErrorUnknownError):
            getattr(trajectory, what)
    with pytest.raises(ErrorUnknownError):
        trajectory.budget_rms()


def test_points_that_give_no_direction_are_refused():
    views = pair()
    for uv in (wire_px(views)[:, :1], wire_px(views)[:, [0, 0]], np.concatenate([wire_px(views)] * 2, axis=1)):
        with pytest.raises(UnusableInputError):
            Trajectory(reconstruct(views, uv))


def _names(checks: tuple[Check, ...]) -> set[str]:
    return {check.name for check in failed(checks)}


def _changed(trajectory: Trajectory, **changes: object) -> Trajectory:
    return Trajectory(replace(trajectory.points, **changes))


def test_a_good_plan_is_go():
    verdict = judge(_trajectory(VIEWS), VIEWS)
    assert verdict.go
    names = "error known, entry error, end error, direction error, gap, pick spread, movement, plan inside hull"
    assert {c.name for c in verdict.checks} == set(names.split(", "))


@pytest.mark.parametrize(
    ("limits", "names"),
    [
        (Limits(position_mm=0.1), {"entry error", "end error"}),
        (Limits(direction_rad=1e-4), {"direction error"}),
    ],
)
def test_limits_decide(limits, names):
    verdict = judge(_trajectory(VIEWS), VIEWS, limits)
    assert not verdict.go
    assert _names(verdict.checks) == names
    assert "largest source" in failed(verdict.checks)[0].sentence


def test_a_significant_gap_is_no_go_and_a_snapped_point_has_none():
    trajectory = _trajectory(VIEWS)
    wide = _changed(trajectory, gap_sigma=np.array([0.3, 3.4]))
    assert _names(judge(wide, VIEWS).checks) == {"gap"}
    snapped = _changed(trajectory, gap_sigma=np.zeros(2), gap_tested=np.array([True, False]))
    assert _names(judge(snapped, VIEWS).checks) == {"movement"}  # one free point is too few
    assert [c.name for c in judge(snapped, VIEWS).checks].count("gap") == 1


def test_a_failed_gap_names_its_landmark_and_tells_it_against_its_limit():
    """Fails for sentences of "landmark 1" where the procedure names it, and for "1.0 times the limit" of a failure."""
    trajectory = _trajectory(VIEWS)
    seen = _changed(trajectory, gap_sigma=np.array([0.3, 1.004 * MAX_GAP_SIGMA])).points
    last = replace(
        seen,
        xyz_mm=np.concatenate([seen.xyz_mm, seen.xyz_mm]),
        gap_mm=np.tile(seen.gap_mm, 2),
        gap_sigma=np.tile(seen.gap_sigma, 2),
        gap_tested=np.ones(4, dtype=bool),
    )
    gaps = [
        check for check in judge(trajectory, VIEWS, None, last, ["", "lesser trochanter"]).checks if check.name == "gap"
    ]
    assert [check.sentence.split(" pass ")[0].removeprefix("The lines of sight of ") for check in gaps] == [
        "the entry point",
        "the end point",
        "landmark 1",
        "the lesser trochanter",
    ]
    assert "1.01 times the limit" in gaps[3].sentence and gaps[3].sentence.endswith("pick again.")


@pytest.mark.parametrize(("method", "go"), [("smooth", True), ("polynomial", False), ("localized", False)])
def test_outside_the_convex_hull_only_smooth_states_a_sufficient_error(method, go):
    views = [replace(view, method=method) for view in pair(0.05)]
    outside = _changed(_trajectory(views), inside_hull=np.array([True, False]))
    verdict = judge(outside, views)
    assert verdict.go == go
    assert "end point" in next(c for c in verdict.checks if c.name == "plan inside hull").sentence


def test_a_views_failed_check_and_an_unknown_error_are_no_go():
    wrong = Check("bead count", False, 9.0, 24.0, "beads", "Too few beads.")
    assert _names(judge(_trajectory(VIEWS), [replace(VIEWS[0], checks=(wrong,)), VIEWS[1]]).checks) == {"bead count"}
    blind = [VIEWS[0], replace(VIEWS[1], factors=None)]
    assert _names(judge(_trajectory(blind), blind).checks) == {"error known"}


@pytest.mark.parametrize("snapped", [False, True])
def test_plan_fromwire_px(snapped):
    entry, end = np.swapaxes(wire_px(VIEWS), 0, 1)
    made = plan(VIEWS, entry, end, procedure=kind("free-wire"), snapped=snapped)
    np.testing.assert_allclose(made.trajectory.entry_mm, ENTRY_MM, atol=0.02)
    np.testing.assert_allclose(made.trajectory.end_mm, END_MM, atol=0.02)
    assert made.verdict.go != snapped
    assert _names(made.verdict.checks) == ({"movement"} if snapped else set())
    assert made.seen is made.trajectory.points
    assert made.landmarks_document() == []
    assert made.entry_curve.to_view == "lateral"
    assert bool(made.trajectory.points.gap_tested.all()) != snapped
    assert bool(made.picks[0][1].across_px.any()) == snapped


LANDMARKS_MM = np.array([[-21.3, -17.9, 4.4], [12.2, 30.1, -16.8]])


def _planned(views: list[StandInView], moved_mm: np.ndarray, landmarks: int = 2, **options):
    """A snapped plan; the patient moves by (3,) mm before the lateral view is taken."""
    there = [np.zeros(3), moved_mm]
    uv = np.array([v.project(np.stack([ENTRY_MM, END_MM]) + m) for v, m in zip(views, there, strict=True)])
    marks = np.array([v.project(LANDMARKS_MM[:landmarks] + m) for v, m in zip(views, there, strict=True)])
    return plan(views, uv[:, 0], uv[:, 1], snapped=True, landmarks_uv_px=marks, procedure=kind("free-wire"), **options)


def test_landmarks_that_agree_make_a_snapped_plan_go_and_change_nothing_else():
    still, bare = _planned(VIEWS, np.zeros(3)), _planned(VIEWS, np.zeros(3), landmarks=0)
    assert still.verdict.go
    assert (
        _names(bare.verdict.checks) == _names(_planned(VIEWS, np.zeros(3), landmarks=1).verdict.checks) == {"movement"}
    )
    # Equal but for rounding: with landmarks the matrices are larger, and a processor's products of them differ.
    one, other = still.trajectory, bare.trajectory
    np.testing.assert_allclose(one.points.xyz_mm, other.points.xyz_mm, rtol=1e-12)
    np.testing.assert_allclose(one.covariance_mm2, other.covariance_mm2, rtol=1e-10, atol=1e-15)
    assert still.trajectory.document()["gap_tested"] == [False, False]
    marks = json.loads(json.dumps(still.landmarks_document()))
    np.testing.assert_allclose([mark["xyz_mm"] for mark in marks], LANDMARKS_MM, atol=0.02)
    assert all(mark["gap_sigma"] < 0.1 for mark in marks)


def test_movement_along_the_common_normal_is_no_go_and_in_the_plane_of_the_beams_it_is_not_seen():
    """The beams run along Z and X: the common normal is Y. The value is the movement over its stated error."""
    for moved_mm in (2.0, -2.0):
        made = _planned(VIEWS, np.array([0.0, moved_mm, 0.0]))
        assert "movement" in _names(made.verdict.checks)
        check = next(check for check in made.verdict.checks if check.name == "movement")
        assert check.figure * made.seen.shift_sd_mm == pytest.approx(2.0, abs=0.03)
        assert "moved by 2.0" in check.sentence
        assert np.sign(made.seen.shift_mm) == np.sign(moved_mm) * np.sign(_planned(VIEWS, [0, 2.0, 0]).seen.shift_mm)
    assert _planned(VIEWS, np.array([2.0, 0.0, 0.0])).verdict.go  # and wrong by 2 mm: nothing can show it


def test_the_mean_of_many_points_sees_less_movement_than_a_gap():
    """Twelve landmarks with gaps below the limit each, all to one side."""
    views, rng = pair(0.05), np.random.default_rng(4)
    xyz = rng.uniform(-30.0, 30.0, (12, 3))
    moved = np.array([0.0, 0.27, 0.0])
    marks = np.array([views[0].project(xyz), views[1].project(xyz + moved)])
    points = reconstruct(views, marks)
    assert points.gap_sigma.max() < MAX_GAP_SIGMA
    assert abs(points.shift_mm) > MAX_GAP_SIGMA * points.shift_sd_mm


def test_landmarks_need_finite_pixels_in_both_views_and_a_known_error():
    entry, end = np.swapaxes(wire_px(VIEWS), 0, 1)
    for bad in (np.zeros((2, 2)), np.zeros((1, 2, 2)), np.full((2, 2, 2), np.nan)):
        with pytest.raises(UnusableInputError, match="landmarks"):
            plan(VIEWS, entry, end, procedure=kind("free-wire"), landmarks_uv_px=bad)
    blind = [VIEWS[0], replace(VIEWS[1], factors=None)]
    made = plan(
        blind,
        entry,
        end,
        procedure=kind("free-wire"),
        landmarks_uv_px=np.array([v.project(LANDMARKS_MM) for v in VIEWS]),
    )
    assert (made.seen.shift_mm, made.seen.shift_sd_mm) == (None, None)
    assert made.landmarks_document()[0]["gap_sigma"] is None
    assert _names(made.verdict.checks) == {"error known"}


@pytest.mark.parametrize("bad", [np.zeros((2, 3)), np.full((2, 2), np.nan), np.zeros(2)])
def test_plan_refuses_badwire_px(bad):
    views = pair()
    entry, end = np.swapaxes(wire_px(views), 0, 1)
    for arguments in ((bad, end), (entry, bad)):
        with pytest.raises(UnusableInputError, match="each of the 2 images"):
            plan(views, *arguments)
    with pytest.raises(UnusableInputError, match="two or more"):
        plan(views[:1], entry, end)


def test_one_point_may_be_snapped_and_the_other_free():
    entry, end = np.swapaxes(wire_px(VIEWS), 0, 1)
    made = plan(VIEWS, entry, end, procedure=kind("free-wire"), snapped=(True, False))
    assert made.trajectory.points.gap_tested.tolist() == [False, True]


def _spread_of(rng: np.random.Generator, sd_px: float, snapped: bool) -> Check:
    uv = wire_px(VIEWS) + rng.normal(0.0, sd_px, (2, 2, 2))
    marks = np.array([view.project(np.vstack([LANDMARKS_MM, [[-4.0, 22.0, 9.0]]])) for view in VIEWS])
    marks = marks + rng.normal(0.0, sd_px, marks.shape)
    picks = [(Pick.free(a), Pick.free(b)) for a, b in zip(*np.concatenate([uv, marks], axis=1), strict=True)]
    uv_px, covariance, across = stack(picks)
    if snapped:
        across[1, :2] = [0.0, 1.0]
    seen = reconstruct(VIEWS, uv_px, covariance, across_px=across)
    (check,) = (one for one in judge(Trajectory(seen.first(2)), VIEWS, seen=seen).checks if one.name == "pick spread")
    return check


@pytest.mark.slow
def test_the_gaps_chi_square_is_one_and_its_limit_is_passed_once_in_a_thousand():
    """Picks of 0.5 px, as stated: mean and variance of a chi-square of five points; views have no error,
    which 0.05 of a frame's errors hardly changes."""
    rng = np.random.default_rng(31)
    found = np.array([_spread_of(rng, 0.5, snapped=False).figure for _ in range(150)])
    assert np.mean(found) == pytest.approx(5.0, abs=4 * np.sqrt(10.0 / 150))
    assert np.var(found) == pytest.approx(10.0, abs=4 * np.sqrt(900.0 / 150))


@pytest.mark.parametrize(("sd_px", "snapped", "least"), [(2.0, False, 38), (3.0, False, 40), (3.0, True, 34)])
def test_picks_that_are_less_accurate_than_stated_are_no_go(sd_px: float, snapped: bool, least: int):
    rng = np.random.default_rng(32)
    found = [_spread_of(rng, sd_px, snapped) for _ in range(40)]
    assert sum(not check.passed for check in found) >= least
    assert "less accurate than stated" in next(check for check in found if not check.passed).sentence
