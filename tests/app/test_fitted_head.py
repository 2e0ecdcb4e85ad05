"""The head of the step Plan fitted to the edges of its images: one change, undone, kept over a restart, and refused."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from playwright.sync_api import expect
from tests.app.hands import Hands, rehearsal, truth

from sightline.app.plan.decisions import Decisions, FittedHead, Mark
from sightline.app.plan.planner import drawn_head, plan_input
from sightline.case.views import NAMES
from sightline.errors import CaseError
from sightline.planning import Circle


def _drawn() -> Decisions:
    """The wire and three clicks on the head's rim, in both images."""
    decisions = Decisions(side="right")
    for name, where in truth().items():
        decisions = decisions.with_mark(name, Mark({view: where[view] for view in NAMES}))
    return decisions


def _fitted(decisions: Decisions) -> Decisions:
    drawn = drawn_head(decisions)
    assert drawn is not None
    circles = [Circle(one.uv_px + 1.0, one.covariance_px2, one.summary) for one in drawn]
    return replace(decisions, fitted_head=FittedHead.made(circles, {"lateral": "no clear edge"}))


def test_a_fit_comes_back_from_its_json_and_a_broken_one_is_refused() -> None:
    decisions = _fitted(_drawn())
    document = json.loads(json.dumps(decisions.document()))
    assert Decisions.of(document) == decisions
    document["fitted_head"]["circles"][0]["covariance_px2"] = [[1.0]]
    with pytest.raises(CaseError, match="cannot be read"):
        Decisions.of(document)


def test_a_fit_ends_with_another_click_on_the_rim_or_another_image_and_with_nothing_else() -> None:
    """A program that kept it would plan on a head that is not the one drawn, or not of this image."""
    decisions = _fitted(_drawn())
    assert decisions.with_mark("head-2", Mark({"pa": (1.0, 2.0)})).fitted_head is None
    assert decisions.with_mark("head-1", None).fitted_head is None
    assert decisions.with_image("pa", 9, same_pixels=False).fitted_head is None
    assert decisions.with_image("pa", 9, same_pixels=True).fitted_head is not None
    assert decisions.with_image("oblique", 9, same_pixels=False).fitted_head is not None
    assert decisions.with_mark("entry", Mark({"pa": (1.0, 2.0)})).fitted_head is not None


def test_the_plan_takes_the_fitted_circles() -> None:
    drawn = _drawn()
    fitted = _fitted(drawn)
    before, after = (plan_input(one, 2).aids for one in (drawn, fitted))
    assert before is not None and after is not None and before.head is not None and after.head is not None
    for first, second in zip(before.head, after.head, strict=True):
        assert np.array_equal(second.uv_px, first.uv_px + 1.0)
    assert drawn_head(fitted) is not None
    assert np.array_equal(drawn_head(fitted)[0].uv_px, before.head[0].uv_px)  # type: ignore[index]


def _value(words: str, name: str) -> tuple[float, ...]:
    found = re.search(rf"{name} ([\d.]+) ± ([\d.]+)", words)
    assert found, words
    return tuple(map(float, found.groups()))


@pytest.mark.slow
def test_the_page_fits_the_head_states_its_error_and_undoes_it(hands: Hands, shoot) -> None:
    """On a rendered patient: a fit beside the bone would be off by more than it states."""
    hands.confirm()
    hands.step("Plan")
    hands.press("fit-head")
    expect(hands.page.get_by_text("click three points on the head's rim")).to_be_visible()
    hands.plan()
    hands.press("fit-head")
    expect(hands.see("head-fitted")).to_be_visible()
    shoot(hands.page, "head-fitted")
    words = hands.see("head-fitted").inner_text()
    assert "kept as drawn" not in words
    radius, error = _value(words, "radius")
    assert 0.0 < error < 1.0
    assert abs(radius - rehearsal().hip.femur.head_radius_mm) <= error + 0.05  # as rounded
    column = hands.page.locator(".panel")
    assert column.evaluate("panel => panel.scrollHeight <= panel.clientHeight")
    hands.page.keyboard.press("Control+z")
    expect(hands.see("head-fitted")).to_have_count(0)
    hands.page.keyboard.press("Control+y")
    expect(hands.see("head-fitted")).to_have_text(words)
    hands.page.get_by_test_id("xray-pa").get_by_test_id("point-head-1").focus()
    hands.page.keyboard.press("ArrowRight")
    expect(hands.see("head-fitted")).to_have_count(0)
