"""The four figures of a plan: of the current wire alone, in mm and degrees, none rounded to the limit that it fails."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from markupsafe import Markup
from tests.app.hands import KIND
from tests.app.test_several_wires import KINDS, VIEWS, _decided, _ends
from tests.planning.bone import CENTRE_MM, ENTRY_MM, LESSER_MM, ON_SHAFT_MM, views
from tests.planning.test_wires import WIRES_MM

from sightline.app import texts
from sightline.app.panels import verdict
from sightline.app.panels.section import checks_html
from sightline.app.plan.planner import Planned, planned
from sightline.common.checks import Check
from sightline.planning import plan
from sightline.planning.points.results import MAX_GAP_SIGMA


def _said(known: Any, kind: str) -> list[str]:
    """What stands in the four figures: name, value, limit."""
    tab: Any = SimpleNamespace(known=known, planning=SimpleNamespace(decisions=SimpleNamespace(kind=kind)))
    whole = verdict.figures_html(tab).split('<div class="figure ')[1:]
    return [Markup(f"<p {one}").striptags() for one in whole]  # noqa: S704 - to take the tags away


@pytest.mark.parametrize("current", [0, 1, 2])
def test_of_several_wires_the_figures_are_those_of_the_current_one(current: int) -> None:
    """Fails a page that shows the errors of the wire that is drilled first, whichever is chosen. The shorter a wire,
    the larger the error of its direction."""
    decisions = _decided(current=current)
    for kind, wire, share in zip(KINDS, WIRES_MM, (0.5, 0.7, 1.0), strict=True):
        decisions = decisions.with_ends(kind, _ends(np.stack([wire[0], (1 - share) * wire[0] + share * wire[1]])))
    known = planned(decisions, VIEWS)
    path = known.plans[KINDS[current]].trajectory
    entry, tip, direction, _ = _said(known, KINDS[current])
    assert f"{path.entry_error_95_mm:.2f} mm" in entry
    assert f"{path.end_error_95_mm:.2f} mm" in tip
    assert f"{np.rad2deg(path.direction_error_95_rad):.2f}°" in direction
    told = {f"{np.rad2deg(known.plans[kind].trajectory.direction_error_95_rad):.2f}" for kind in KINDS}
    assert len(told) == len(KINDS)  # else it would prove nothing


def test_a_wire_that_is_not_placed_has_no_figures_of_another_one() -> None:
    known = planned(_decided(2, current=2), VIEWS)
    assert known.verdict is not None  # on the two others
    assert [one.count("–") for one in _said(known, KINDS[2])] == [1, 1, 1, 1]


@pytest.mark.parametrize("moved_mm", [0.0, 2.0])
def test_a_movement_of_the_bone_is_told_in_mm_with_its_limit(moved_mm: float) -> None:
    """Fails a page that tells it in standard deviations, which a surgeon does not read."""
    pair = views()
    marks = np.array([CENTRE_MM, LESSER_MM, ON_SHAFT_MM])
    moved = [np.zeros(3), np.array([0.0, moved_mm, 0.0])]
    uv = np.array([view.project(marks + shift) for view, shift in zip(pair, moved, strict=True)])
    ends = np.array([view.project(np.array([ENTRY_MM, CENTRE_MM])) for view in pair])
    made = plan(pair, ends[:, 0], ends[:, 1], procedure="free-wire", side="right", landmarks_uv_px=uv)
    seen = made.seen
    assert seen.shift_mm is not None and seen.shift_sd_mm is not None
    said = _said(SimpleNamespace(plan=made), "free-wire")[3]
    assert texts.FIGURES["movement"] in said and "σ" not in said
    assert f"{abs(seen.shift_mm):.2f} mm" in said and f"at most {MAX_GAP_SIGMA * seen.shift_sd_mm:.2f} mm" in said


@pytest.mark.parametrize("passed", [True, False])
def test_a_movement_between_three_images_is_told_in_words(passed: bool) -> None:
    check = Check("movement", passed, 21.3, 22.5 if passed else 20.5, "χ²", "")
    seen = SimpleNamespace(movement=object(), shift_mm=None, shift_sd_mm=None)
    known = SimpleNamespace(plan=SimpleNamespace(verdict=SimpleNamespace(checks=(check,)), seen=seen))
    said = _said(known, "free-wire")[3]
    assert texts.FIGURE_MOVED[passed] in said and "χ²" not in said and "21" not in said


def test_a_failed_value_never_reads_like_its_limit() -> None:
    checks = (Check("entry error", False, 1.0004, 1.0, "mm", ""), Check("end error", True, 0.9996, 1.0, "mm", ""))
    known = SimpleNamespace(plan=SimpleNamespace(verdict=SimpleNamespace(checks=checks), seen=None))
    entry, tip, *_ = _said(known, KINDS[0])
    assert "1.0004 mm" in entry and "at most 1.0000 mm" in entry
    assert "1.00 mm" in tip and "at most 1.00 mm" in tip


def test_the_error_of_a_distance_does_not_read_like_a_clearance() -> None:
    """The tip must be farther from the joint than the error of that distance: fails where it is shown as a clearance
    that is enough, "at least 0.22 mm"."""
    check = Check("tip in head", True, 5.01, 0.22, "mm", "")
    tad = Check("tip-apex distance", True, 17.12, 25.0, "mm", "", error_95=0.61)

    def fourth(*checks: Check) -> str:
        made = SimpleNamespace(verdict=SimpleNamespace(checks=checks), seen=None)
        return _said(SimpleNamespace(plan=made), KIND)[3]

    said = fourth(check)
    assert "17.1 mm" in fourth(check, tad) and "± 0.6, at most 25.0" in fourth(check, tad)
    assert "5.01 mm" in said and "± 0.22 mm (95 %)" in said and "at least" not in said
    assert "5.01 mm, ± 0.22 mm (95 %)" in checks_html([check], testid="")


def test_the_robot_s_errors_are_unknown_before_it_has_the_plan() -> None:
    """Fails a table that states them as 0.00 mm."""
    known: Planned = planned(_decided(), VIEWS)
    drilling = SimpleNamespace(held=None, session=None, changed="")
    tab: Any = SimpleNamespace(
        known=known, planning=SimpleNamespace(planned=known), session=SimpleNamespace(drilling=drilling)
    )
    robot = verdict._shares(tab).split("</i>robot</th>")[1].split("</tr>")[0]
    assert robot.count("<td>–</td>") == 3
