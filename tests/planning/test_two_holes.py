"""Both holes of a nail in one plan, from their edges, against a simulator that shares nothing with the estimator."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.scenes.nails import Sight, seen

from sightline.calibration import view_from_matrix
from sightline.common.checks import failed
from sightline.errors import ReconstructionRefusedError
from sightline.from_images.interlocking import refuse_confused
from sightline.planning import Hole, Nail, WirePicks, fit_hole, plan_wires
from sightline.twin.anatomy.nailed_femur import SPACING_MM, DistalNail
from sightline.twin.xray.distributions import beam_at

from .test_hole import camera_matrix

ERRORS = np.eye(12) * 1e-14  # a matrix with a small error
ORBITS_DEG = (-106.0, -74.0)  # the beams run from lateral to medial
NAIL = DistalNail(np.array([3.2, -14.1, 5.3]), np.array([0.0, 1.0, 0.0]), beam_at(-np.pi / 2 + 0.03), bend=0.02)
KNOWN = Nail(11.0, 5.0, 5.0, spacing_mm=SPACING_MM)
PROCEDURE = "distal-interlocking"


VIEWS = [
    view_from_matrix(camera_matrix(angle), ERRORS, name)
    for angle, name in zip(ORBITS_DEG, ("pa", "lateral"), strict=True)
]
SIGHTS = {view.name: Sight(view.focal_point_mm, view.project) for view in VIEWS}


@pytest.fixture(scope="module")
def holes() -> dict[str, Hole]:
    rng = np.random.default_rng(3)
    return {key: fit_hole(VIEWS, seen(rng, NAIL, SIGHTS, n), KNOWN) for n, key in ((1, "distal"), (0, "proximal"))}


def _planned(holes: dict[str, Hole], **given):
    marks = NAIL.placed(np.array([[0.0, 0.0, 40.0], [4.0, 0.0, 14.0]]))
    uv = np.stack([view.project(marks) for view in VIEWS])
    picks = {key: WirePicks.of_hole(hole, VIEWS) for key, hole in holes.items()}
    return plan_wires(VIEWS, picks, procedure=PROCEDURE, side="right", landmarks_uv_px=uv, **given)


def test_both_holes_are_planned_from_lateral_with_the_holes_own_errors(holes):
    made = _planned(holes)
    assert made.verdict.state == "go", made.verdict.summary()
    assert list(made.plans) == ["distal", "proximal"]
    for n, (key, one) in zip((1, 0), made.plans.items(), strict=True):
        point, axis = NAIL.holes[n]
        path, hole = one.trajectory, holes[key].entered_along(np.array([-1.0, 0.0, 0.0]))
        assert path.entry_mm[0] > path.end_mm[0] + 10.0  # +x is lateral
        assert np.linalg.norm(np.cross(path.entry_mm - point, axis)) < 0.3
        np.testing.assert_array_equal(path.covariance_mm2, hole.covariance_mm2)
        assert path.points.budget_mm2 is not None
        np.testing.assert_allclose(sum(path.points.budget_mm2.values()), hole.covariance_mm2, atol=1e-12)
        assert min(np.linalg.eigvalsh(part)[0] for part in path.points.budget_mm2.values()) > -1e-9
        assert {"hole agreement", "spacing", "parallel"} <= {check.name for check in one.verdict.checks}
    assert made.plans["distal"].trajectory.entry_mm[1] > made.plans["proximal"].trajectory.entry_mm[1] + 20.0
    assert made.plans["distal"].kind.key == f"{PROCEDURE}:distal"


def test_the_second_hole_planned_again_from_the_same_images_is_the_same(holes):
    both, again = _planned(holes), _planned({"proximal": holes["proximal"]}, placed={"distal": holes["distal"].axis})
    assert again.verdict.state == "go", again.verdict.summary()
    one, other = (made.plans["proximal"].trajectory for made in (both, again))
    np.testing.assert_array_equal(one.points.xyz_mm, other.points.xyz_mm)


def test_the_hole_that_is_drilled_already_is_no_go(holes):
    made = _planned({"proximal": holes["distal"]}, placed={"distal": holes["distal"].axis})
    assert made.verdict.state == "no-go"
    assert "spacing" in {check.name for check in failed(made.verdict.checks)}


def test_a_failed_check_of_a_hole_fails_the_plan(holes):
    bad = replace(holes["distal"].checks[0], passed=False)
    made = _planned({**holes, "distal": replace(holes["distal"], checks=(bad,))})
    assert made.verdict.state == "no-go"


def test_holes_that_could_be_confused_are_refused(holes):
    distal, proximal = holes["distal"], holes["proximal"]
    refuse_confused(distal, proximal, KNOWN, "right")
    refuse_confused(distal, proximal, replace(KNOWN, spacing_mm=None), "right")
    for pair, nail, side, said in (
        ((distal, distal), KNOWN, "right", "the same one"),
        ((proximal, distal), KNOWN, "right", "exchanged"),
        ((distal, proximal), KNOWN, "left", "exchanged"),
        ((distal, proximal), replace(KNOWN, spacing_mm=SPACING_MM + 2.0), "right", "another nail"),
    ):
        with pytest.raises(ReconstructionRefusedError, match=said):
            refuse_confused(*pair, nail, side)


def test_a_hole_from_front_to_back_is_not_drilled_from_lateral(holes):
    hole = holes["distal"]
    turned = replace(hole, entry_mm=hole.entry_mm[[2, 1, 0]], exit_mm=hole.exit_mm[[2, 1, 0]])
    with pytest.raises(ReconstructionRefusedError, match="perpendicular"):
        WirePicks.of_hole(turned, VIEWS)
