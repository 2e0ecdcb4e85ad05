"""The check shot in space: deviations and their covariance proved by sampling, a bent wire, a moved bone, refusals."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import sightline as sl
from sightline.calibration import BeadView
from sightline.common.checks import Limits, failed
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.frame import Frame
from sightline.planning import Plan, kind, plan
from sightline.planning.check.shot import CheckShot, Landmarks, check_shot
from sightline.planning.check.wires import expected_wire
from sightline.studies.scenes import VIEWS, measure
from sightline.twin import SetUp, draw_setup
from sightline.twin.objects.things import draw_motion

from .shots import Wire

PLAN = np.array([[35.0, 34.0, -8.0], [-33.0, -36.0, 7.0]])
MARKS = np.array(
    [[-20.0, -12.0, 9.0], [14.0, 22.0, -11.0], [18.0, -19.0, 16.0], [-24.0, 13.0, -15.0], [3.0, 5.0, 21.0]]
)
ACROSS_PX, TIP_PX, MARK_PX = 0.06, 0.45, 0.1


@dataclass(frozen=True, eq=False)
class Case:
    """A plan, and everything that the check shows of a wire (2, 3) in the bone, which has moved."""

    first: SetUp
    made: Plan
    before: list[BeadView]
    after: list[BeadView]
    wires: list[Wire]
    landmarks: Landmarks

    def result(self, **others) -> CheckShot:
        given = {name: getattr(self, name) for name in ("before", "after", "wires", "landmarks")} | others
        of_plan = self.made.to_check(given["before"])
        of_plan = replace(of_plan, limits=others.get("limits", Limits()))
        return check_shot(of_plan, given["after"], given["wires"], landmarks=given["landmarks"])


def shows(setup: SetUp, xyz: np.ndarray) -> bool:
    return all(setup.views[name].in_field(setup.views[name].project(xyz), 15.0).all() for name in VIEWS)


def drawn(rng: np.random.Generator, xyz: np.ndarray) -> SetUp:
    while True:
        setup = draw_setup(rng, Frame.load("gamma"))
        if shows(setup, xyz):
            return setup


def wire_in(rng: np.random.Generator, setup: SetUp, name: str, curve: np.ndarray) -> Wire:
    """A centre line (M, 3), its last point the tip, as an image shows it."""
    uv = setup.views[name].project(curve)
    way = np.gradient(uv, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    across = np.stack([-way[:, 1], way[:, 0]], axis=-1)
    tip = uv[-1] + TIP_PX * rng.standard_normal() * way[-1]
    kept = np.arange(4, len(uv) - 6, 4)
    kept = kept[setup.views[name].in_field(uv[kept], 10.0)]
    points = uv[kept] + ACROSS_PX * rng.standard_normal((len(kept), 1)) * across[kept]
    return Wire(points, np.full(len(kept), ACROSS_PX**2), tip, TIP_PX**2)


def case(seed: int, wire: np.ndarray, bow_mm: float = 0.0) -> Case:
    rng = np.random.default_rng(seed)
    motion = draw_motion(rng, PLAN.mean(axis=0))
    first = drawn(rng, np.concatenate([PLAN, MARKS]))
    second = replace(drawn(rng, motion.apply(np.concatenate([wire, MARKS]))), true_frame=first.true_frame)
    share = np.linspace(-0.2, 1.0, 101)[:, None]
    bent = 4 * bow_mm * share * (1 - share) * np.array([0.0, 0.0, 1.0])
    curve = motion.apply(wire[0] + share * (wire[1] - wire[0]) + bent)
    views = []
    for setup in (first, second):
        seen = measure(rng, setup, 0.05)
        views.append([sl.calibrate(seen[name], setup.frame, view=name) for name in VIEWS])
    ends = np.array([first.views[name].project(PLAN) for name in VIEWS])
    marks = (
        np.array([setup.views[name].project(xyz) for name in VIEWS]) + MARK_PX * rng.standard_normal((2, len(MARKS), 2))
        for setup, xyz in ((first, MARKS), (second, motion.apply(MARKS)))
    )
    return Case(
        first,
        plan(views[0], ends[:, 0], ends[:, 1], procedure=kind("free-wire")),
        *views,
        [wire_in(rng, second, name, curve) for name in VIEWS],
        Landmarks(*marks, MARK_PX),
    )


def errors(shot: CheckShot, along: np.ndarray, wire: np.ndarray) -> np.ndarray:
    """(5,): deviations stated less those that are true."""
    way = wire[1] - wire[0]
    entry = wire[0] + way * ((PLAN[0] - wire[0]) @ along) / (way @ along)
    axes = np.vstack([shot.across, along])
    return shot.deviation_mm - np.concatenate([shot.across @ (entry - PLAN[0]), axes @ (wire[1] - PLAN[1])])


WIRE = PLAN + np.array([[0.4, -0.3, 0.2], [-0.2, 0.5, 0.3]])


@pytest.fixture(scope="module")
def one() -> Case:
    return case(3, WIRE)


@pytest.mark.slow
def test_residuals_are_one_where_the_errors_are_those_stated(one):
    squares = [drawn.result().residual_rms ** 2 for drawn in (one, *(case(200 + seed, WIRE) for seed in range(2)))]
    assert 0.7 < np.mean(squares) < 1.4  # some 60 degrees of freedom each: 1 ± 0.09


def test_the_tips_error_along_the_wire_is_what_both_images_say_of_it(one):
    """Where the tips are known to 5 px only, nothing else tells of the depth."""
    sd_px = 5.0
    shot = one.result(wires=[replace(wire, tip_variance_px2=sd_px**2) for wire in one.wires])
    along = one.made.trajectory.direction
    ends = shot.movement.apply(shot.tip_mm + np.array([[-0.5], [0.5]]) * along)
    px_per_mm = [np.linalg.norm(np.diff(view.project(ends), axis=0)) for view in one.after]
    assert np.sqrt(shot.covariance_mm2[4, 4]) == pytest.approx(sd_px / np.hypot(*px_per_mm), rel=0.03)


def test_a_plan_on_three_views_is_checked_against_all_its_picks(one):
    """Without picks in the third image it is the check of two; with them the deviation is true as well."""
    rng = np.random.default_rng(21)
    setup = replace(drawn(rng, PLAN), true_frame=one.first.true_frame)
    oblique = sl.calibrate(measure(rng, setup, 0.05)["pa"], setup.frame, view="pa")
    ends = np.swapaxes(np.array([[pick.uv_px for pick in point] for point in one.made.picks]), 0, 1)

    def checked(third_px: np.ndarray) -> CheckShot:
        uv = np.concatenate([ends, third_px[None]])
        made = plan([*one.before, oblique], uv[:, 0], uv[:, 1], procedure=kind("free-wire"))
        return check_shot(made.to_check(), one.after, one.wires, landmarks=one.landmarks)

    two, without = one.result(), checked(np.full((2, 2), np.nan))
    np.testing.assert_allclose(without.deviation_mm, two.deviation_mm, atol=1e-9)
    np.testing.assert_allclose(without.covariance_mm2, two.covariance_mm2, atol=1e-12)
    three = checked(setup.views["pa"].project(PLAN))
    error = errors(three, one.made.trajectory.direction, WIRE)
    assert error @ np.linalg.solve(three.covariance_mm2, error) < 20.5  # chi-square of 5, once in a thousand
    assert np.abs(three.deviation_mm - two.deviation_mm).max() > 0.005  # the third picks count
    with pytest.raises(UnusableInputError, match="all views of the plan"):
        check_shot(one.made.to_check([*one.before, oblique]), one.after, one.wires)


def test_a_wire_within_its_limits_passes_and_says_what_it_is(one):
    shot = one.result()
    assert shot.passed
    assert {check.name for check in shot.checks} >= {"wire entry", "wire tip", "wire direction", "bone landmarks"}
    document = shot.document()
    assert document["passed"]
    assert document["deviation"]["tip_mm"] == pytest.approx(shot.tip_deviation_mm)
    assert abs(shot.tip_deviation_mm - np.linalg.norm(WIRE[1] - PLAN[1])) < 0.2
    assert shot.bow_sigma < 3.0


def test_a_wire_off_its_plan_fails_by_name():
    shot = case(4, PLAN + np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -1.0]])).result()
    assert {check.name for check in failed(shot.checks)} == {"wire entry", "wire tip", "wire direction"}


def test_a_bow_is_measured_and_its_chord_is_not_bent_with_it():
    bent = case(5, WIRE, bow_mm=0.6)
    shot = bent.result()
    assert shot.bow_mm == pytest.approx(0.6, abs=0.08)
    assert shot.bow_sigma > 10.0
    assert np.linalg.norm(errors(shot, bent.made.trajectory.direction, WIRE)[2:]) < 0.25


def test_fewer_landmarks_say_so_and_know_less(one):
    whole = one.result()
    marks = one.landmarks
    two = one.result(landmarks=Landmarks(marks.planned_uv_px[:, :2], marks.checked_uv_px[:, :2], MARK_PX))
    none = one.result(landmarks=Landmarks())
    assert whole.direction_error_95_rad < two.direction_error_95_rad
    assert two.tip_error_95_mm < none.tip_error_95_mm
    assert "bone landmarks" in {check.name for check in failed(two.checks)}
    assert {"bone landmarks", "check shot error"} <= {check.name for check in failed(none.checks)}


def test_pieces_that_something_pulls_aside_are_left_out(one):
    pulled = one.wires[0].uv_px.copy()
    pulled[[2, 7]] += [[0.5, -0.5], [-0.6, 0.6]]
    shot, right = one.result(wires=[replace(one.wires[0], uv_px=pulled), one.wires[1]]), one.result()
    assert shot.passed
    assert shot.deviation_mm == pytest.approx(right.deviation_mm, abs=0.02)


def test_a_line_that_is_wrong_over_its_length_and_another_landmark_show(one):
    pulled = one.wires[0].uv_px + np.where(np.arange(len(one.wires[0].uv_px)) % 2, 1.0, -1.0)[:, None] * [0.5, -0.5]
    wrong = one.landmarks.checked_uv_px.copy()
    wrong[0, 1] += [6.0, -5.0]
    other_landmark = Landmarks(one.landmarks.planned_uv_px, wrong, MARK_PX)
    way = (one.wires[0].uv_px[-1] - one.wires[0].uv_px[-2]) / np.linalg.norm(np.diff(one.wires[0].uv_px[-2:], axis=0))
    tip = replace(one.wires[0], tip_uv_px=one.wires[0].tip_uv_px + 6.0 * way)
    for spoiled, name in (
        ({"wires": [replace(one.wires[0], uv_px=pulled), one.wires[1]]}, "check shot residuals"),
        ({"landmarks": other_landmark}, "check shot residuals"),
        ({"wires": [tip, one.wires[1]]}, "check shot outlier"),
    ):
        assert name in {check.name for check in failed(one.result(**spoiled).checks)}


def test_wires_of_exchanged_images_are_refused_or_fail(one):
    try:
        shot = one.result(wires=one.wires[::-1])
    except ReconstructionRefusedError:
        return
    assert "check shot residuals" in {check.name for check in failed(shot.checks)}


def test_inputs_that_do_not_belong_together_are_refused(one):
    with pytest.raises(ReconstructionRefusedError):
        one.result(after=[one.after[0]] * 2, wires=[one.wires[0]] * 2)
    with pytest.raises(UnusableInputError, match="two views"):
        one.result(after=one.after[:1])
    with pytest.raises(UnusableInputError, match="same points"):
        Landmarks(one.landmarks.planned_uv_px, one.landmarks.checked_uv_px[:, 1:])
    with pytest.raises(UnusableInputError, match="finite"):
        Landmarks(one.landmarks.planned_uv_px, one.landmarks.checked_uv_px * np.nan)


def test_the_planned_wire_is_expected_where_it_projects(one):
    where = expected_wire(one.after[0], one.made.trajectory.points.xyz_mm)
    path = one.made.trajectory
    at = path.entry_mm + where.along_mm[:, None] * path.direction
    assert np.allclose(one.after[0].project(at), where.uv_px)
    assert (np.diff(where.along_mm) > 0).all()
    assert 5.0 < np.median(where.px_per_mm) < 10.0
    assert ((where.sine > 0.3) & (where.sine <= 1.0 + 1e-12)).all()


def test_the_limits_of_the_plan_are_those_of_its_check_and_the_tip_is_looked_for_where_it_was_drilled_to(one):
    plain, other = (one.result(limits=limits) for limits in (Limits(), Limits(0.25, 0.01, beyond_mm=6.0)))
    limits = {check.name: check.limit for check in other.checks}
    assert (limits["wire entry"], limits["wire tip"]) == (0.25, 0.25)
    assert limits["wire direction"] == pytest.approx(np.rad2deg(0.01))
    # The tip that ends at the end point lies 6 mm short of where such a kind drills to.
    assert other.deviation_mm[4] - plain.deviation_mm[4] == pytest.approx(-6.0, abs=1e-3)
    # The adjusted plan is rotated by some 0.01 rad against its axes: 6 mm of that across.
    np.testing.assert_allclose(other.deviation_mm[:2], plain.deviation_mm[:2], atol=1e-9)
    np.testing.assert_allclose(other.deviation_mm[2:4], plain.deviation_mm[2:4], atol=0.1)
    assert other.length_mm == pytest.approx(plain.length_mm + 6.0)
