"""The page of a rehearsed patient in a real browser, by mouse and keyboard: what a person does, right and wrong.

One server and one tab serve all tests, which run in their order: a test leaves the plan as it found it. Each begins
with `_planned`, so that it runs alone too.
"""

import json
import os
import re
import signal
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Locator, Page, Route, expect
from tests.app import program
from tests.app.bidi import find_firefox, firefox
from tests.app.browser import Server, Tab, stroke
from tests.app.eyes import unread, written, wrong
from tests.app.hands import LANDMARKS, PATIENCE_MS, SEED, Hands, rehearsal, truth
from tests.systems import needs_posix
from tests.worked import Worked, unrendered

from sightline.app.drawing.pictures import as_u16
from sightline.app.panels.top import size_of
from sightline.app.plan.decisions import Decisions
from sightline.app.texts import STEPS, XRAY
from sightline.case import stages
from sightline.case.journal import Actor, Case, Kind
from sightline.case.picks import Picks
from sightline.case.replay import ReplayOutcome, replay
from sightline.case.views import NAMES
from sightline.imaging import Radiograph, write_dicom
from sightline.planning.procedures.procedure import shipped
from sightline.robot.control.states import State
from sightline.robot.kinematics.target import LIFETIME_S
from sightline.robot.link.record import SimulatedWire

pytestmark = pytest.mark.slow  # a server, a browser, a robot and images for all of them
SEEN_PX = 1.2  # a click is a whole pixel of the screen, the image drawn at 0.45: half of one over that
# How far a point is from [name, u, v], px.
_AWAY = "Math.hypot(core.state.points.get(value[0]).uv[0] - value[1], core.state.points.get(value[0]).uv[1] - value[2])"
REFUSED = ("422",)  # what the browser itself says of a refused upload
GONE = ("WebSocket", "ERR_", "Failed to load")  # what it says of a server that was killed
SIZES = ((1280, 800), (1024, 768), (800, 1280))
LONG = (  # the longest sentence of a check that a person meets while planning
    "The gaps of 3 free points together are 2.3 times what picks and views explain; the picks are less accurate than "
    "stated, or the patient moved: pick all points again, or state a larger error of the picks, which increases the "
    "plan's own error."
)
_RUN_AXE = "axe.run({ rules: { 'label-content-name-mismatch': { enabled: true } } })"
_CONTROL, _ENTER = "\ue009", "\ue007"
JUNK = b"\0" * 128 + b"DICM" + b"junk"
_MARK = "document.querySelector('[data-testid=show-beads] .q-checkbox__indet').getBoundingClientRect().width"
# Click a step; resolves to the step of the history's entry in the moment in which the page shows the new step.
_ENTRY_WHEN_SHOWN = """(step) => new Promise((done) => {
  const button = document.querySelector(`[data-testid="step-${step}"]`);
  new MutationObserver(() => {
    if (button.getAttribute("aria-current") === "step") done(history.state.sightline);
  }).observe(document.body, { subtree: true, attributeFilter: ["aria-current"] }); // after the page's own observer
  button.click();
})"""
# Back and Forward before the server hears of either.
_BACK_AND_FORWARD = """async () => {
  const { socket } = window, emit = socket.emit, held = [];
  socket.emit = (...told) => held.push(told);
  const popped = (go) => new Promise((done) => { window.addEventListener("popstate", done, { once: true }); go(); });
  await popped(() => history.back());
  await popped(() => history.forward());
  socket.emit = emit;
  for (const told of held) socket.emit(...told);
  return held.filter(([kind]) => kind === "event").length;
}"""
_AT = "(step) => history.state?.sightline === step"
CONTROLS = Path(__file__).with_name("controls.js").read_text("utf-8")
AXE = (files("axe_playwright_python") / "axe.min.js").read_text("utf-8")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, worked: Worked) -> Path:
    """The folder that the program of the tests reads."""
    made = tmp_path_factory.mktemp("program")
    program.prepare(made, worked.demo)
    return made


@pytest.fixture(scope="module")
def folder(place: Path) -> Path:
    """The folder of the case."""
    return place / "cases" / "1"


@pytest.fixture(scope="module")
def server(serve: Callable[..., Server], place: Path, folder: Path) -> Server:
    command = ["tests.app.program", str(place), "app", "--port", "{port}", "--no-browser", "--case", str(folder)]
    return serve(*command, "--rehearse", str(SEED), "--fast-robot", "--quiet")


@pytest.fixture(scope="module")
def tab(browser: Browser, server: Server) -> Iterator[Tab]:
    made = Tab(browser, server.url)
    yield made
    made.close()


@pytest.fixture
def hands(tab: Tab, place: Path) -> Iterator[Hands]:
    """A person before the page, its images calibrated; at the end nothing may have left this machine or failed."""
    (place / "go").touch()
    person = Hands(tab.page)
    tab.page.bring_to_front()  # the browser draws a page behind another one once a second
    tab.page.set_viewport_size({"width": 1280, "height": 800})
    person.wait_for_step("Calibrate", "done")
    yield person
    tab.check()


@pytest.fixture(scope="module")
def beside(browser: Browser, server: Server) -> Iterator[Hands]:
    """A person before a second page."""
    made = Tab(browser, server.url)
    yield Hands(made.page)
    made.close()
    made.check(GONE)


def _planned(hands: Hands) -> None:
    """On the step Plan with a plan that is GO, by the true points."""
    if "done" not in hands.see("step-plan").inner_text():
        if "done" not in hands.see("step-images").inner_text():
            hands.confirm()
        hands.plan()
    hands.step("Plan")
    expect(hands.see("figures")).to_contain_text("±")  # the tip-apex distance with its error


def _rest(page: Page) -> None:
    """Move the pointer where it shows no tooltip."""
    page.mouse.move(5, page.viewport_size["height"] - 5)  # type: ignore[index]
    expect(page.get_by_role("tooltip")).to_have_count(0)


def _axe(page: Page) -> dict[str, str]:
    """Return what axe-core (MPL-2.0) finds wrong by the names of its rules: elements and what to do."""
    page.evaluate(AXE)
    return {
        rule["id"]: "; ".join(f"{node['html'][:200]}: {node['failureSummary']}" for node in rule["nodes"])
        for rule in page.evaluate(_RUN_AXE)["violations"]
        if rule["impact"] in ("moderate", "serious", "critical")
    }


def test_the_page_is_served_while_the_program_compiles(tab: Tab, place: Path) -> None:
    """Fails for a page that waits for the worker, or does not say what it waits for."""
    hands = Hands(tab.page)
    expect(hands.see("working")).to_contain_text("compiles")
    hands.step("plan")
    hands.step("images")
    (place / "go").touch()
    hands.wait_for_step("Calibrate", "done")
    expect(hands.see("working")).to_have_count(0)


# How the page looks, before anything is placed.


@pytest.mark.parametrize("step", STEPS)
def test_every_step_is_read_and_fits(hands: Hands, step: str, shoot: Callable[[Page | Locator, str], None]) -> None:
    """Fails for a text that is cut, too small or too pale, controls that overlap, and what axe-core finds."""
    hands.step(step)
    _rest(hands.page)
    for width, height in SIZES:
        hands.page.set_viewport_size({"width": width, "height": height})
        assert not wrong(hands.page, scrolls=step != "plan"), (width, height)
        pa, lateral = (hands.core(name, "core.root.getBoundingClientRect().toJSON()") for name in NAMES)
        if width < height:
            assert pa["bottom"] <= lateral["top"] and pa["left"] == lateral["left"]  # stacked
        else:
            assert pa["right"] <= lateral["left"] and pa["top"] == lateral["top"]
    hands.page.set_viewport_size({"width": 1280, "height": 800})
    shoot(hands.page, step)
    words = written(hands.page)
    assert len(words) > 15 and not unread(words)
    hands.details()
    assert _axe(hands.page) == {}
    hands.details()
    expect(hands.page.locator("html")).to_have_attribute("lang", "en-US")


def test_the_measures_find_what_is_wrong(hands: Hands) -> None:
    hands.step("Plan")
    hands.until("pa", "Boolean(core.state.placing)")  # an image shows a hint
    _rest(hands.page)
    for style, found in (
        (".stop-box { translate: 99em }", "off the screen"),
        (".say { width: 3em }", "cut"),
        (".xray-tools.xray-tools { max-width: 16em }", "tools in"),
        (".xray .xray-hint { translate: 0 9em }", "the hint"),
        (".figure-grid { translate: 0 3em }", "overlap"),
        (".kind .q-field__native { translate: 0 0.6em }", "on its line"),
        (".checklist { min-height: 99em }", "scrolls"),
    ):
        added = hands.page.add_style_tag(content=style)
        assert any(found in line for line in wrong(hands.page, scrolls=False)), style
        added.evaluate("element => element.remove()")
    added = hands.page.add_style_tag(content=".pick-name { color: #555; font-size: 9px }")
    assert unread(written(hands.page))
    added.evaluate("element => element.remove()")


def test_the_longest_sentence_moves_and_covers_nothing(hands: Hands) -> None:
    hands.step("Plan")
    top = hands.core("pa", "core.stage.getBoundingClientRect().top")
    hands.page.locator("[data-testid=instruction]").evaluate(
        "(line, [text, size]) => { line.className = `instruction ${size}`; line.textContent = text; }",
        [LONG, size_of(LONG)],
    )
    assert not wrong(hands.page, scrolls=False)
    assert hands.core("pa", "core.stage.getBoundingClientRect().top") == top
    bar = hands.page.locator(".say").bounding_box()
    _rest(hands.page)
    hands.see("step-verify").hover()
    expect(hands.page.get_by_role("tooltip")).to_be_visible()
    assert _axe(hands.page) == {}
    box = hands.page.get_by_role("tooltip").bounding_box()
    assert bar is not None and box is not None and box["y"] >= bar["y"] + bar["height"]
    _rest(hands.page)


def test_the_checklist_of_every_procedure_fits(hands: Hands) -> None:
    hands.step("Plan")
    column = hands.page.locator(".panel").bounding_box()
    assert column is not None and 290 <= column["width"] <= 310
    for number in range(len(shipped())):
        hands.see("kind").click()
        option = hands.page.get_by_role("option").nth(number)
        name = option.inner_text()
        option.click()
        expect(hands.see("kind")).to_contain_text(name)
        _rest(hands.page)
        assert not wrong(hands.page, scrolls=False), name
    _choose(hands, "Interlocking holes")
    expect(hands.see("verdict")).to_contain_text("The simulated patient has no nail.")
    expect(hands.see("instruction")).to_contain_text("The simulated patient has no nail.")
    _choose(hands, "Hip screw")
    expect(hands.see("instruction")).to_contain_text("1 of ")


def _choose(hands: Hands, procedure: str) -> None:
    hands.see("kind").click()
    hands.page.get_by_role("option", name=procedure, exact=True).click()
    expect(hands.see("kind")).to_contain_text(procedure)


def test_tab_reaches_every_control_which_has_a_name_and_shows_it(hands: Hands) -> None:
    hands.step("Plan")
    hands.press("space-toggle")
    expect(hands.see("space-fit-hip")).to_be_visible()
    hands.page.wait_for_function("window.sightlineSpace?.renders > 0")
    assert not unread(written(hands.page))
    wanted = {one["mark"]: one for one in hands.page.evaluate(CONTROLS, True)}
    assert len(wanted) > 14
    hands.page.mouse.click(3, 795)
    hands.page.evaluate("document.activeElement.blur()")
    reached = {}
    for _ in range(2 * len(wanted)):
        hands.page.keyboard.press("Tab")
        at = hands.page.evaluate(CONTROLS, False)
        if at is not None and at["mark"] in reached:
            break
        if at is not None:
            reached[at["mark"]] = at
    assert not [one["what"] for mark, one in wanted.items() if mark not in reached]
    assert not [one["what"] for one in reached.values() if not one["name"] or not one["seen"]]
    hands.press("space-toggle")


def test_the_keyboard_follows_the_request_from_image_to_image(hands: Hands) -> None:
    """Fails where Tab must be pressed to reach the image that a point is asked for in."""
    hands.step("Plan")
    hands.until("pa", "core.state.placing === 'entry'")
    hands.see("xray-pa").get_by_role("application").focus()
    for name, image in (("entry", "pa"), ("end", "pa"), ("entry", "lateral")):
        hands.until(image, "core.state.placing === value && document.activeElement === core.stage", name)
        for key in ("ArrowUp", "ArrowUp", "Enter"):
            hands.page.keyboard.press(key)
        hands.until(image, "core.state.placing !== value", name)
    for _ in range(3):
        hands.press("undo")
    hands.until("pa", "core.state.placing === 'entry'")


def test_the_space_bar_presses_controls_while_there_is_no_robot_to_stop(hands: Hands) -> None:
    hands.step("Plan")
    hands.details()
    box = hands.see("show-beads")
    for checked in ("true", "false"):
        box.focus()
        hands.page.keyboard.press("Space")
        expect(box).to_have_attribute("aria-checked", checked)
    hands.details()


def test_an_enlarged_image_lies_over_all_but_the_bar(hands: Hands) -> None:
    hands.step("Plan")
    hands.see("xray-pa").get_by_role("button", name=XRAY["maximise"]).click()
    hands.until("pa", "core.root.getBoundingClientRect().right === document.querySelector('.panel').offsetLeft")
    for at in ((0.05, 0.5), (0.7, 0.4), (0.7, 0.6), (0.4, 0.98)):
        place = [at[0] * 1280, at[1] * 800]
        assert hands.core("pa", "core.root.contains(document.elementFromPoint(...value))", place)
    hands.press("step-plan")  # the top row is in reach, and verdict and STOP are seen
    assert hands.page.evaluate(
        "['verdict', 'stop'].every((id) => { const one = document.querySelector(`[data-testid=${id}]`),"
        " { x, y, width, height } = one.getBoundingClientRect();"
        " return one.contains(document.elementFromPoint(x + width / 2, y + height / 2)); })"
    )
    inset = hands.core("lateral", "core.root.getBoundingClientRect().toJSON()")
    assert 0 < inset["width"] < 0.3 * 1280 and inset["bottom"] <= 800
    hands.see("xray-pa").get_by_role("button", name=XRAY["restore"]).click()


def test_a_click_survives_a_section_that_is_built_again(hands: Hands, beside: Hands) -> None:
    """A program whose sections throw their buttons away loses it: press and release have nothing in common, and the
    element that the click names is gone."""
    hands.step("Images")
    beside.step("Images")
    left, right = hands.see("side-left"), hands.see("side-right")
    hands.press("side-right")
    expect(right).to_have_attribute("aria-checked", "true")  # the row has its width from here on
    element, box = right.get_attribute("id"), right.bounding_box()
    assert box is not None
    hands.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    hands.page.mouse.down()
    beside.press("side-left")
    expect(left).to_have_attribute("aria-checked", "true")  # another page has answered: the question is built again
    hands.page.mouse.up()
    expect(right).to_have_attribute("aria-checked", "true")
    assert right.get_attribute("id") == element  # the element that a click on its way names


def _is_here(hands: Hands, step: str) -> None:
    expect(hands.see(f"step-{step}")).to_have_attribute("aria-current", "step")
    hands.page.wait_for_function(_AT, arg=step)


def test_history_and_steps_agree_whatever_comes_first(hands: Hands) -> None:
    """Fails where the entry is made by a message after the step's: a reload in between opens the step before. Fails
    where Forward is compared with the step that the page still shows, and where the program believes the browser."""
    hands.step("calibrate")
    hands.step("plan")
    hands.page.evaluate("() => { emitEvent('step', 'nowhere', 1); emitEvent('step'); emitEvent('step', 'plan', 'x'); }")
    assert hands.page.evaluate(_ENTRY_WHEN_SHOWN, "drill") == "drill"
    assert hands.page.locator("nav").get_attribute("data-went") == "0"
    assert hands.page.evaluate(_BACK_AND_FORWARD) == 2
    _is_here(hands, "drill")
    hands.page.go_back()
    _is_here(hands, "plan")
    hands.page.reload()
    _is_here(hands, "plan")


def test_back_before_the_page_is_built_is_followed_once_it_is(hands: Hands) -> None:
    """Fails where Back needs a button that is not there yet: the page stays on a step that is not the history's."""
    hands.step("calibrate")
    hands.step("plan")
    held: list[Route] = []
    hands.page.route("**/nicegui.js", lambda route: held.append(route))  # noqa: PLW0108 - Playwright marks its handler
    with hands.page.expect_request("**/nicegui.js"):
        hands.page.reload(wait_until="commit")
    hands.page.evaluate("history.back()")
    hands.page.wait_for_function(_AT, arg="calibrate")
    assert hands.see("step-plan").count() == 0
    held[0].continue_()
    hands.page.unroute("**/nicegui.js")
    _is_here(hands, "calibrate")


def test_a_page_that_was_left_and_comes_back_keeps_its_steps(server: Server, open_page: Callable[..., Page]) -> None:
    """It asks before it is left, and comes back on the entry before the first step. Fails where no entry is made from
    there: a reload then loses the step."""
    hands = Hands(page := open_page(server.url))
    for answer in ("leave-no", "leave-yes"):
        page.evaluate("history.back()")
        expect(hands.see("leave-question")).to_be_visible()
        assert _axe(page) == {}
        hands.press(answer)
    page.wait_for_url("about:blank")
    page.go_forward()
    hands.step("plan")
    page.reload()
    _is_here(hands, "plan")


# A plan.


def test_points_are_placed_where_they_are_clicked_until_the_plan_is_go(
    hands: Hands, server: Server, folder: Path, shoot: Callable[[Page | Locator, str], None]
) -> None:
    hands.confirm()
    hands.plan()
    with Case.open(folder, read_only=True) as case:
        number = case.number
    for view in NAMES:
        expect(hands.see(f"xray-{view}").get_by_test_id("identity")).to_have_text(f"Right · {number}")
    for name, where in truth().items():
        for view in where:
            assert np.hypot(*np.subtract(hands.placed(name, view), where[view])) < 2 * SEEN_PX, (name, view)
    expect(hands.see("verdict").locator(".verdict-word")).to_have_text("GO")
    expect(hands.see("verdict").get_by_test_id("unnoticed")).to_contain_text("along a line of sight")
    assert not wrong(hands.page, scrolls=False)
    shoot(hands.page, "planned")
    with Case.open(folder, read_only=True) as case:
        decided = Decisions.of(case.latest(Kind.CHANGED, where={"what": "edit"}).content["to"])
        for view, label in zip(NAMES, ("PA image", "Lateral image"), strict=True):
            expect(hands.see(f"xray-{view}").locator(".xray-name")).to_contain_text(label)
            sent = hands.page.request.get(server.url.rstrip("/") + str(hands.core(view, "core.url"))).body()
            pixels = as_u16(stages.image_of(case, case.entry(decided.images[view])))
            assert np.array_equal(np.frombuffer(sent, "<u2"), pixels.ravel())  # each under its own label


def test_a_plan_expires_by_itself_and_is_go_again_with_its_time(hands: Hands, place: Path) -> None:
    _planned(hands)
    at = hands.see("figures").bounding_box()
    program.set_ahead(place, LIFETIME_S + 1.0)
    expect(hands.see("verdict")).to_contain_text("NO-GO")
    expect(hands.see("unnoticed")).to_have_count(0)
    assert hands.see("figures").bounding_box() == at  # nothing moves under the hand
    expect(hands.see("age")).to_contain_text("expired")
    program.set_ahead(place, 0.0)
    expect(hands.see("verdict")).not_to_contain_text("NO-GO")
    expect(hands.see("age")).to_contain_text("min left")


# What is shown in green, or as GO, by a page that may be out of date: text, ticks that a style sheet adds, and bars.
_VALID = """() => {
  const green = "rgb(47, 199, 154)";
  const out = [];
  for (const one of document.querySelectorAll("body *")) {
    if (!one.checkVisibility()) continue;
    const grey = (at) => at && (getComputedStyle(at).filter.includes("grayscale(1)") || grey(at.parentElement));
    const styles = [getComputedStyle(one), getComputedStyle(one, "::before"), getComputedStyle(one, "::after")];
    const shows = ({ color, backgroundColor }, k) => [backgroundColor, k || one.innerText ? color : ""].includes(green);
    if (styles.some(shows) && !grey(one)) out.push(one.className);
  }
  return out;
}"""
_STRUCK = "one => getComputedStyle(one).textDecorationLine"


@needs_posix
def test_nothing_looks_valid_while_the_program_does_not_answer(hands: Hands, server: Server) -> None:
    """Fails where ticks, values, time or STOP look as before: STOP too where the robot's link is lost."""
    _planned(hands)
    parts = (".instruction", ".verdict-word", ".figure-value", ".time-word", "[data-testid=stop]")
    assert hands.page.evaluate(_VALID)
    assert {hands.page.locator(one).first.evaluate(_STRUCK) for one in parts} == {"none"}
    hands.see("link").evaluate("one => one.classList.add('lost')")
    assert hands.see("stop").evaluate(_STRUCK) == "line-through"
    hands.see("link").evaluate("one => one.classList.remove('lost')")
    assert server._process is not None
    server._process.send_signal(signal.SIGSTOP)
    try:
        expect(hands.see("dead")).to_be_visible()
        assert hands.page.evaluate(_VALID) == []
        assert {hands.page.locator(one).first.evaluate(_STRUCK) for one in parts} == {"line-through"}
        expect(hands.see("red-button")).to_be_visible()
    finally:
        server._process.send_signal(signal.SIGCONT)
    expect(hands.see("dead")).to_be_hidden()


def test_a_drag_moves_curve_wire_and_figures_and_is_undone(hands: Hands) -> None:
    _planned(hands)
    before = hands.placed("end", "lateral")
    figures = hands.see("figures").inner_text()
    x, y = hands.on_screen("pa", hands.placed("end", "pa"))
    mouse = hands.page.mouse
    mouse.move(x, y)
    mouse.down()
    mouse.move(x + 4, y + 15, steps=5)
    expect(hands.see("figures")).not_to_have_text(figures, use_inner_text=True)  # while it is dragged
    mouse.up()
    hands.until("lateral", f"{_AWAY} > 3", ["end", *before])
    hands.press("undo")
    hands.until("lateral", f"{_AWAY} < 0.01", ["end", *before])
    expect(hands.see("figures")).to_have_text(figures, use_inner_text=True)


def _tab_to(hands: Hands, selector: str) -> None:
    """Press Tab until a control has the focus."""
    control = hands.page.locator(selector).first
    expect(control).to_be_enabled(timeout=PATIENCE_MS)
    for _ in range(200):  # more than the page has controls
        if hands.page.evaluate("selector => document.activeElement?.matches(selector)", selector):
            return
        hands.page.keyboard.press("Tab")
    raise AssertionError(f"Tab does not reach {selector}")


def test_fingers_pinch_the_image_alone(server: Server, open_page: Callable[..., Page]) -> None:
    """Fails where a pinch zooms the page instead, or controls wait for a hovering pointer."""
    page = open_page(f"{server.url}?step=plan", has_touch=True, is_mobile=True)
    hands = Hands(page)
    hands.until("lateral", "core.state.image")
    for view in NAMES:
        expect(page.get_by_test_id(f"xray-{view}").locator(".xray-tools")).to_have_css("opacity", "1")
    box = hands.see("xray-lateral").locator("[role=application]").bounding_box()
    assert box is not None
    x, y = box["x"] + 0.22 * box["width"], box["y"] + 0.66 * box["height"]  # no point is near
    a, b, zoom = 40.0, 80.0, hands.core("lateral", "core.display.zoom")
    stroke(page, [(x - a, y), (x + a, y)], [(x - b, y), (x + b, y)])
    hands.until("lateral", "Math.abs(core.display.zoom / value - 2) < 0.01", zoom)
    assert page.evaluate("[visualViewport.scale, scrollX, scrollY]") == [1, 0, 0]


def test_the_head_is_fitted_with_its_error_and_a_wire_proposed_by_the_rule(hands: Hands) -> None:
    """On a rendered patient: a fit beside the bone would be off by more than it states. The wire: 135° to the shaft,
    through the head's centre, 8 mm under its surface, by the page's own measurements."""
    _planned(hands)
    hands.press("fit-head")
    expect(hands.see("row-head")).to_contain_text("±")
    assert not wrong(hands.page, scrolls=False)
    hands.details()
    words = hands.see("head-fitted").inner_text()
    hands.details()
    stated = re.search(r"radius ([\d.]+) ± ([\d.]+)", words)
    assert stated is not None and not hands.see("kept").count()
    assert abs(float(stated[1]) - rehearsal().hip.femur.head_radius_mm) <= float(stated[2]) + 0.05  # as rounded
    hands.page.keyboard.press("Control+z")
    expect(hands.see("row-head")).not_to_contain_text("±")
    hands.details()
    hands.press("propose")
    expect(hands.see("metrics")).to_contain_text("135.0")
    expect(hands.see("metrics").locator("tr", has_text="tip to bone nearest")).to_contain_text("8.0")
    rows = [row.inner_text().split("\t") for row in hands.see("metrics").locator("tr").all()]
    values = {row[0].strip(): float(row[1].split()[0].rstrip("°")) for row in rows if "±" in row[1] and row[0].strip()}
    assert values["wire to shaft"] == pytest.approx(135.0, abs=0.06)  # as it is rounded
    assert values["tip to bone nearest"] == pytest.approx(8.0, abs=0.06)  # through the centre
    hands.details()
    hands.press("undo")
    hands.until("pa", f"{_AWAY} < {2 * SEEN_PX}", ["end", *truth()["end"]["pa"]])


def test_firefox_places_drags_types_and_undoes_too(hands: Hands, server: Server, tmp_path: Path) -> None:
    path = find_firefox()
    if path is None:
        refuse = pytest.fail if os.environ.get("CI") == "true" else pytest.skip
        refuse("no browser: install Firefox (Debian: apt-get install firefox-esr)")
    _planned(hands)
    with firefox(path, tmp_path) as page:
        page.open(f"{server.url}?step=plan")
        end, figures = "sightlineXray.pa.state.points.get('end').uv", "document.querySelector('.figures').innerText"
        page.until("window.sightlineXray?.pa?.state.image && sightlineXray.pa.state.points.get('end')?.uv")
        before, shown = page.ask(end), page.ask(figures)
        x, y = page.ask(f"sightlineXray.pa.toScreen({end})")
        page.drag((x, y), (x - 8, y + 4), (x - 16, y + 8))
        page.until(f"{end}[0] < {before[0] - 10}")
        page.until(f"{figures} !== {json.dumps(shown)}")
        page.type("z", held=_CONTROL)
        page.until(f"{end}[0] === {before[0]} && {figures} === {json.dumps(shown)}")
        page.ask("document.querySelector('[data-testid=remove-end]').click()")
        page.until("sightlineXray.pa.state.placing === 'end'")
        page.click(*page.ask(f"sightlineXray.pa.toScreen({json.dumps(truth()['end']['pa'])})"))
        page.until("sightlineXray.lateral.state.placing === 'end'")
        for left in ("'end'", "null"):
            page.type("z", held=_CONTROL)
            page.until(f"sightlineXray.pa.state.placing === {left}")
        page.open(f"{server.url}?step=images")
        field = "document.querySelector('input[data-testid=serial], [data-testid=serial] input')"
        page.until(f"{field} && ({field}.focus(), document.activeElement === {field})")
        page.type("x" + _ENTER)
        page.until("document.body.innerText.includes('Confirmed: nonex')")
        page.type("z", held=_CONTROL)
        assert not [error for error in page.errors if "WebGL" not in error]
    expect(hands.see("verdict").locator(".verdict-word")).to_have_text("GO")


# Messages of the program are held. NiceGUI tries each event again on a timer of 10 ms: these end in reverse order.
_HELD = """window.heard = []; window.tried = []; const later = setTimeout;
window.setTimeout = (what, ms, ...more) => ms === 10 && tried ? tried.push(what) : later(what, ms, ...more);
window.WebSocket = class extends WebSocket {
  set onmessage(hear) { super.onmessage = (message) => heard ? heard.push(() => hear(message)) : hear(message); }
};"""
_LET_GO = "(name) => { const held = window[name].reverse(); window[name] = null; for (const one of held) one(); }"


def test_what_is_typed_before_the_connection_arrives_in_its_order(
    hands: Hands, server: Server, open_page: Callable[..., Page]
) -> None:
    """A serial without letters is refused. Fails where Enter comes before the text of its field."""
    _planned(hands)
    early = Hands(page := open_page("about:blank"))
    page.add_init_script(_HELD)
    page.goto(f"{server.url}?step=images")
    page.locator("input[data-testid=serial], [data-testid=serial] input").fill("")
    page.keyboard.press("Enter")
    page.evaluate(_LET_GO, "heard")
    page.wait_for_function("socket.connected")
    page.evaluate(_LET_GO, "tried")
    expect(early.see("message")).to_contain_text("engraved")


# Drilling.


@needs_posix
def test_what_is_no_longer_true_says_so_by_itself(hands: Hands, server: Server) -> None:
    """Of a server that does not answer: a live image is marked as old."""
    _planned(hands)
    hands.step("Drill")
    hands.press("start-robot")
    expect(hands.see("stop")).to_be_enabled(timeout=PATIENCE_MS)
    hands.press("live-start")
    expect(hands.see("live-state")).to_contain_text("Calibrated", timeout=PATIENCE_MS)
    hands.until("pa", "!core.state.stale && core.state.layers.get('wire').shapes.length > 0")
    dead = hands.see("dead")
    expect(dead).to_be_hidden()
    assert server._process is not None
    server._process.send_signal(signal.SIGSTOP)
    try:
        hands.until("pa", "core.state.stale")
        expect(hands.see("xray-pa").get_by_test_id("stale")).to_be_visible()
        expect(dead).to_be_visible()
        # Seen again and again: an answer that was on its way may hide it once more on a busy machine.
        expect(dead).to_have_css("width", "1280px")
    finally:
        server._process.send_signal(signal.SIGCONT)
    expect(dead).to_be_hidden()
    hands.until("pa", "!core.state.stale && core.state.layers.get('wire').shapes.length > 0")
    hands.press("live-stop")
    hands.until("pa", "core.state.points.size > 0")  # the plan's image again


def test_the_wire_is_drilled_and_verified(
    hands: Hands, server: Server, open_page: Callable[..., Page], folder: Path, place: Path, shoot
) -> None:
    """From the plan to a wire in the bone that two more images show where it was planned."""
    _planned(hands)
    hands.step("Drill")
    if hands.see("start-robot").count():
        hands.press("start-robot")
    _send(hands, Hands(open_page(f"{server.url}?step=plan")))
    hands.page.bring_to_front()
    for order, state in (("align", State.ALIGNED), ("drill", State.PAUSED), ("drill-on", State.DONE)):
        expect(hands.see(order)).to_be_enabled(timeout=PATIENCE_MS)
        hands.press(order)
        hands.see(f"{order}-yes").evaluate("button => { button.click(); button.click() }")  # the second is refused
        expect(hands.see("robot-state")).to_have_attribute("data-state", state.value, timeout=PATIENCE_MS)
        assert not wrong(hands.page, scrolls=True)
        if state is State.PAUSED:
            _tell_the_second_shot(hands)
    expect(hands.see("drilled")).to_be_visible()
    shoot(hands.page, "drilled")
    hands.details()
    expect(hands.see("events")).to_contain_text("cortex")
    hands.details()
    program.set_ahead(place, LIFETIME_S + 1.0)  # what is drilled grows no older; another plan on the same images does
    hands.step("Plan")
    expect(hands.see("age")).to_contain_text("drilled")
    expect(hands.see("verdict")).not_to_contain_text("NO-GO")
    hands.see("xray-pa").get_by_test_id("point-entry").focus()
    hands.page.keyboard.press("ArrowRight")
    expect(hands.see("verdict")).to_contain_text("NO-GO")
    hands.page.keyboard.press("Control+z")
    expect(hands.see("verdict")).not_to_contain_text("NO-GO")
    program.set_ahead(place, 0.0)
    _verify(hands, folder)
    shoot(hands.page, "verified")
    assert Picks.read(folder / "picks.json").wires.keys() == {"guide-wire"}
    with Case.open(folder, read_only=True) as case:
        assert not case.problems
        replayed = list(replay(case))
    recorded = {one.entry.kind for one in replayed if one.outcome is ReplayOutcome.RECORDED}
    assert recorded == {Kind.CHANGED, Kind.SENT, Kind.DRILLED}
    assert all(one.passed for one in replayed)  # to the bit only with the server's number of threads
    assert {Kind.PLANNED, Kind.VERIFIED} <= {one.entry.kind for one in replayed}


def _send(hands: Hands, other: Hands) -> None:
    """Send the plan by keys. The question stays when what lies behind it is built anew; its answer for a plan that is
    no more is refused."""
    _tab_to(hands, "[data-testid=send]")
    hands.page.keyboard.press("Enter")
    expect(hands.page.get_by_text("Nothing moves yet")).to_be_visible()
    other.until("lateral", "core.state.points.get('end')?.uv")
    other.see("xray-lateral").get_by_test_id("point-end").focus()
    before = other.placed("end", "lateral")
    other.page.keyboard.press("ArrowRight")
    other.until("lateral", f"{_AWAY} > 0 && !core.edits.moved.size", ["end", *before])  # the program has it
    hands.press("send-yes")
    expect(hands.page.get_by_text("the plan changed after you confirmed it")).to_be_visible()
    other.page.keyboard.press("Control+z")
    other.until("lateral", f"{_AWAY} === 0 && !core.edits.moved.size", ["end", *before])
    expect(hands.see("send")).to_be_enabled()
    hands.press("send")
    _tab_to(hands, "[data-testid=send-yes]")
    hands.page.keyboard.press("Enter")


def _tell_the_second_shot(hands: Hands) -> None:
    """A shot that shows what the robot has, once and known better."""
    expect(hands.see("robot-live")).to_contain_text("± 0.8 mm (zero: plan and contact)")
    expect(hands.see("shot-unmeasured")).to_contain_text("rests on the plan and contact, ± 0.8 mm")
    depth = hands.see("depth").inner_text().split()[0]
    for field, value in (("shot-depth", depth), ("shot-error", "0.3")):
        hands.page.locator(f"input[data-testid={field}], [data-testid={field}] input").fill(value)
    hands.press("tell-shot")
    hands.press("tell-shot-yes")
    expect(hands.see("shot-told")).to_contain_text("plan, contact and second shot, ± 0.3 mm", timeout=PATIENCE_MS)


def _verify(hands: Hands, folder: Path) -> None:
    hands.step("Verify")
    hands.until("pa", "core.state.points.get('entry').movable === false")  # what was drilled is not moved by a slip
    hands.press("take-check")
    for view in NAMES:
        hands.until(view, "core.state.layers.get('found')?.shapes.length > 0")
    with Case.open(folder, read_only=True) as case:
        drilled = case.latest(Kind.DRILLED)
    assert drilled is not None
    check = unrendered(rehearsal().check_images, SimulatedWire.of(drilled.content["simulated_wire"]))
    for known in LANDMARKS:
        for view in NAMES:
            at = check.setup.views[view].project(check.landmarks_mm[known][None])[0]
            hands.place(f"landmark-{known.replace(' ', '-')}", view, (float(at[0]), float(at[1])))
    expect(hands.see("check-verdict")).to_contain_text("PASSED")
    hands.details()
    expect(hands.see("check-checks").locator("li.failed")).to_have_text([])
    hands.details()


# What is kept.


def test_a_plan_outlives_a_second_tab_and_a_killed_server(
    tab: Tab, server: Server, open_page: Callable[..., Page], folder: Path
) -> None:
    other = Hands(open_page(f"{server.url}?step=plan", allow=GONE))
    other.wait_for_step("Calibrate", "done")
    _planned(other)
    here, decided = other.placed("end", "lateral"), _recorded(folder)
    other.page.evaluate("window.ofTheServerThatWasKilled = true")
    assert server._process is not None
    server._process.kill()
    server._process.wait()
    server.start()
    other.page.wait_for_function("!window.ofTheServerThatWasKilled")  # it loads anew, unasked
    other.wait_for_step("Calibrate", "done")
    other.step("Plan")
    other.until("lateral", "core.state.points.get('end')?.uv")
    assert other.placed("end", "lateral") == here
    assert _recorded(folder) == decided
    tab.page.goto(server.url)
    tab.check(GONE)


def _recorded(folder: Path) -> Decisions:
    with Case.open(folder, read_only=True) as case:
        return Decisions.of(case.latest(Kind.CHANGED, where={"what": "edit"}).content["to"])


def _open_empty(hands: Hands, folder: Path) -> None:
    """Open another case from the list, which asks first."""
    with Case.create(folder.parent / "2") as case:
        stages.record_changed(case, "edit", Decisions().document(), by=Actor.SURGEON)
        number = case.number
    hands.details()
    hands.press("cases")
    expect(hands.see("cases-table")).to_contain_text("(this one)")
    hands.press(f"open-{number}")
    expect(hands.see("cases-sheet")).to_contain_text(f"Open case {number}?")
    hands.press("open-yes")
    expect(hands.see("step-images")).to_have_attribute("aria-current", "step")
    expect(hands.see("no-pa")).to_be_visible()


def test_another_case_is_opened_from_the_list_on_all_pages(hands: Hands, beside: Hands, folder: Path) -> None:
    beside.step("Plan")
    _open_empty(hands, folder)
    expect(beside.see("step-images")).to_have_attribute("aria-current", "step")
    expect(beside.see("no-pa")).to_be_visible()


# A case without images: what each step shows and where it leads, and refused images.


@pytest.fixture
def empty(tab: Tab, place: Path, folder: Path) -> Iterator[Hands]:
    """A person before the other case."""
    (place / "go").touch()
    person = Hands(tab.page)
    if not (folder.parent / "2").exists():
        person.wait_for_step("Calibrate", "done")
        _open_empty(person, folder)
    yield person
    tab.check(REFUSED)


def test_a_blocked_step_leads_to_what_it_waits_for(empty: Hands) -> None:
    """Fails where its one button is dead."""
    for step in ("calibrate", "plan", "drill", "verify"):
        empty.step(step)
        expect(empty.see("back")).to_have_text("Back to Images")
    empty.press("back")
    _is_here(empty, "images")
    expect(empty.see("continue")).to_be_disabled()


def test_an_empty_view_asks_for_its_image_by_name(empty: Hands) -> None:
    """On each step by the name that it has there, without tools that have nothing to work on."""
    for step, name in (("verify", "check image"), ("images", "image")):
        empty.step(step)
        expect(empty.see("drop-in-PA image")).to_contain_text(f"Drop the PA {name} here")
        expect(empty.see("drop-in-Lateral image")).to_contain_text(f"Drop the lateral {name} here")
        expect(empty.see("xray-pa").locator(".xray-name")).to_have_text(f"PA {name}")
        expect(empty.see("xray-pa").get_by_role("toolbar")).to_be_hidden()
    expect(empty.see("instruction")).to_have_text("Drop the PA image and the lateral image onto the page.")
    empty.step("plan")
    empty.details()  # an empty check box looks empty: its styles need a direction of text
    expect(empty.see("show-beads")).to_have_attribute("aria-checked", "false")
    assert empty.page.evaluate(_MARK) == 0.0


def test_an_image_that_cannot_be_used_says_so_where_it_is_and_what_to_do(empty: Hands, tmp_path: Path) -> None:
    """Fails where another thing is asked first, such as the patient's side, or the text leaves its box."""
    empty.step("images")
    pixels = np.random.default_rng(1).integers(900, 1100, (256, 256)).astype(np.uint16)
    (tmp_path / "junk.dcm").write_bytes(JUNK)
    inputs = empty.page.locator("input[type=file]")
    inputs.nth(1).set_input_files(tmp_path / "junk.dcm")
    box = empty.see("drop-in-Lateral image")
    expect(box).to_contain_text("junk.dcm: the file is ")
    assert box.evaluate("element => element.scrollWidth <= element.clientWidth")
    for number in range(2):
        inputs.nth(number).set_input_files(write_dicom(Radiograph(pixels + number, 4095), tmp_path / f"{number}.dcm"))
        empty.wait_for_step("Images", "needs attention" if number else "to do")
    expect(empty.see("instruction")).to_contain_text("Load another PA image: this one cannot be used.")
    expect(empty.see("side-right")).to_have_count(0)
    expect(box).to_have_class(re.compile("failed"))
    assert not wrong(empty.page, scrolls=True)
