"""The shots while drilling in a browser: the block is on the patient, a person clicks, and reads what to do."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.drilling import truth
from tests.app.hands import PATIENCE_MS, SEED, Hands, Pixels, by_image

from sightline.case.journal import Case, Kind
from sightline.case.views import NAMES
from sightline.frame import Frame
from sightline.planning.check.drill_shot import ALIGNED, PAUSED
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.robot.link.simulated import SimulatedWire


def _plan(patient: Rehearsal) -> dict[str, Pixels]:
    """Where each mark of the plan belongs."""
    wire, rim = patient.pixels(patient.hip.wire_mm), patient.head_rim
    named = zip(patient.landmark_keys, patient.landmarks.values(), strict=True)
    places = {"entry": wire[:, 0], "end": wire[:, 1]} | {f"head-{k + 1}": rim[:, k] for k in range(3)}
    return by_image(places | {f"landmark-{key}": uv for key, uv in named})


def _shot(patient: Rehearsal, told: Path, state: str) -> dict[str, Pixels]:
    """Where each mark of the shot that was taken belongs."""
    at = json.loads(told.read_text())
    true = patient.drilling_images(SimulatedWire.of(at["wire"]), np.array(at["q"]), state, on_patient=True)
    return by_image(dict(truth(patient, true)))


def _order(hands: Hands, what: str, state: str) -> None:
    expect(hands.see(what)).to_be_enabled(timeout=PATIENCE_MS)
    hands.press(what)
    hands.press(f"{what}-yes")
    if state:
        expect(hands.see("robot-state")).to_have_attribute("data-state", state, timeout=PATIENCE_MS)


def _decision(hands: Hands, word: str, told: str) -> None:
    expect(hands.see("shot-verdict")).to_contain_text(word, timeout=PATIENCE_MS)
    expect(hands.see("shot-verdict")).to_contain_text(told)
    expect(hands.see("verdict")).to_have_count(0)  # a plan's GO beside it would mislead


def _click(hands: Hands, known: dict[str, Pixels], group: str) -> None:
    listed = [name for name in known if name.startswith(group)]
    if group == "guide":
        goals = [(name, view) for view in NAMES for name in listed]
    else:
        goals = [(name, view) for name in listed for view in NAMES]
    for name, view in goals:
        hands.place(name, view, known[name][view])


@pytest.mark.slow  # a server, a browser, and a wire drilled to the pause
def test_a_person_measures_both_shots_with_the_block_on_the_patient(
    serve: Callable[..., Server], open_page: Callable[..., Page], tmp_path: Path, shoot
) -> None:
    """Fails for a page that cannot show a shot, that keeps a GO on top of its STOP, or that drills after it."""
    patient, told = Rehearsal.draw(SEED, Frame.load("block60")), tmp_path / "shot.json"
    command = ["tests.app.shot_app", str(told), "app", "--port", "{port}", "--no-browser", "--quiet", "--fast-robot"]
    server = serve(*command, "--case", str(tmp_path / "case"), "--rehearse", str(SEED), "--frame", "block60")
    hands = Hands(open_page(server.url))
    hands.wait_for_step("Calibrate", "done")
    hands.confirm()
    hands.plan(_plan(patient))
    hands.page.keyboard.press("Escape")
    hands.step("Drill")
    hands.press("start-robot")
    _order(hands, "send", "")
    _order(hands, "align", ALIGNED)
    expect(hands.see("verdict")).to_contain_text("GO")
    _order(hands, "frame-on-patient", ALIGNED)
    expect(hands.see("on-patient")).to_be_visible()
    hands.press("take-shot")
    hands.until("pa", "core.state.placing === value", "guide-1")
    known = _shot(patient, told, ALIGNED)
    _click(hands, known, "guide")
    _decision(hands, "INCOMPLETE", "Find 3 landmarks of the plan or more in both images")
    _click(hands, known, "landmark")
    _decision(hands, "INCOMPLETE", "find more landmarks again")  # three do not tell the line well enough
    shoot(hands.page, "shot-incomplete")
    hands.page.get_by_test_id("xray-pa").get_by_test_id("point-landmark-head-centre").focus()
    for _ in range(12):
        hands.page.keyboard.press("ArrowRight")
    _decision(hands, "STOP", "")
    expect(hands.see("drill")).to_be_disabled()
    shoot(hands.page, "shot-stop")
    for _ in range(12):
        hands.page.keyboard.press("ArrowLeft")
    _decision(hands, "INCOMPLETE", "find more landmarks again")
    _order(hands, "drill", PAUSED)
    expect(hands.see("verdict")).to_be_visible()  # the shot of before shows another moment
    hands.press("take-shot")
    hands.until("pa", "core.state.placing === value", "landmark-head-centre")
    _click(hands, _shot(patient, told, PAUSED), "landmark")
    _decision(hands, "GO", "The wire is on the plan")
    shoot(hands.page, "shot-go")
    hands.press("send-measured")
    expect(hands.see("robot-live")).to_contain_text("second shot", timeout=PATIENCE_MS)
    with Case.open(tmp_path / "case", read_only=True) as case:
        assert [one.content["decision"] for one in case.entries(Kind.SHOT)][-1] == "GO"
        changed = [one.content["what"] for one in case.entries(Kind.CHANGED)]
        assert changed.count("frame on patient") == changed.count("second shot") == 1
