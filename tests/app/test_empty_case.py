"""The page of a case without images: what each step shows and where it leads, its history, and refused images."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, Route, expect
from tests.app.browser import Server
from tests.app.eyes import wrong
from tests.app.hands import Hands

from sightline.app.panels.steps import StepStatus, judged
from sightline.case.journal import Actor, Case
from sightline.case.stages import record_acquired
from sightline.common.checks import Check
from sightline.errors import ImageError
from sightline.imaging import Radiograph, write_dicom
from sightline.planning.points.results import Verdict

_JUNK = b"\0" * 128 + b"DICM" + b"junk"
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


@pytest.fixture(scope="module")
def go(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file that lets the server's worker go on."""
    return tmp_path_factory.mktemp("held") / "go"


@pytest.fixture(scope="module")
def server(serve: Callable[..., Server], go: Path) -> Server:
    """The app on a new case, without images, its worker held up."""
    command = ["tests.app.held_app", str(go), "app", "--port", "{port}", "--no-browser", "--quiet"]
    return serve(*command, "--case", str(go.parent / "case"))


@pytest.fixture
def hands(server: Server, go: Path, open_page: Callable[..., Page]) -> Hands:
    go.touch()
    return Hands(open_page(server.url, allow=("422",)))  # what the browser itself says of a refused upload


def test_the_page_is_served_while_the_program_compiles(
    server: Server, go: Path, open_page: Callable[..., Page]
) -> None:
    """Fails for a page that waits for the worker, or does not say what it waits for."""
    hands = Hands(open_page(server.url))
    expect(hands.see("working")).to_contain_text("compiles")
    hands.step("plan")
    hands.step("images")
    go.touch()
    expect(hands.see("working")).to_have_count(0)


def test_a_blocked_step_leads_to_what_it_waits_for(hands: Hands) -> None:
    """Fails where its one button is dead."""
    for step in ("calibrate", "plan", "drill", "verify"):
        hands.step(step)
        expect(hands.see("back")).to_have_text("Back to Images")
    hands.press("back")
    _is_here(hands, "images")
    expect(hands.see("continue")).to_be_disabled()


def test_an_empty_view_asks_for_its_image_by_name(hands: Hands) -> None:
    """On each step by the name that it has there, without tools that have nothing to work on."""
    for step, name in (("verify", "check image"), ("images", "image")):
        hands.step(step)
        expect(hands.see("drop-in-PA image")).to_contain_text(f"Drop the PA {name} here")
        expect(hands.see("drop-in-Lateral image")).to_contain_text(f"Drop the lateral {name} here")
        expect(hands.see("xray-pa").locator(".xray-name")).to_have_text(f"PA {name}")
        expect(hands.see("xray-pa").get_by_role("toolbar")).to_be_hidden()
    expect(hands.see("instruction")).to_have_text("Drop the PA image and the lateral image onto the page.")
    hands.step("plan")
    hands.details()  # an empty check box looks empty: its styles need a direction of text
    expect(hands.see("show-beads")).to_have_attribute("aria-checked", "false")
    assert hands.page.evaluate(_MARK) == 0.0


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
    _is_here(hands, "calibrate")


def test_a_page_that_was_left_and_comes_back_keeps_its_steps(hands: Hands) -> None:
    """It asks before it is left, and comes back on the entry before the first step. Fails where no entry is made from
    there: a reload then loses the step."""
    page = hands.page
    for answer in ("leave-no", "leave-yes"):
        page.evaluate("history.back()")
        expect(hands.see("leave-question")).to_be_visible()
        hands.press(answer)
    page.wait_for_url("about:blank")
    page.go_forward()
    hands.step("plan")
    page.reload()
    _is_here(hands, "plan")


def test_an_image_that_cannot_be_used_says_so_where_it_is_and_what_to_do(hands: Hands, tmp_path: Path) -> None:
    """Fails where another thing is asked first, such as the patient's side, or the text leaves its box."""
    hands.step("images")
    pixels = np.random.default_rng(1).integers(900, 1100, (256, 256)).astype(np.uint16)
    (tmp_path / "junk.dcm").write_bytes(_JUNK)
    inputs = hands.page.locator("input[type=file]")
    inputs.nth(1).set_input_files(tmp_path / "junk.dcm")
    box = hands.see("drop-in-Lateral image")
    expect(box).to_contain_text("junk.dcm: the file is truncated or damaged")
    assert box.evaluate("element => element.scrollWidth <= element.clientWidth")
    for number in range(2):
        inputs.nth(number).set_input_files(write_dicom(Radiograph(pixels + number, 4095), tmp_path / f"{number}.dcm"))
        hands.wait_for_step("Images", "needs attention" if number else "to do")
    expect(hands.see("instruction")).to_contain_text("Load another PA image: this one cannot be used.")
    expect(hands.see("side-right")).to_have_count(0)
    expect(box).to_have_class(re.compile("failed"))
    assert not wrong(hands.page, scrolls=True)


def test_a_damaged_image_is_named_as_a_person_knows_it(tmp_path: Path) -> None:
    """Fails where the message names the kept file, which is called by its digest."""
    with Case.create(tmp_path / "case") as case, pytest.raises(ImageError) as refused:
        record_acquired(case, _JUNK, ".dcm", by=Actor.RADIOGRAPHER)
    assert str(refused.value).startswith("the file is truncated or damaged")


def test_what_is_not_placed_is_left_to_do_and_needs_no_attention() -> None:
    """Fails where a plan without its landmarks is marked as one that failed a check."""
    unmade = Check("head", False, None, None, "", "head.", missing=True)
    failed = Check("entry error", False, None, None, "", "entry error.")
    assert judged(Verdict((unmade,))) == (StepStatus.OPEN, "head.")
    assert judged(Verdict((unmade, failed))) == (StepStatus.ATTENTION, "entry error.")
    assert judged(Verdict(()))[0] is StepStatus.DONE
