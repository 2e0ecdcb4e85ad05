"""The holes of a nail in a real browser: both are planned, one is drilled and checked. `demo` drills both."""

import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.eyes import wrong
from tests.app.hands import PATIENCE_MS, Hands
from tests.worked import unrendered

from sightline.app.plan.decisions import Decisions
from sightline.app.plan.marks import NAIL_EDGES
from sightline.app.plan.planner import ROBOT_WIRE
from sightline.case.journal import Case, Entry, Kind
from sightline.case.replay import ReplayOutcome, replay
from sightline.case.views import NAMES
from sightline.frame import Frame
from sightline.rehearsal.patient import NAILED
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.robot.control.states import State
from sightline.robot.link.record import SimulatedWire

KEYS = ("distal", "proximal")
MOST_CLICKS = 24  # from opening the page to GO
ARROW_PX = 250.0  # ten times 5 mm at 5 pixels to the millimetre; a drill is planned 15 mm past its far hole
LIMIT_MM = 0.5  # a drill of 4 mm in a hole of 5 mm
ORDERS = (("align", State.ALIGNED), ("drill", State.PAUSED), ("drill-on", State.DONE))


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


def _drill(hands: Hands, shoot) -> str:
    """Drill the chosen hole, retract, and return its key."""
    chosen = hands.page.locator(".wires [aria-pressed=true]")
    key = (chosen.get_attribute("data-testid") or "").removeprefix("wire-")
    expect(hands.see("send")).to_be_enabled(timeout=PATIENCE_MS)
    hands.press("send")
    shoot(hands.page, f"nail-walk-send-{key}")
    hands.press("send-yes")
    for press, state in ORDERS:
        expect(hands.see(press)).to_be_enabled(timeout=PATIENCE_MS)
        hands.press(press)
        shoot(hands.page, f"nail-walk-{press}-{key}")
        hands.press(f"{press}-yes")
        expect(hands.see("robot-state")).to_have_attribute("data-state", state.value, timeout=PATIENCE_MS)
    _wait_for(hands, key, "drilled")
    assert not wrong(hands.page, scrolls=True)
    depth, tip = (
        float(re.search(rf"{before}\s*(-?\d+\.\d) mm", hands.see("depth").inner_text())[1]) for before in ("", "tip")
    )
    assert tip == depth
    expect(hands.see("drilled")).to_contain_text("Drilled to the planned depth")
    shoot(hands.page, f"nail-walk-drilled-{key}")
    hands.press("retract")
    hands.press("retract-yes")
    expect(hands.see("robot-state")).to_have_attribute("data-state", State.PLANNING.value, timeout=PATIENCE_MS)
    return key


def _wait_for(hands: Hands, key: str, state: str) -> None:
    expect(hands.see(f"wire-{key}")).to_contain_text(
        re.compile(rf"(?<!NO-)(?<!NOT ){re.escape(state)}$"), timeout=PATIENCE_MS
    )


def _check(hands: Hands, patient: Rehearsal, folder: Path, shoot) -> None:
    """Take the check shot of the drilled hole, and find the landmarks again."""
    hands.step("Verify")
    hands.press("take-check")
    with Case.open(folder, read_only=True) as case:
        (drilled,) = (SimulatedWire.of(one.content["simulated_wire"]) for one in case.entries(Kind.DRILLED))
    key = KEYS[0]
    true = unrendered(patient.check_images, drilled, key, {})
    for mark, name in zip(patient.landmark_keys, patient.landmarks, strict=True):
        for view in NAMES:
            at = true.setup.views[view].project(true.landmarks_mm[name][None])[0]
            hands.place(f"landmark-{mark}", view, (float(at[0]), float(at[1])))
    expect(hands.see("check-verdict")).to_contain_text("PASSED", timeout=PATIENCE_MS)
    expect(hands.see("check-verdict")).to_contain_text("Judged at both holes of the nail")
    expect(hands.see("deviation")).to_contain_text("tip, not judged")
    _wait_for(hands, key, "verified")
    drawn = "core.state.layers.get('found').shapes.filter((one) => one.shape === 'arrow').map((one) => one.points)"
    for view in NAMES:
        for start, end in hands.core(view, drawn):
            assert math.dist(start, end) < ARROW_PX
    shoot(hands.page, f"nail-walk-checked-{key}")


def _off_mm(sent: Entry, drilled: Entry) -> np.ndarray:
    """The true distances (2,) of the drill's axis from both ends of the plan that was sent, mm."""
    start, tip = SimulatedWire.of(drilled.content["simulated_wire"]).axis_mm
    along = (tip - start) / np.linalg.norm(tip - start)
    plan = sent.content["trajectory"]
    off = np.array([plan["entry_mm"], plan["end_mm"]]) - start
    return np.linalg.norm(off - np.outer(off @ along, along), axis=1)


@pytest.mark.slow  # a server, a browser, and a hole drilled
def test_both_holes_are_planned_and_the_first_is_drilled_and_checked_before_the_next(
    serve: Callable[..., Server], open_page: Callable[..., Page], tmp_path: Path, shoot
) -> None:
    """Fails for a page that a person cannot follow by its buttons and instructions alone, for a drill that touches a
    wall, and for a check shot that is wrong by more than it states."""
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
    assert _drill(hands, shoot) == KEYS[0]
    _check(hands, patient, folder, shoot)
    expect(hands.see("instruction")).to_contain_text("go on with the next one")
    hands.press("next-wire")
    expect(hands.see("step-drill")).to_have_attribute("aria-current", "step")
    expect(hands.page.locator(".wires [aria-pressed=true]")).to_have_attribute("data-testid", f"wire-{KEYS[1]}")
    with Case.open(folder, read_only=True) as case:
        (sent,), (drilled,) = case.entries(Kind.SENT), case.entries(Kind.DRILLED)
        assert Decisions.of(sent.content["decisions"]).kind == f"{NAILED}:{KEYS[0]}"
        assert sent.content["registered_by"] == "images"
        shot = case.latest(Kind.VERIFIED)
        off_mm = _off_mm(sent, drilled)
        assert shot is not None and shot.rests_on[0] == sent.rests_on[0] and (off_mm < LIMIT_MM).all()
        assert abs(shot.content["deviation"]["entry_mm"] - off_mm[0]) < shot.content["error_95"]["entry_mm"]
        again = [one for one in replay(case) if one.outcome is not ReplayOutcome.RECORDED]
        assert all(one.passed for one in again), [(one.entry.kind, one.said, one.reason) for one in again]
