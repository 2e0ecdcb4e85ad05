"""What placing and moving a point of the wire comes to: on its curve, or where it was seen."""

import numpy as np
import pytest
from tests.planning import bone
from tests.planning.standin import stand_in

from sightline.app.plan.decisions import Decisions, Mark, Pixel
from sightline.app.plan.planner import Planned, moved, planned
from sightline.calibration import BeadView, calibrate
from sightline.frame import Frame
from sightline.studies.scenes import draw_scene

VIEWS = (stand_in("pa", 0.4, 0.3), stand_in("lateral", -0.2, 0.3))
WIRE = bone.pixels(list(VIEWS))["wire"]
AT = {name: [(float(uv[k][0]), float(uv[k][1])) for uv in WIRE] for k, name in enumerate(("entry", "end"))}
BESIDE_PX = 6.0  # of its curve, so far that a gap tells it


def _placed(*, snapping: bool) -> Decisions:
    """Entry and end, clicked beside their curves in the lateral image."""
    decisions = Decisions(snapping=snapping)
    for name, (pa, lateral) in AT.items():
        decisions = moved(decisions, VIEWS, name, "pa", pa, anew=True)
        decisions = moved(decisions, VIEWS, name, "lateral", _beside(lateral), anew=True)
    return decisions


def _beside(uv: Pixel) -> Pixel:
    return uv[0], uv[1] + BESIDE_PX


def _switched(decisions: Decisions, *, snapping: bool) -> Decisions:
    return Decisions(marks=decisions.marks, snapping=snapping)


def test_the_switch_is_about_the_points_that_are_placed() -> None:
    for name in AT:
        snapped, free = (_placed(snapping=on).mark(name) for on in (True, False))
        assert not snapped.free and free.free
        assert free.at("lateral") == _beside(AT[name][1])
        assert snapped.at("lateral") != _beside(AT[name][1])


def test_a_point_that_was_taken_to_its_curve_is_never_tested_by_its_gap_however_it_is_moved() -> None:
    decisions = _switched(_placed(snapping=True), snapping=False)
    u, v = decisions.mark("end").at("lateral") or (0.0, 0.0)
    for uv in ((u + 0.1, v), _beside((u, v))):
        after = moved(decisions, VIEWS, "end", "lateral", uv, anew=False)
        assert not after.mark("end").free
    known = planned(after, VIEWS)
    assert known.plan is not None
    assert not known.plan.seen.gap_tested[1]
    anew = moved(decisions, VIEWS, "end", "lateral", _beside((u, v)), anew=True)  # clicked again: seen there
    assert anew.mark("end") == Mark({"pa": AT["end"][0], "lateral": _beside((u, v))}, free=True)
    again = planned(anew, VIEWS)
    assert again.plan is not None
    assert again.plan.seen.gap_tested[1]


@pytest.mark.parametrize("snapping", [True, False])
def test_a_free_point_stays_free_until_it_is_moved_while_the_switch_is_on(snapping: bool) -> None:
    decisions = _switched(_placed(snapping=False), snapping=snapping)
    u, v = AT["end"][1]
    assert moved(decisions, VIEWS, "end", "lateral", (u, v + 2.0), anew=False).mark("end").free is not snapping
    slid = moved(decisions, VIEWS, "end", "pa", (AT["end"][0][0] + 3.0, AT["end"][0][1]), anew=False)
    assert slid.mark("end").free
    assert slid.mark("end").at("lateral") == decisions.mark("end").at("lateral")
    assert np.isfinite(planned(slid, VIEWS).plan.trajectory.length_mm)  # type: ignore[union-attr]


def test_the_plans_of_a_drag_are_those_of_a_program_that_starts_there() -> None:
    rng, frame = np.random.default_rng(5), Frame.load("gamma")
    scene = draw_scene(rng, frame, 0.1, targets=4)

    def calibrated() -> list[BeadView]:
        """The same views in objects of their own, of which nothing is remembered."""
        return [calibrate(one, frame) for one in scene.observations.values()]

    dragged = calibrated()
    pixels = np.swapaxes([view.project(scene.target_mm) for view in dragged], 0, 1).tolist()
    decisions = Decisions(side="right")
    for name, uv in zip(("entry", "end", "landmark-head-centre", "landmark-lesser-trochanter"), pixels, strict=True):
        for image, at in zip(("pa", "lateral"), uv, strict=True):
            decisions = moved(decisions, dragged, name, image, (at[0], at[1]), anew=True)
    for step in range(1, 4):
        at = (pixels[1][0][0] + 3.7 * step, pixels[1][0][1] - 2.3 * step)
        decisions = moved(decisions, dragged, "end", "pa", at, anew=False)
        assert not decisions.mark("end").free  # it slides along its curve
        assert _told(planned(decisions, dragged)) == _told(planned(decisions, calibrated()))


def _told(known: Planned) -> list[object]:
    """All that a plan tells, to the bit."""
    plan = known.plan
    assert plan is not None and plan.seen.joint_covariance_mm2 is not None
    arrays = [plan.seen.joint_covariance_mm2, plan.residuals_px, *(one.uv_px for one in known.curves.values())]
    arrays += [plan.anatomy.values, plan.anatomy.covariance] if plan.anatomy is not None else []
    return [plan.document(), plan.verdict.checks, [one.tobytes() for one in arrays if one is not None]]
