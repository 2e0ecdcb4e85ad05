"""The robot's own wire from clicks in both images: a point on it counts across it only, its tip in every direction."""

from typing import Any

import numpy as np
import pytest
from tests.planning.bone import views

from sightline.app.plan.decisions import Decisions, Mark
from sightline.app.plan.planner import ROBOT_WIRE, robot_wire_seen
from sightline.case.views import NAMES
from sightline.errors import RobotRefusedError

VIEWS: Any = tuple(views())
TIP_MM = np.array([5.0, -10.0, 8.0])
ALONG, IN_PLANE = np.array([0.48, 0.6, 0.64]), np.array([0.6, 0.0, 0.8])  # the latter in the plane of both beams
BEHIND_MM = 40.0


def _clicked(
    along: np.ndarray = ALONG, *, slip_mm: float = 0.0, tip_off_px: float = 0.0, without: int | None = None
) -> Decisions:
    """Clicks on the true wire; in the second image the point on its middle is `slip_mm` nearer to the tip."""
    point = TIP_MM - BEHIND_MM * along
    uv = [view.project(np.stack([point + k * slip_mm * along, TIP_MM])) for k, view in enumerate(VIEWS)]
    uv[1][1] += [0.0, tip_off_px]
    decisions = Decisions()
    for n, spec in enumerate(ROBOT_WIRE):
        places = {name: (float(at[n][0]), float(at[n][1])) for name, at in zip(NAMES, uv, strict=True)}
        if without == n:
            del places[NAMES[1]]
        decisions = decisions.with_mark(spec.name, Mark(places))
    return decisions


def _off_line_mm(xyz_mm: np.ndarray, along: np.ndarray) -> np.ndarray:
    off = xyz_mm - TIP_MM
    return off - (off @ along) * along


@pytest.mark.parametrize("slip_mm", [0.0, 8.0])
def test_the_point_is_on_the_wire_wherever_it_was_clicked(slip_mm: float) -> None:
    """Fails for points that are taken to be the same in both images: they leave the wire, or contradict each other."""
    seen = robot_wire_seen(_clicked(slip_mm=slip_mm), VIEWS)
    assert seen is not None and seen.joint_covariance_mm2 is not None
    np.testing.assert_allclose(seen.xyz_mm[1], TIP_MM, atol=1e-6)
    assert np.linalg.norm(_off_line_mm(seen.xyz_mm[0], ALONG)) < 0.02  # a click of 0.5 px is 0.1 mm
    point, tip = seen.joint_covariance_mm2[:3, :3], seen.joint_covariance_mm2[3:, 3:]
    assert ALONG @ point @ ALONG > 10.0**2 > 1.0 > ALONG @ tip @ ALONG  # along the wire nothing is known of it


def test_a_wire_in_the_plane_of_both_beams_has_a_point_as_uncertain_as_it_is() -> None:
    """There the images say nothing of the wire's direction in that plane, whatever point is clicked."""
    seen = robot_wire_seen(_clicked(IN_PLANE, slip_mm=8.0), VIEWS)
    assert seen is not None and seen.joint_covariance_mm2 is not None
    across = np.cross(IN_PLANE, [0.0, 1.0, 0.0])
    sd_mm = float(np.sqrt(across @ seen.joint_covariance_mm2[:3, :3] @ across))
    assert sd_mm > 10.0 * 0.1 > 5.0 * abs(across @ _off_line_mm(seen.xyz_mm[0], IN_PLANE))


def test_without_clicks_the_encoders_remain() -> None:
    assert robot_wire_seen(Decisions(), VIEWS) is None


@pytest.mark.parametrize("without", [0, 1])
def test_a_missing_click_is_refused_and_not_passed_over(without: int) -> None:
    with pytest.raises(RobotRefusedError, match="or remove their marks"):
        robot_wire_seen(_clicked(without=without), VIEWS)


def test_tips_of_two_places_are_refused() -> None:
    normal = robot_wire_seen(_clicked(), VIEWS)
    assert normal is not None
    with pytest.raises(RobotRefusedError, match="click the robot's wire again"):
        robot_wire_seen(_clicked(tip_off_px=40.0), VIEWS)
