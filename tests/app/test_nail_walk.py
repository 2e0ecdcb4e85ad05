"""The holes of a nail in a real browser: both are planned, one is sent to the robot. `demo` drills and checks both."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.eyes import wrong
from tests.app.hands import PATIENCE_MS, Hands

from sightline.app.plan.decisions import Decisions
from sightline.app.plan.marks import NAIL_EDGES
from sightline.app.plan.planner import ROBOT_WIRE
from sightline.case.journal import Case, Kind
from sightline.case.views import NAMES
from sightline.frame import Frame
from sightline.rehearsal.patient import NAILED
from sightline.rehearsal.rehearsal import Rehearsal

KEYS = ("distal", "proximal")
MOST_CLICKS = 24  # from opening the page to GO


def _plan(hands: Hands, patient: Rehearsal, shoot) -> None:
    """The nail that the page names, and the clicks in the order in which the page asks for them."""
    asked = patient.asked(patient.generator("picks"), 0.5)[0]
    nail, marks, wire_mm = asked.nail, asked.landmarks_uv_px, patient.robot_wire_mm
    assert nail is not None and marks is not None and wire_mm is not None
    hands.step("Plan")
    expect(hands.see("kind")).to_contain_text("Interlocking holes")
    expect(hands.see("instruction")).to_contain_text("Choose the nail")
    assert not wrong(hands.page, scrolls=False)
    told = hands.see("instruction").inner_text()
    named = re.search(r"the simulated patient has (.+?)\. Or by hand", told)
    assert named is not None, told
    hands.see("nail").click()
    hands.page.get_by_role("option", name=f"Nail: {named[1]}", exact=True).click()
    where = {spec.name: nail.strokes_px[:, n // 2, n % 2] for n, spec in enumerate(NAIL_EDGES)}
    where |= {f"hole-{key}": nail.clicks_px[key] for key in KEYS}
    for k, image in enumerate(NAMES):
        for n, (name, uv) in enumerate(where.items(), 1):
            expect(hands.see("instruction")).to_contain_text(f"{len(where) * k + n} of 22")
            hands.place(name, image, tuple(uv[k]))
    shoot(hands.page, "nail-walk-drawn")
    for n, name in enumerate(asked.landmark_names):
        for k, image in enumerate(NAMES):
            hands.place(f"landmark-{name}", image, tuple(marks[k, n]))
        if n == 1:
            expect(hands.see("verdict")).to_contain_text("Every check passed")
            assert hands.page.evaluate("window.clicks") < MOST_CLICKS
            expect(hands.see("skip")).to_be_visible()  # a third one is for the check shot
    uv_px = patient.pixels(wire_mm)
    uv_px[1, 0] = 0.8 * uv_px[1, 0] + 0.2 * uv_px[1, 1]  # another point of the wire than in the first image
    for k, image in enumerate(NAMES):
        for spec, uv in zip(ROBOT_WIRE, uv_px[k], strict=True):
            hands.place(spec.name, image, tuple(uv))
    expect(hands.see("instruction")).to_have_text("GO: every check passed.")
    shoot(hands.page, "nail-walk-planned")
    expect(hands.see("turns")).to_be_visible()
    assert not wrong(hands.page, scrolls=False)


def _fits_for_three_screws(hands: Hands) -> None:
    """The longest column: three wires, their aids, and the robot's own wire beside a block."""
    page = hands.page
    hands.step("Plan")
    for name in ("Cannulated hip screws", "Interlocking holes"):
        hands.see("kind").click()
        page.get_by_role("option", name=name, exact=True).click()
        expect(hands.see("kind")).to_contain_text(name)
        assert not wrong(page, scrolls=False)


@pytest.mark.slow  # a server, a browser, and a robot started
def test_both_holes_are_planned_and_the_first_is_sent(
    serve: Callable[..., Server], open_page: Callable[..., Page], tmp_path: Path, shoot
) -> None:
    """Fails for a page that a person cannot follow by its buttons and instructions alone, and for a hole that is sent
    as the encoders have it."""
    folder = tmp_path / "case"
    command = ["sightline", "app", "--port", "{port}", "--no-browser", "--quiet", "--fast-robot"]
    server = serve(*command, "--case", str(folder), "--procedure", NAILED)
    patient = Rehearsal.draw(2, Frame.load("block60"), procedure=NAILED)
    hands = Hands(open_page(server.url))
    hands.page.evaluate("() => { window.clicks = 0; addEventListener('pointerdown', () => ++window.clicks, true); }")
    hands.wait_for_step("Calibrate", "done")
    hands.confirm()
    clicks = hands.page.evaluate("window.clicks")
    _fits_for_three_screws(hands)
    hands.step("Images")
    hands.details()
    expect(hands.see("shortcuts")).to_be_visible()
    expect(hands.see("orientation")).to_have_count(0)  # a block says nothing of the patient
    hands.details()
    shoot(hands.page, "nail-walk-images")
    hands.page.evaluate("clicks => { window.clicks = clicks }", clicks)
    _plan(hands, patient, shoot)
    hands.press("continue")
    hands.press("start-robot")
    expect(hands.see("robot-state")).to_be_visible(timeout=PATIENCE_MS)
    expect(hands.page.locator(".wires [aria-pressed=true]")).to_have_attribute("data-testid", f"wire-{KEYS[0]}")
    expect(hands.see("send")).to_be_enabled(timeout=PATIENCE_MS)
    hands.press("send")
    shoot(hands.page, "nail-walk-send")
    hands.press("send-yes")
    expect(hands.see("align")).to_be_enabled(timeout=PATIENCE_MS)
    assert not wrong(hands.page, scrolls=True)
    with Case.open(folder, read_only=True) as case:
        (sent,) = case.entries(Kind.SENT)
        assert Decisions.of(sent.content["decisions"]).kind == f"{NAILED}:{KEYS[0]}"
        assert sent.content["registered_by"] == "images"
