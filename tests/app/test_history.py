"""The browser's history and the steps agree, whatever comes first: the server's answer, Back, Forward or a reload."""

from collections.abc import Callable

import pytest
from playwright.sync_api import Page, Route, expect
from tests.app.browser import Server
from tests.app.hands import Hands

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
def server(serve: Callable[..., Server], tmp_path_factory: pytest.TempPathFactory) -> Server:
    """The app on a new case, without images."""
    folder = tmp_path_factory.mktemp("case")
    return serve("sightline", "app", "--port", "{port}", "--no-browser", "--quiet", "--case", str(folder))


@pytest.fixture
def hands(server: Server, open_page: Callable[..., Page]) -> Hands:
    """A person who went from the first step to the second and the third."""
    person = Hands(open_page(server.url))
    person.step("calibrate")
    person.step("plan")
    return person


def _is_here(hands: Hands, step: str) -> None:
    expect(hands.see(f"step-{step}")).to_have_attribute("aria-current", "step")
    hands.page.wait_for_function(_AT, arg=step)


def test_the_history_has_a_step_as_soon_as_the_page_shows_it(hands: Hands) -> None:
    """Else a reload comes in between, and the page opens on the step before. Fails where the entry is made by a message
    that comes after the step's."""
    assert hands.page.evaluate(_ENTRY_WHEN_SHOWN, "drill") == "drill"


def test_back_before_the_page_is_built_is_followed_once_it_is(hands: Hands) -> None:
    """Fails where Back needs a button that is not there yet: the page stays on a step that is not the history's."""
    held: list[Route] = []
    hands.page.route("**/nicegui.js", lambda route: held.append(route))  # noqa: PLW0108 - Playwright marks its handler
    with hands.page.expect_request("**/nicegui.js"):
        hands.page.reload(wait_until="commit")
    hands.page.evaluate("history.back()")
    hands.page.wait_for_function(_AT, arg="calibrate")
    assert hands.see("step-plan").count() == 0
    held[0].continue_()
    _is_here(hands, "calibrate")
    hands.page.go_back()
    _is_here(hands, "images")


def test_forward_counts_that_overtakes_the_answer_to_back(hands: Hands) -> None:
    """Fails where Forward is compared with the step that the page still shows."""
    assert hands.page.evaluate(_BACK_AND_FORWARD) == 2
    _is_here(hands, "plan")
    hands.page.go_back()
    _is_here(hands, "calibrate")


def test_a_page_that_was_left_and_comes_back_keeps_its_steps(hands: Hands) -> None:
    """It comes back on the entry before the first step. Fails where no entry is made from there: a reload then loses
    the step."""
    page = hands.page
    page.go_back()
    page.go_back()
    _is_here(hands, "images")
    page.evaluate("history.back()")
    expect(hands.see("leave-question")).to_be_visible()
    hands.press("leave-yes")
    page.wait_for_url("about:blank")
    page.go_forward()
    hands.step("plan")
    page.reload()
    _is_here(hands, "plan")


def test_a_step_that_is_none_is_not_followed(hands: Hands) -> None:
    """Nor is a message without one; the server's log is checked. Fails where the program believes the browser."""
    hands.page.evaluate(
        "() => { emitEvent('step', 'nowhere', 1); emitEvent('step'); emitEvent('step', 'plan', 'one'); }"
    )
    hands.step("drill")  # what came before is answered
    assert hands.page.locator("nav").get_attribute("data-went") == "0"
