"""The planning page in a real browser: the whole procedure by mouse and keyboard, and what a person may do wrong."""

import re
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.clock_app import set_ahead
from tests.app.hands import LANDMARKS, PATIENCE_MS, SEED, Hands, rehearsal, truth
from tests.app.test_screen import wrong
from tests.systems import needs_posix

from sightline.app.plan.decisions import Decisions
from sightline.app.texts import STEPS, XRAY
from sightline.case.journal import Case, Kind
from sightline.case.replay import ReplayOutcome, replay
from sightline.case.views import NAMES
from sightline.imaging import write_dicom
from sightline.robot.control.states import State
from sightline.robot.kinematics.target import LIFETIME_S
from sightline.robot.link.simulated import SimulatedWire
from sightline.twin import render
from sightline.twin.objects.implants import guide_wire

SEEN_PX = 1.2  # a click is a whole pixel of the screen, the image drawn at 0.45: half of one over that
# How far a point is from [name, u, v], px.
_AWAY = "Math.hypot(core.state.points.get(value[0]).uv[0] - value[1], core.state.points.get(value[0]).uv[1] - value[2])"
_NEAR = f"core.state.points.get(value[0]).uv && {_AWAY} < {2 * SEEN_PX}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("case")


@pytest.fixture(scope="module")
def clock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds by how many seconds the server's clock is ahead."""
    file = tmp_path_factory.mktemp("clock") / "ahead.txt"
    set_ahead(file, 0.0)
    return file


@pytest.fixture(scope="module")
def server(serve: Callable[..., Server], folder: Path, clock: Path) -> Server:
    command = ["tests.app.clock_app", str(clock), "app", "--port", "{port}", "--no-browser", "--case", str(folder)]
    return serve(*command, "--rehearse", str(SEED), "--fast-robot", "--quiet")


def _recorded(folder: Path) -> Decisions:
    with Case.open(folder, read_only=True) as case:
        return Decisions.of(case.latest(Kind.CHANGED, where={"what": "edit"}).content["to"])


@pytest.mark.slow
def test_the_whole_procedure_by_mouse_and_keyboard(hands: Hands, folder: Path, clock: Path, shoot) -> None:
    """From two images to a wire in the bone that two more images show where it was planned."""
    shoot(hands.page, "images")
    hands.step("Calibrate")
    hands.details()
    expect(hands.see("checks-pa")).to_be_visible()
    expect(hands.see("checks-pa").locator("li.failed")).to_have_count(0)
    shoot(hands.page, "calibrate")
    hands.details()
    hands.confirm()
    hands.plan()
    for name, where in truth().items():
        for view in NAMES:
            assert np.hypot(*np.subtract(hands.placed(name, view), where[view])) < 2 * SEEN_PX, (name, view)
    expect(hands.see("verdict")).to_contain_text("GO")
    expect(hands.see("verdict")).not_to_contain_text("NO-GO")
    hands.details()
    expect(hands.see("metrics")).to_contain_text("tip to bone along wire")
    hands.details()
    shoot(hands.page, "plan")
    _expire(hands, clock)
    _drill(hands, shoot)
    _stay_drilled(hands, clock)
    _verify(hands, shoot, folder)
    with Case.open(folder, read_only=True) as case:
        assert not case.problems
        replayed = list(replay(case))
    recorded = {one.entry.kind for one in replayed if one.outcome is ReplayOutcome.RECORDED}
    assert recorded == {Kind.CHANGED, Kind.SENT, Kind.DRILLED}
    assert all(one.passed for one in replayed)  # to the bit only with the server's number of threads
    assert {Kind.PLANNED, Kind.VERIFIED} <= {one.entry.kind for one in replayed}


def _expire(hands: Hands, clock: Path) -> None:
    """The page says it by itself, and takes it back."""
    set_ahead(clock, LIFETIME_S + 1.0)
    expect(hands.see("verdict")).to_contain_text("NO-GO")
    expect(hands.see("age")).to_contain_text("expired")
    set_ahead(clock, 0.0)
    expect(hands.see("verdict")).not_to_contain_text("NO-GO")
    expect(hands.see("age")).to_contain_text("min left")


def _stay_drilled(hands: Hands, clock: Path) -> None:
    """What is drilled grows no older; another plan on the same images does."""
    set_ahead(clock, LIFETIME_S + 1.0)
    hands.step("Plan")
    expect(hands.see("age")).to_contain_text("drilled")
    expect(hands.see("verdict")).not_to_contain_text("NO-GO")
    hands.page.get_by_test_id("xray-pa").get_by_test_id("point-entry").focus()
    hands.page.keyboard.press("ArrowRight")
    expect(hands.see("verdict")).to_contain_text("NO-GO")
    hands.page.keyboard.press("Control+z")
    expect(hands.see("verdict")).not_to_contain_text("NO-GO")
    set_ahead(clock, 0.0)


def _answer_after_the_plan_changed(hands: Hands) -> None:
    """The question stays when what lies behind it is built anew; its answer for a plan that is no more is refused."""
    other = Hands(hands.page.context.new_page())
    other.page.goto(hands.page.url)
    other.step("Plan")
    other.until("lateral", "core.state.points.get('end')?.uv")
    other.page.get_by_test_id("xray-lateral").get_by_test_id("point-end").focus()
    before = other.placed("end", "lateral")
    other.page.keyboard.press("ArrowRight")
    other.until("lateral", f"{_AWAY} > 0 && !core.edits.moved.size", ["end", *before])  # the program has it
    hands.press("send-yes")
    expect(hands.page.get_by_text("the plan changed after you confirmed it")).to_be_visible()
    other.page.keyboard.press("Control+z")
    other.until("lateral", f"{_AWAY} === 0 && !core.edits.moved.size", ["end", *before])
    other.page.close()
    expect(hands.see("send")).to_be_enabled()


def _drill(hands: Hands, shoot) -> None:
    hands.step("Drill")
    hands.press("start-robot")
    expect(hands.see("robot-state")).to_be_visible(timeout=PATIENCE_MS)
    hands.press("send")
    expect(hands.page.get_by_text("Nothing moves yet")).to_be_visible()
    _answer_after_the_plan_changed(hands)
    hands.press("send")
    hands.press("send-yes")
    for order, state in (("align", State.ALIGNED), ("drill", State.PAUSED), ("drill-on", State.DONE)):
        expect(hands.see(order)).to_be_enabled(timeout=PATIENCE_MS)
        hands.press(order)
        hands.see(f"{order}-yes").evaluate("button => { button.click(); button.click() }")  # the second is refused
        expect(hands.see("robot-state")).to_have_attribute("data-state", state.value, timeout=PATIENCE_MS)
        assert not wrong(hands.page, scrolls=True)
        if state is State.PAUSED:
            _tell_the_second_shot(hands)
    expect(hands.see("drilled")).to_be_visible()
    shoot(hands.page, "drill")
    hands.details()
    expect(hands.see("events")).to_contain_text("cortex")
    hands.details()


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


def _verify(hands: Hands, shoot, folder: Path) -> None:
    hands.step("Verify")
    hands.until("pa", "core.state.points.get('entry').movable === false")  # what was drilled is not moved by a slip
    expect(hands.page.get_by_role("button", name="PA check image", exact=True)).to_be_visible()  # what it loads
    hands.press("take-check")
    for view in NAMES:
        hands.until(view, "core.state.layers.get('found')?.shapes.length > 0", timeout_ms=PATIENCE_MS)
    _find_landmarks_again(hands, folder)
    expect(hands.see("check-verdict")).to_contain_text("PASSED")
    shoot(hands.page, "verify")
    hands.details()
    expect(hands.see("check-checks")).to_be_visible()
    expect(hands.see("check-checks").locator("li.failed")).to_have_text([])
    hands.details()


def _find_landmarks_again(hands: Hands, folder: Path) -> None:
    with Case.open(folder, read_only=True) as case:
        drilled = case.latest(Kind.DRILLED)
    assert drilled is not None
    check = rehearsal().check_images(SimulatedWire.of(drilled.content["simulated_wire"]))
    for known in LANDMARKS:
        name = f"landmark-{known.replace(' ', '-')}"
        for view in NAMES:
            at = check.setup.views[view].project(check.landmarks_mm[known][None])[0]
            hands.place(name, view, (float(at[0]), float(at[1])))


@pytest.mark.slow
@needs_posix
def test_the_live_image_is_calibrated_overlaid_and_watched(hands: Hands, server: Server, shoot) -> None:
    """And marked as old by the browser itself where the server says nothing more."""
    _planned(hands)
    hands.step("Drill")
    hands.press("live-start")
    expect(hands.see("live-state")).to_contain_text("Calibrated", timeout=PATIENCE_MS)
    hands.until("pa", "core.state.layers.get('wire').shapes.length > 0")
    shoot(hands.page, "live")
    hands.until("pa", "!core.state.stale")
    assert server._process is not None
    server._process.send_signal(signal.SIGSTOP)
    try:
        hands.until("pa", "core.state.stale")
        expect(hands.see("xray-pa").get_by_test_id("stale")).to_be_visible()
    finally:
        server._process.send_signal(signal.SIGCONT)
    hands.until("pa", "!core.state.stale && core.state.layers.get('wire').shapes.length > 0")
    hands.press("live-stop")
    hands.until("pa", "core.state.points.size > 0")  # the plan's image again


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


def _planned(hands: Hands) -> None:
    """The plan of the first test, or one like it."""
    if hands.see("step-plan").inner_text().find("done") < 0:
        if "done" not in hands.see("step-images").inner_text():
            hands.confirm()
        hands.plan()
    hands.step("Plan")
    expect(hands.see("figures")).to_contain_text("(95 %)")


def test_arrow_keys_move_a_point_by_a_tenth_of_a_pixel(hands: Hands) -> None:
    _planned(hands)
    u, v = hands.placed("entry", "pa")
    hands.page.get_by_test_id("xray-pa").get_by_test_id("point-entry").focus()
    du, dv = hands.core("pa", "core.display.toImageStep([core.display.zoom, 0])")  # a pixel to the right on the screen
    hands.page.keyboard.press("Shift+ArrowRight")
    hands.until("pa", f"{_AWAY} < 0.001", ["entry", u + 0.1 * du, v + 0.1 * dv])
    hands.page.keyboard.press("Control+z")
    hands.until("pa", f"{_AWAY} === 0", ["entry", u, v])


@pytest.mark.slow
def test_a_plan_outlives_a_reload_a_second_tab_and_a_killed_server(
    server: Server, open_page: Callable[..., Page], folder: Path
) -> None:
    gone = ("WebSocket", "ERR_", "Failed to load")  # what the browser says of a server that was killed
    hands = Hands(open_page(server.url, allow=gone))
    hands.wait_for_step("Calibrate", "done")
    _planned(hands)
    here = hands.placed("end", "lateral")
    hands.page.reload()
    hands.wait_for_step("Plan", "")
    hands.step("Plan")
    hands.until("lateral", "core.state.points.get('end')?.uv")
    assert hands.placed("end", "lateral") == here
    other = Hands(open_page(server.url, allow=gone))
    other.step("Plan")
    other.until("lateral", "core.state.points.get('end')?.uv")
    assert other.placed("end", "lateral") == here
    decided = _recorded(folder)
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


def test_a_refused_drop_leaves_the_plan_where_it_is(hands: Hands) -> None:
    """In both images: what the drag has shown meanwhile is gone."""
    _planned(hands)
    before = {view: hands.placed("end", view) for view in NAMES}
    x, y = hands.on_screen("pa", before["pa"])
    mouse = hands.page.mouse
    mouse.move(x, y)
    mouse.down()
    mouse.move(x + 12, y, steps=4)
    hands.until("lateral", f"{_AWAY} > 1", ["end", *before["lateral"]])
    hands.core("pa", "core.display.clamp = (uv) => uv")  # a browser that lets it out of the field
    mouse.move(*hands.core("pa", "core.toScreen([30, 30])"), steps=4)
    mouse.up()
    expect(hands.see("xray-pa").get_by_test_id("lost")).to_be_visible()
    for view in NAMES:
        hands.until(view, f"{_AWAY} === 0", ["end", *before[view]])
    expect(hands.see("verdict")).to_contain_text("GO")


def test_undo_steps_the_guide_back_and_a_click_in_the_black_corner_places_nothing(hands: Hands) -> None:
    _planned(hands)
    hands.press("remove-end")
    expect(hands.see("instruction")).to_contain_text("PA · End point")
    hands.until("pa", "core.state.placing === 'end'")
    hands.click("pa", (6.0, 6.0))
    expect(hands.see("xray-pa").get_by_test_id("lost")).to_contain_text("Click inside the X-ray field")
    hands.place("end", "pa", truth()["end"]["pa"])
    hands.until("lateral", "core.state.placing === 'end'")
    hands.press("undo")
    hands.until("pa", "core.state.placing === 'end'")
    hands.until("lateral", "core.state.placing === null")  # each image is told in a message of its own
    hands.press("undo")  # the removal too
    hands.until("pa", "core.state.placing === null && core.state.points.get('end').uv !== null")


def test_a_reload_stays_on_its_step_and_back_goes_one_step_back(hands: Hands) -> None:
    first = next(name for name in STEPS if hands.see(f"step-{name}").get_attribute("aria-current") == "step")
    second, third = [name for name in list(STEPS)[:4] if name != first][:2]

    def here(step: str) -> None:
        expect(hands.see(f"step-{step}")).to_have_attribute("aria-current", "step")

    hands.step(second)
    hands.step(third)
    hands.page.reload()
    here(third)
    hands.page.go_back()
    here(second)
    hands.page.go_back()
    here(first)
    hands.page.evaluate("history.back()")  # beyond the first: the page asks, and stays
    expect(hands.see("leave-question")).to_be_visible()
    hands.press("leave-no")
    here(first)


@pytest.mark.slow
def test_no_text_moves_the_images_or_covers_the_instruction(hands: Hands) -> None:
    hands.step("Plan")
    top = hands.core("pa", "core.stage.getBoundingClientRect().top")
    hands.page.evaluate("() => { document.querySelector('.say section').textContent = 'a long sentence '.repeat(20); }")
    assert hands.core("pa", "core.stage.getBoundingClientRect().top") == top
    bar = hands.page.locator(".say").bounding_box()
    assert bar is not None
    for name in STEPS:
        hands.see(f"step-{name}").hover()
        shown = hands.page.get_by_role("tooltip")
        expect(shown).to_have_count(1)
        box = shown.bounding_box()
        assert box is not None and box["y"] >= bar["y"] + bar["height"], name
        hands.page.mouse.move(640, 700)
        expect(shown).to_have_count(0)


@pytest.mark.slow
def test_an_enlarged_image_lies_over_all_but_the_bar(hands: Hands, shoot) -> None:
    hands.step("Plan")
    for width, height in ((1280, 800), (1920, 1080)):
        hands.page.set_viewport_size({"width": width, "height": height})
        shoot(hands.page, f"plan-{width}")
        hands.see("xray-pa").get_by_role("button", name=XRAY["maximise"]).click()
        hands.until("pa", "core.root.getBoundingClientRect().right === document.querySelector('.panel').offsetLeft")
        for at in ((0.05, 0.5), (0.7, 0.4), (0.7, 0.6), (0.4, 0.98)):
            assert hands.core(
                "pa", "core.root.contains(document.elementFromPoint(...value))", [at[0] * width, at[1] * height]
            )
        shoot(hands.page, f"enlarged-{width}")
        hands.press("step-plan")  # the top row is in reach, and verdict and STOP are seen
        assert hands.page.evaluate(
            "['verdict', 'stop'].every((id) => { const one = document.querySelector(`[data-testid=${id}]`),"
            " { x, y, width, height } = one.getBoundingClientRect();"
            " return one.contains(document.elementFromPoint(x + width / 2, y + height / 2)); })"
        )
        inset = hands.core("lateral", "core.root.getBoundingClientRect().toJSON()")
        assert 0 < inset["width"] < 0.3 * width and inset["bottom"] <= height
        hands.see("xray-pa").get_by_role("button", name=XRAY["restore"]).click()


@pytest.mark.slow
@needs_posix
def test_a_server_that_does_not_answer_is_said_over_the_whole_page(hands: Hands, server: Server, shoot) -> None:
    """Within a second: verdict and STOP must not look valid without a program behind them."""
    _planned(hands)
    if not hands.see("stop").is_enabled():
        hands.step("Drill")
        hands.press("start-robot")
        expect(hands.see("stop")).to_be_enabled(timeout=PATIENCE_MS)
        hands.step("Plan")
    dead, look = hands.see("dead"), "getComputedStyle(element)"
    expect(dead).to_be_hidden()
    assert server._process is not None
    server._process.send_signal(signal.SIGSTOP)
    try:
        expect(dead).to_be_visible()
        # Seen again and again: an answer that was on its way may hide it once more on a busy machine.
        expect(dead).to_have_css("width", f"{hands.page.viewport_size['width']}px")  # type: ignore[index]
        assert "grayscale" in hands.see("verdict").evaluate(f"element => {look}.filter")
        assert "line-through" in hands.see("stop").evaluate(f"element => {look}.textDecorationLine")
        expect(hands.see("red-button")).to_be_visible()
        shoot(hands.page, "dead")
    finally:
        server._process.send_signal(signal.SIGCONT)
    expect(dead).to_be_hidden()
    expect(hands.see("red-button")).to_be_hidden()


@pytest.mark.slow
def test_what_a_person_does_wrong_ends_in_a_sentence(
    server: Server, open_page: Callable[..., Page], tmp_path: Path
) -> None:
    hands = Hands(open_page(server.url, allow=("422",)))  # what the browser itself says of a refused upload
    hands.wait_for_step("Calibrate", "done")
    hands.step("Images")
    note = tmp_path / "note.txt"
    note.write_text("not an image")
    hands.page.locator("input[type=file]").first.set_input_files(note)
    expect(hands.see("drop-message")).to_contain_text(re.compile("image|DICOM"))
    hands.page.locator("input[data-testid=serial], [data-testid=serial] input").fill(" ")
    hands.press("confirm-serial")
    expect(hands.see("message")).to_contain_text("engraved")
    _planned(hands)
    u, v = truth()["end"]["lateral"]
    hands.press("remove-end")
    expect(hands.see("row-end")).to_contain_text("○ lat")
    hands.press("place-end")
    hands.place("end", "pa", truth()["end"]["pa"])
    hands.until("lateral", "core.state.placing === value", "end")
    hands.click("lateral", (u + 150.0, v + 150.0))  # far from the curve: the point slides on it
    hands.until("lateral", "core.state.points.get('end').uv && !core.edits.moved.size")
    expect(hands.see("row-end")).to_contain_text("● lat")
    assert np.hypot(*np.subtract(hands.placed("end", "lateral"), (u + 150.0, v + 150.0))) > 25.0
    expect(hands.see("message")).to_have_count(0)
    for _ in range(3):
        hands.page.keyboard.press("Control+z")
    hands.until("lateral", _NEAR, ["end", u, v])


@pytest.fixture(scope="module")
def obstructed(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Both images as mirrored displays show them, with a retractor of steel before a part of the beads."""
    patient, folder = rehearsal(), tmp_path_factory.mktemp("images")
    steel = guide_wire(np.array([[75.0, -60.0, 75.0], [-75.0, 50.0, -10.0]]), diameter_mm=9.0)
    scene, rng = patient.hip.scene + steel, np.random.default_rng(5)
    shown = {name: render(patient.setup, name, scene, rng) for name in NAMES}
    mirrored = {name: replace(one, pixels=one.pixels[:, ::-1]) for name, one in shown.items()}
    return [write_dicom(mirrored[name], folder / f"{name}.dcm") for name in NAMES]


@pytest.mark.slow
def test_mirrored_images_with_hidden_beads_are_dropped_planned_and_not_sent(
    serve: Callable[..., Server], open_page: Callable[..., Page], obstructed: list[Path], tmp_path: Path, shoot
) -> None:
    """Both are handed to the button of the other view: their markers tell. A person says whether the displays or the
    frame file are mirrored. Without a robot's pose nothing is sent."""
    command = ["sightline", "app", "--port", "{port}", "--no-browser", "--quiet", "--case", str(tmp_path / "case")]
    hands = Hands(open_page(serve(*command, "--live", str(obstructed[0].parent)).url))
    for file, button in zip(obstructed, reversed(NAMES), strict=True):
        hands.page.locator("input[type=file]").nth(NAMES.index(button)).set_input_files(file)
    hands.wait_for_step("Calibrate", "done")
    hands.step("Calibrate")
    told = [re.search(r"(\d+) / \d+", hands.see(f"calibration-{name}").inner_text()) for name in NAMES]
    used = [int(one[1]) for one in told if one]
    assert len(used) == 2 and all(60 <= n < 108 for n in used), used
    hands.step("Images")
    for name in NAMES:
        expect(hands.see(f"taken-unknown-{name}")).to_be_visible()  # the files do not say when
    width = rehearsal().images["pa"].shape[1] - 1
    known = {mark: {view: (width - u, v) for view, (u, v) in uv.items()} for mark, uv in truth().items()}
    hands.plan(known, head=False)
    expect(hands.see("verdict")).to_contain_text("NO-GO")
    hands.details()
    against = hands.see("verdict-checks").locator("li.failed").filter(has_text="Every image shows the mirror image")
    expect(against).to_have_count(1)
    hands.step("Images")
    expect(hands.see("mirrored-question")).to_be_visible()
    hands.press("mirrored-lateral-forwards")  # a wrong answer, and taken back
    hands.wait_for_step("Calibrate", "needs attention")
    hands.press("undo")
    hands.wait_for_step("Calibrate", "done")
    hands.press("mirrored-pa-backwards")
    expect(hands.see("mirrored-pa-backwards")).to_have_attribute("aria-checked", "true")
    for name in NAMES:
        hands.page.locator(f"input[data-testid=taken-{name}], [data-testid=taken-{name}] input").fill("2")
        hands.press(f"confirm-taken-{name}")
        expect(hands.see(f"taken-unknown-{name}")).to_have_count(0)
    hands.step("Plan")
    expect(hands.see("age")).to_contain_text(re.compile("[0-7]:[0-9][0-9]"))  # not since they came
    hands.confirm()
    hands.step("Plan")
    expect(hands.see("verdict")).not_to_contain_text("NO-GO")
    expect(against).to_have_count(0)
    assert set(_recorded(tmp_path / "case").mirrored.values()) == {True}
    shoot(hands.page, "hidden-beads")
    hands.step("Drill")
    expect(hands.see("no-robot")).to_be_visible()
    hands.press("live-start")  # two images, and then no more: what is shown grows old
    expect(hands.see("live-state")).to_contain_text("may be out of date", timeout=PATIENCE_MS)
    assert hands.core("pa", "core.state.stale") or hands.core("lateral", "core.state.stale")


def test_landmarks_of_the_kind_are_the_twins() -> None:
    assert set(LANDMARKS) <= set(rehearsal().landmarks)
