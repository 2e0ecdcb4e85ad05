"""Three cannulated wires in a real browser, from the plan of the lowest to the check shot of all."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.hands import PATIENCE_MS, SEED, Hands, Pixels, by_image, rehearsal

from sightline.app.plan.decisions import Decisions
from sightline.app.plan.marks import marks_of
from sightline.case.journal import Case, Kind
from sightline.case.views import NAMES
from sightline.planning.procedures.files import document_of
from sightline.rehearsal.patient import CANNULATED, RehearsedPatient
from sightline.robot.control.states import State
from sightline.robot.link.simulated import SimulatedWire

WIRES = tuple(wire.key for wire in document_of(CANNULATED).wires)
KINDS = tuple(f"{CANNULATED}:{key}" for key in WIRES)
ORDERS = (("align", State.ALIGNED), ("drill", State.PAUSED), ("drill-on", State.DONE))


def _patient() -> RehearsedPatient:
    whom = rehearsal()
    return RehearsedPatient(whom.seed, whom.setup, whom.bone, CANNULATED)


def _ends() -> list[dict[str, Pixels]]:
    """Entry and end of each wire."""
    patient = _patient()
    uv = [patient.pixels(wire) for wire in patient.wires_mm]
    return [by_image({"entry": one[:, 0], "end": one[:, 1]}) for one in uv]


def _bone() -> dict[str, Pixels]:
    """Landmarks and aids."""
    patient = _patient()
    named = zip(patient.landmark_keys, patient.landmarks.values(), strict=True)
    found = by_image({f"landmark-{key}": uv for key, uv in named})
    for key, each in patient.aids_px.items():
        for view, uv in zip(NAMES, each, strict=True):
            for k, at in enumerate([] if uv is None else uv):
                found.setdefault(f"{key}-{k + 1}", {})[view] = (float(at[0]), float(at[1]))
    return found


@pytest.mark.slow  # a server, a browser, and three wires drilled
def test_three_wires_are_planned_drilled_and_verified(
    serve: Callable[..., Server], open_page: Callable[..., Page], tmp_path: Path, shoot
) -> None:
    command = ["sightline", "app", "--port", "{port}", "--no-browser", "--quiet", "--fast-robot"]
    server = serve(*command, "--case", str(tmp_path / "case"), "--rehearse", str(SEED))
    hands = Hands(open_page(server.url))
    hands.wait_for_step("Calibrate", "done")
    hands.confirm()
    hands.step("Plan")
    hands.see("kind").click()
    hands.page.get_by_role("option", name="Cannulated hip screws", exact=True).click()
    _place_wires(hands, shoot)
    hands.step("Drill")
    hands.press("start-robot")
    expect(hands.see("robot-state")).to_be_visible(timeout=PATIENCE_MS)
    expect(hands.see("drilling-order")).to_contain_text("Drill the inferior wire, then the")
    order = _drill_all(hands, shoot)
    assert order[0] == WIRES[0] and sorted(order) == sorted(WIRES)
    hands.page.reload()
    for key in WIRES:
        _wait_for(hands, key, "drilled")
    _verify_all(hands, tmp_path / "case", shoot)
    with Case.open(tmp_path / "case", read_only=True) as case:
        sent = [Decisions.of(one.content["decisions"]).kind for one in case.entries(Kind.SENT)]
        assert sent == [f"{CANNULATED}:{key}" for key in order] and len(case.entries(Kind.DRILLED)) == len(WIRES)
        assert any(one.content.get("passed") for one in case.entries(Kind.VERIFIED))


def _place_wires(hands: Hands, shoot) -> None:
    """The lowest wire, the bone, the others as proposed; then these where they belong, for the bone flares."""
    ends, bone = _ends(), _bone()
    _place(hands, ends[0])
    for name in [one.name for one in marks_of(KINDS[0]) if one.group == "landmark"]:
        for view in NAMES:
            hands.place(name, view, bone[name][view])
    for aid in dict.fromkeys(name.rsplit("-", 1)[0] for name in bone if not name.startswith("landmark-")):
        hands.aid(aid, bone)
    hands.page.keyboard.press("Escape")
    expect(hands.see("verdict")).to_contain_text("INCOMPLETE")
    _wait_for(hands, WIRES[0], "GO")
    _wait_for(hands, WIRES[1], "not placed")
    hands.press("propose-others")
    for key in WIRES:
        _wait_for(hands, key, "GO")
    expect(hands.see("verdict")).to_contain_text("Every check passed")
    shoot(hands.page, "three-proposed")
    for key, where in zip(WIRES[1:], ends[1:], strict=True):
        _choose(hands, key)
        for point in ("entry", "end"):
            hands.press(f"remove-{point}")
        _wait_for(hands, key, "not placed")
        _place(hands, where)
        _wait_for(hands, key, "GO")
    hands.press("undo")
    _wait_for(hands, WIRES[2], "not placed")
    hands.press("redo")
    expect(hands.see("verdict")).to_contain_text("Every check passed")
    shoot(hands.page, "three-planned")


def _place(hands: Hands, ends: dict[str, Pixels]) -> None:
    for view in NAMES:
        for name in ("entry", "end"):
            hands.place(name, view, ends[name][view])


def _choose(hands: Hands, key: str) -> None:
    hands.press(f"wire-{key}")
    expect(hands.see(f"wire-{key}")).to_have_attribute("aria-pressed", "true")


def _wait_for(hands: Hands, key: str, state: str) -> None:
    expect(hands.see(f"wire-{key}")).to_contain_text(
        re.compile(rf"(?<!NO-)(?<!NOT ){re.escape(state)}$"), timeout=PATIENCE_MS
    )


def _drill_all(hands: Hands, shoot) -> list[str]:
    """Drill in the order that the page leads through, and return it."""
    _choose(hands, WIRES[0])
    order = []
    while True:
        chosen = hands.page.locator(".wires [aria-pressed=true]")
        key = (chosen.get_attribute("data-testid") or "").removeprefix("wire-")
        order.append(key)
        expect(hands.see("send")).to_be_enabled(timeout=PATIENCE_MS)
        hands.press("send")
        hands.press("send-yes")
        for press, state in ORDERS:
            expect(hands.see(press)).to_be_enabled(timeout=PATIENCE_MS)
            hands.press(press)
            hands.press(f"{press}-yes")
            expect(hands.see("robot-state")).to_have_attribute("data-state", state.value, timeout=PATIENCE_MS)
        _wait_for(hands, key, "drilled")
        shoot(hands.page, f"three-drilled-{len(order)}")
        hands.press("retract")
        hands.press("retract-yes")
        expect(hands.see("robot-state")).to_have_attribute("data-state", State.PLANNING.value, timeout=PATIENCE_MS)
        if len(order) == len(WIRES):
            expect(hands.see("next-wire")).to_have_count(0)
            return order
        hands.press("next-wire")
        expect(hands.see(f"wire-{key}")).to_have_attribute("aria-pressed", "false")


def _verify_all(hands: Hands, folder: Path, shoot) -> None:
    """One check shot shows all wires; wires that lie behind each other in an image may be refused."""
    hands.step("Verify")
    hands.press("take-check")
    with Case.open(folder, read_only=True) as case:
        *before, newest = [SimulatedWire.of(one.content["simulated_wire"]) for one in case.entries(Kind.DRILLED)]
    for view in NAMES:
        hands.until(view, "core.state.layers.get('found')?.shapes.length > 0")
    patient = replace(rehearsal(), procedure=CANNULATED)
    axes = {key: one.axis_mm for key, one in zip(WIRES, before, strict=False)}
    check = patient.check_images(newest, WIRES[2], axes)
    for key, name in zip(patient.landmark_keys, patient.landmarks, strict=True):
        for view in NAMES:
            at = check.setup.views[view].project(check.landmarks_mm[name][None])[0]
            hands.place(f"landmark-{key}", view, (float(at[0]), float(at[1])))
    _wait_for(hands, WIRES[0], "verified")
    shoot(hands.page, "three-verified")
