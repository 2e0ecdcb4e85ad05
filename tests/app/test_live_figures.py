"""What the page shows of a plan while a point is dragged: equal to the plan made anew of the same points."""

from dataclasses import replace

import numpy as np
import pytest

import sightline as sl
from sightline.app.plan.decisions import Decisions
from sightline.app.plan.planner import moved, planned, request_of
from sightline.calibration import BeadView
from sightline.case.views import NAMES
from sightline.checks import Check
from sightline.frame import Frame
from sightline.studies.scenes import WHOLE, draw_scene

WIRE_MM = {"entry": [33.1, 25.3, -8.2], "end": [-23.7, -24.9, 10.6]}
LANDMARKS_MM = {"landmark-head-centre": [-26.3, -31.9, 12.4], "landmark-lesser-trochanter": [21.2, 42.7, -19.3]}
BEAD_PX = 0.1
# Both are the same sums in another order at most: rounding, of values to 1e3.
ROUNDING = 1e-9


def _views() -> tuple[BeadView, ...]:
    told = replace(Frame.load("gamma"), tolerances=WHOLE)
    scene = draw_scene(np.random.default_rng(57), told, BEAD_PX, targets=4)
    return tuple(sl.calibrate(one, told) for one in scene.observations.values())


@pytest.fixture(scope="module")
def views() -> tuple[BeadView, ...]:
    """The page's views, PA and lateral."""
    return _views()


@pytest.fixture(scope="module")
def placed(views: tuple[BeadView, ...]) -> Decisions:
    """Decisions with wire and landmarks placed in both images."""
    decisions = Decisions(side="right", serial="none")
    for name, xyz in {**WIRE_MM, **LANDMARKS_MM}.items():
        for image, view in zip(NAMES, views, strict=True):
            u, v = view.project(np.array([xyz]))[0].tolist()
            decisions = moved(decisions, views, name, image, (u, v), anew=True)
    return decisions


def _values(checks: tuple[Check, ...]) -> np.ndarray:
    return np.array([one.figure for one in checks if one.figure is not None])


@pytest.mark.parametrize(("name", "image"), [("end", "pa"), ("end", "lateral"), ("entry", "pa")])
def test_each_move_of_a_drag_shows_what_a_plan_made_anew_has(
    views: tuple[BeadView, ...], placed: Decisions, name: str, image: str
) -> None:
    """Catches values that are kept from the start of the drag, or from the move before."""
    u, v = placed.mark(name).at(image) or (np.nan, np.nan)
    shown = []
    for k in range(1, 6):
        at = moved(placed, views, name, image, (u + 3.7 * k, v - 2.3 * k), anew=False)
        shown.append((at, planned(at, views)))
    fresh = _views()  # nothing is known of these
    for at, live in shown:
        whole = request_of(at, 2).plan_on(fresh)
        assert live.plan is not None
        assert [one.sentence for one in live.plan.verdict.checks] == [one.sentence for one in whole.verdict.checks]
        np.testing.assert_allclose(
            _values(live.plan.verdict.checks), _values(whole.verdict.checks), rtol=ROUNDING, atol=ROUNDING
        )
        np.testing.assert_allclose(
            live.plan.trajectory.covariance_mm2, whole.trajectory.covariance_mm2, rtol=ROUNDING, atol=ROUNDING
        )
        np.testing.assert_allclose(live.plan.seen.xyz_mm, whole.seen.xyz_mm, rtol=ROUNDING, atol=ROUNDING)
    lengths = [one.plan.trajectory.length_mm for _, one in shown if one.plan is not None]
    assert len(set(lengths)) == len(shown)  # the moves differ
