"""The X-ray view in a real browser: what a hand does, what the server hears, and where things are seen."""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from typing import Any

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Locator, Page, expect
from tests.app.browser import PATIENCE_MS, Server, Tab, stroke
from tests.app.xray_page import FIELD_PX, HOSTILE, POINTS, SIDE, SPOTS, TEXTS, lateral_column, picture

from sightline.app.drawing.xray import TEXT_KEYS, Window, XrayContent, XrayEvent, XrayPicture, XrayView, checked

PLACE_PX = 0.05  # image pixels: what a place on the screen may be off by
MARKS = itertools.count(1)
GROUND = 0.299 * 0x22 + 0.587 * 0x2B + 0.114 * 0x35  # the grey of the colour "raised"
ORIENTATIONS = [(0, True), (90, False), (90, True), (180, True), (270, False)]


class View:
    """The PA view of a page, with the hand of a person and the ears of the server."""

    def __init__(self, page: Page, server: Server) -> None:
        self.page = page
        self.server = server
        self.root: Locator = page.get_by_test_id("xray-pa")
        self.stage = self.root.get_by_role("application")
        self.mouse = page.mouse
        self.answering = True

    def ready(self) -> None:
        """Wait until both images are there."""
        both = "window.sightlineXray?.pa?.state.image && window.sightlineXray.lateral?.state.image"
        self.page.wait_for_function(both)

    def core(self, expression: str, value: Any = None) -> Any:
        return self.page.evaluate(f"(value) => {{ const core = window.sightlineXray.pa; return {expression}; }}", value)

    def settle(self) -> None:
        """Wait until all pending drawing is done."""
        self.page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        self.page.evaluate("() => Promise.allSettled(document.getAnimations().map(one => one.finished))")

    def do(self, name: str, *, loaded: bool = True) -> None:
        """Let the server run a command, and wait until the browser has done what it says, and loaded an image."""
        mark = next(MARKS)
        answer = self.page.request.post(f"{self.server.url}do/{name}", params={"mark": mark})
        assert answer.ok
        waits = "sightlineXray.pa.stream.loading" if loaded else "false"
        self.page.wait_for_function(f"window.marked === {mark} && !{waits}")
        self.settle()

    def forget(self, *, answering: bool = True) -> None:
        """Let the server forget what it heard; from now on it answers moves, or does not."""
        self.answering = answering
        self.page.request.post(f"{self.server.url}forget", params={"answering": answering})

    def _said(self) -> dict[str, Any]:
        """What the server has heard, once everything has arrived that the browser has sent so far."""
        if self.answering:
            self.page.wait_for_function("!sightlineXray.pa.edits.moves.inFlight.size")  # nor what waits behind it
        mark = f"mark {next(MARKS)}"
        self.core("core.emit({type: 'error', message: value})", mark)
        for _ in range(PATIENCE_MS // 10):
            said = self.page.request.get(f"{self.server.url}heard").json()
            if any(one["message"] == mark for one in said["events"]):
                return said
            self.page.wait_for_timeout(10)
        raise AssertionError("the server hears nothing")

    def heard(self, *types: str) -> list[dict[str, Any]]:
        """What the server heard of the PA view, of these types."""
        of_view = (one for one in self._said()["events"] if one["view"] == "pa" and one["type"] in types)
        return [one for one in of_view if not str(one["message"]).startswith("mark ")]

    def refused(self) -> int:
        return self._said()["refused"]

    def screen(self, uv: tuple[float, float]) -> tuple[float, float]:
        x, y = self.core("core.toScreen(value)", list(uv))
        return x, y

    def point(self, name: str) -> tuple[float, float]:
        u, v = self.core("core.state.points.get(value).uv", name)
        return u, v

    def button(self, name: str) -> Locator:
        return self.root.get_by_role("button", name=TEXTS[name], exact=True)

    def middle(self) -> tuple[float, float]:
        box = self.stage.bounding_box()
        assert box is not None
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def zoom(self) -> float:
        return self.core("core.display.zoom")

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: Any = "left") -> None:
        self.mouse.move(*start)
        self.mouse.down(button=button)
        self.mouse.move((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
        self.mouse.move(*end)
        self.mouse.up(button=button)
        self.settle()

    def grey(self) -> np.ndarray:
        """(H, W) what the whole page looks like, in device pixels."""
        self.settle()  # controls fade
        seen = np.frombuffer(self.page.screenshot(), np.uint8)
        return cv2.imdecode(seen, cv2.IMREAD_GRAYSCALE).astype(np.float64)

    def seen_spot(self, around: tuple[float, float], radius: float = 45.0) -> tuple[float, float]:
        """Where the bright spot near a place is seen on the screen, CSS px: its centre of light above a threshold."""
        grey = self.grey()
        density = self.page.evaluate("devicePixelRatio")
        y, x = np.mgrid[0 : grey.shape[0], 0 : grey.shape[1]]
        x, y = (x + 0.5) / density, (y + 0.5) / density  # a device pixel's centre
        near = np.hypot(x - around[0], y - around[1]) < radius
        weight = np.where(near, np.maximum(grey - 120.0, 0.0), 0.0)
        assert weight.sum() > 300.0, "no spot there"
        return float((weight * x).sum() / weight.sum()), float((weight * y).sum() / weight.sum())


@pytest.fixture(scope="module")
def server(serve: Callable[..., Server]) -> Server:
    return serve("tests.app.xray_page", "{port}", "0", "1")


@pytest.fixture(scope="module")
def tab(browser: Browser, server: Server) -> Iterator[Tab]:
    tab = Tab(browser, server.url)
    yield tab
    tab.close()


@pytest.fixture
def view(tab: Tab, server: Server) -> Iterator[View]:
    """The view as it was built; at the end there may be no request to another machine and no error in the browser."""
    view = View(tab.page, server)
    tab.page.wait_for_function("window.sightlineXray?.pa")
    tab.page.mouse.move(1, 1)
    view.do("restore")
    view.forget()
    view.ready()
    view.button("fit").click()
    view.settle()
    yield view
    tab.check()


def near(found: tuple[float, float], truth: tuple[float, float]) -> float:
    return math.hypot(found[0] - truth[0], found[1] - truth[1])


# where things are


@pytest.mark.parametrize(("rotation", "mirrored"), ORIENTATIONS)
def test_a_click_on_what_is_seen_reports_where_it_is(view: View, rotation: int, mirrored: bool) -> None:
    spot = SPOTS[rotation // 90]
    for _ in range(rotation // 90):
        view.button("rotate").click()
    if mirrored:
        view.button("flip").click()
    view.mouse.move(*view.screen(spot))
    view.mouse.wheel(0, -1200)
    view.settle()
    assert view.zoom() > 3.0
    view.do("dim")
    seen = view.seen_spot(view.screen(spot))
    view.do("place")
    view.mouse.click(*seen)
    (placed,) = view.heard("place")
    assert placed["id"] == "aim"
    assert near(placed["uv"], spot) < PLACE_PX
    turned = view.heard("display")[-1]["display"] if rotation or mirrored else {"rotation": 0, "mirrored": False}
    expected = (360 - rotation) % 360 if mirrored else rotation  # a flip after a turn is a turn back after a flip
    assert (turned["rotation"], turned["mirrored"]) == (expected, mirrored)


def test_the_wheel_zooms_at_the_pointer_and_keys_zoom_too(view: View) -> None:
    x, y = view.screen((300.25, 611.5))
    at = (round(x), round(y))  # a wheel event counts whole pixels
    held = tuple(view.core("core.toImage(value)", at))
    before = view.zoom()
    view.mouse.move(*at)
    view.mouse.wheel(0, -300)
    view.settle()
    assert view.zoom() == pytest.approx(before * math.exp(300 * 0.0015))
    assert near(view.screen(held), at) < 1e-6
    view.mouse.wheel(0, 100)
    view.settle()
    assert near(view.screen(held), at) < 1e-6
    before = view.zoom()
    view.stage.focus()
    view.page.keyboard.press("+")
    assert view.zoom() == pytest.approx(1.25 * before)
    view.page.keyboard.press("-")
    assert view.zoom() == pytest.approx(before)


@pytest.mark.parametrize("button", ["left", "middle"])
def test_a_drag_on_nothing_pans(view: View, button: str) -> None:
    start = view.screen((450.0, 500.0))
    view.drag(start, (start[0] + 60, start[1] - 40), button)
    assert near(view.screen((450.0, 500.0)), (start[0] + 60, start[1] - 40)) < 1e-6
    assert view.heard("drag", "drop") == []


def test_the_image_cannot_be_lost(view: View) -> None:
    x, y = view.middle()
    for _ in range(3):
        view.drag((x - 200, y), (x + 200, y))
    u, v = view.core("core.toImage(value)", [x, y])
    assert (u, v) == pytest.approx((0.0, (SIDE - 1) / 2))


def test_fit_and_reset(view: View) -> None:
    fitted = view.zoom()
    view.mouse.move(*view.middle())
    view.mouse.wheel(0, -500)
    view.button("rotate").click()
    view.button("invert").click()
    view.button("fit").click()
    view.settle()
    assert view.zoom() == pytest.approx(fitted)
    assert view.core("core.display.rotation") == 90
    view.button("reset").click()
    last = view.heard("display")[-1]["display"]
    window = {"centre": 32768.0, "width": 65536.0}
    assert last == {"rotation": 0, "mirrored": False, "inverted": False, "window": window}


def test_the_readout_says_the_pixel_under_the_pointer(view: View) -> None:
    values = picture()
    for uv in [(200.3, 300.7), (0.0 + SIDE / 2, 12.2), (799.6, 150.4)]:
        view.mouse.move(*view.screen(uv))
        view.settle()
        value = values[round(uv[1]), round(uv[0])]
        expect(view.root.get_by_test_id("readout")).to_have_text(f"column {uv[0]:.1f}, row {uv[1]:.1f}: {value}")
    x, y = view.screen((-3.0, 500.0))
    view.mouse.move(x, y)
    expect(view.root.get_by_test_id("readout")).to_have_text(TEXTS["outside"])


def test_the_readout_of_a_pointer_that_rests_in_a_drag_is_that_of_its_pixel(view: View) -> None:
    """Catches a readout that is put off in a drag and never shown, so that it belongs to an earlier place."""
    values, (x, y) = picture(), view.screen(POINTS[0]["uv"])
    view.mouse.move(x, y)
    view.mouse.down()
    for k in range(1, 20):  # faster than the readout follows
        view.mouse.move(x + 3.0 * k, y + 2.0 * k)
    u, v = view.core("core.toImage(value)", [x + 57.0, y + 38.0])
    said = f"column {u:.1f}, row {v:.1f}: {values[round(v), round(u)]}"
    expect(view.root.get_by_test_id("readout")).to_have_text(said)
    view.mouse.up()


# how it looks


def test_invert_shows_the_negative(view: View) -> None:
    x, y = (round(value) for value in view.screen((420.0, 460.0)))
    positive = view.grey()[y, x]
    view.button("invert").click()
    view.settle()
    assert view.grey()[y, x] == pytest.approx(255 - positive, abs=1)
    assert view.button("invert").get_attribute("aria-pressed") == "true"


def test_a_drag_with_the_right_button_changes_the_window(view: View) -> None:
    x, y = view.screen((420.0, 460.0))
    view.drag((x, y), (x - 150, y - 60), "right")
    (said,) = view.heard("display")
    window = said["display"]["window"]
    assert window["width"] == pytest.approx(65536 * math.exp(-150 / 300))
    assert window["centre"] < 32768  # upwards: brighter
    value = float(picture()[460, 420])
    expected = 255 * min(max((value - window["centre"]) / window["width"] + 0.5, 0), 1)
    assert view.grey()[round(y), round(x)] == pytest.approx(expected, abs=1.5)
    assert near(view.screen((420.0, 460.0)), (x, y)) < 1e-6


def test_with_the_window_tool_the_left_button_does_it(view: View) -> None:
    x, y = view.screen((420.0, 460.0))
    view.button("window").click()
    view.drag((x, y), (x + 90, y))
    view.button("window").click()
    (said,) = view.heard("display")
    assert said["display"]["window"]["width"] == pytest.approx(65536)  # already as wide as grey levels go
    assert near(view.screen((420.0, 460.0)), (x, y)) < 1e-6


def test_where_the_head_is_on_the_screen(view: View) -> None:
    """The word follows the image, whatever turns or mirrors it; a reset shows the head up again. Without a head it is
    told how the image is turned."""
    turned = view.root.get_by_test_id("turned")
    expect(turned).to_have_text("")
    view.do("turn")
    expect(turned).to_have_text("rotated by 90°, mirrored")
    assert view.heard("display") == []  # the server knows its own message
    view.do("head")
    expect(turned).to_have_text("head up")
    view.button("rotate").click()
    expect(turned).to_have_text("head to the right")
    view.button("flip").click()
    expect(turned).to_have_text("head to the left, mirrored")
    view.button("reset").click()
    expect(turned).to_have_text("head up")
    assert view.heard("display")[-1]["display"]["rotation"] == 270
    to_head = np.subtract(view.screen((600.0, 500.0)), view.screen((500.0, 500.0)))  # right in the image, as stored
    assert abs(to_head[0]) < 1e-6 and to_head[1] < -10.0


def test_a_preset_is_a_window(view: View) -> None:
    button = view.root.get_by_role("button", name=TEXTS["bone"], exact=True)
    assert button.get_attribute("aria-pressed") == "false"
    button.click()
    assert view.heard("display")[-1]["display"]["window"] == {"centre": 16000.0, "width": 9000.0}
    view.settle()
    assert button.get_attribute("aria-pressed") == "true"
    expect(view.root.get_by_role("button", name=TEXTS["metal"], exact=True)).to_have_count(0)  # this image has none


def test_linked_images_zoom_together(view: View) -> None:
    """Each by its own fitted zoom, and about its own selected point."""
    fitted = _lateral(view, "core.display.zoom")
    view.page.evaluate("sightlineXray.lateral.state.selected = 'end'")
    before = _lateral(view, "core.toScreen([700, 600])")
    view.mouse.move(*view.middle())
    view.mouse.wheel(0, -300)
    view.settle()
    assert _lateral(view, "core.display.zoom") == fitted
    view.button("link").click()
    view.mouse.wheel(0, 0)
    view.settle()
    assert _lateral(view, "core.display.zoom") == pytest.approx(fitted * math.exp(300 * 0.0015))
    assert _lateral(view, "core.toScreen([700, 600])") == pytest.approx(before)
    view.button("fit").click()
    view.settle()
    assert _lateral(view, "core.display.zoom") == pytest.approx(fitted)
    assert _lateral(view, "core.display.fitted")
    view.button("link").click()
    assert view.button("link").get_attribute("aria-pressed") == "false"


def test_how_an_image_is_shown_overtakes_its_pixels(view: View) -> None:
    view.do("show-again")
    view.page.wait_for_function("sightlineXray.pa.shownUrl === '/picture?again'")  # else its pixels did not arrive
    assert view.core("core.state.window") == {"centre": 20000, "width": 30000}
    assert view.core("core.state.inverted")
    view.button("reset").click()
    assert view.core("core.state.window") == {"centre": 32768, "width": 65536}
    assert not view.core("core.state.inverted")


def test_the_magnifier_shows_the_place_four_times_larger(view: View) -> None:
    view.do("dim")
    view.do("place")
    spot = SPOTS[1]
    at = view.screen(spot)
    view.mouse.move(*at)
    view.settle()
    lens = (at[0], at[1] - 84 - 44)
    grey = view.grey()
    light = 0.5 * 30000 / 65536 * 255  # of the spot alone, at half of its height
    diagonal = [grey[round(lens[1] + step - 0.5), round(lens[0] + step - 0.5)] for step in range(-20, 21)]
    lit = np.flatnonzero(np.array(diagonal) > 15000 / 65536 * 255 + light) - 20  # the cross-hair leaves diagonals free
    wide = 4 * view.zoom() * 5.0 * math.sqrt(2 * math.log(2))  # half a width of the spot, CSS px
    assert (-lit[0] * math.sqrt(2), lit[-1] * math.sqrt(2)) == pytest.approx((wide, wide), abs=2.5)  # squares of 2.4 px
    view.mouse.click(*at)
    view.settle()
    assert view.core("core.lens") is None


def test_name_and_tools_give_way_to_the_magnifier(view: View) -> None:
    """They lie over the canvas that it is drawn on."""
    opacity = "[core.chrome.tools, core.chrome.name].map((one) => Number(getComputedStyle(one).opacity))"
    view.do("place")
    for below, shown in ((400, [1.0, 1.0]), (230, [0.0, 0.0])):  # of the upper edge; the magnifier reaches 212 px up
        uv = view.core("core.display.toImage([core.display.viewWidth / 2, value])", below)
        view.mouse.move(*view.screen(uv))
        view.settle()
        assert view.core("core.lens") is not None
        assert view.core(opacity) == shown, below


def test_beside_the_image_the_magnifier_is_not_black(view: View) -> None:
    view.do("place")
    uv = (SIDE / 2, SIDE / 2 - FIELD_PX + 3.0)  # it shows 84 px of the screen about it, four times as large
    x, y = view.screen(uv)
    view.mouse.move(x, y)
    view.settle()
    assert view.core("core.lens") is not None
    grey, lens = view.grey(), y + 84 + 44  # below the pointer, because there is no room above
    assert grey[round(lens - 75), round(x + 8)] == pytest.approx(GROUND, abs=2.0)


def test_the_arrow_of_a_wire_lies_over_its_drilled_part(view: View) -> None:
    view.do("dim")
    view.do("wire")
    arrow = view.grey()
    legend = view.root.get_by_test_id("legend")
    expect(legend).to_be_hidden()
    view.do("drilled")
    expect(legend).to_have_text("as seen")
    x, y = view.screen((500.0, 700.0))  # the middle of the wire, where the head's tip is
    tip = np.s_[round(y) - 2 : round(y) + 3, round(x) + 2 : round(x) + 7]
    white = arrow[tip] > 230.0  # the head's colour, whole
    assert white.sum() > 10
    assert np.array_equal(view.grey()[tip] > 230.0, white)


def test_plan_layers_hide_while_the_image_is_stale(view: View) -> None:
    view.do("gallery")
    with_plan = view.grey()
    view.do("stale")
    expect(view.root.get_by_test_id("stale")).to_be_visible()
    without = view.grey()
    on_wire = [round(value) for value in view.screen((480.0, 410.0))]
    on_aid = [round(value) for value in view.screen((300.0, 310.0))]
    assert with_plan[on_wire[1], on_wire[0]] - without[on_wire[1], on_wire[0]] > 20
    assert with_plan[on_aid[1], on_aid[0]] == without[on_aid[1], on_aid[0]]
    view.do("fresh")
    below = slice(100, None)  # the lines of text above: their corners are smoothed anew
    assert np.array_equal(view.grey()[below], with_plan[below])


def test_layers_show_and_hide(view: View) -> None:
    bare = view.grey()
    view.do("gallery")
    drawn = view.grey()
    view.do("hide")
    assert np.array_equal(view.grey(), bare)
    view.do("gallery")
    assert np.array_equal(view.grey(), drawn)
    assert not np.array_equal(bare, drawn)


def test_the_browser_itself_hides_the_plan_of_a_live_image_that_no_word_comes_of(view: View) -> None:
    view.do("fresh")
    assert not view.core("core.state.stale")
    view.do("fresh-shortly")
    view.page.wait_for_function("sightlineXray.pa.state.stale")  # the server says nothing more
    expect(view.root.get_by_test_id("stale")).to_be_visible()
    view.do("fresh")
    assert not view.core("core.state.stale")
    expect(view.root.get_by_test_id("stale")).to_be_hidden()


def test_word_of_a_live_image_is_not_taken_for_the_older_one_on_the_screen(view: View) -> None:
    """Its pixels do not arrive, but the report that it is fresh does."""
    view.page.route("**/late", lambda route: None)
    view.do("late", loaded=False)
    view.page.wait_for_function("sightlineXray.pa.state.stale")
    view.do("fresh", loaded=False)
    assert view.core("core.shownUrl") == "/picture"
    assert view.core("core.state.stale")
    view.page.unroute("**/late")
    view.do("restore")
    assert not view.core("core.state.stale")


def test_one_escape_does_one_thing(view: View) -> None:
    """Whichever of the views it is to be done in."""
    view.button("maximise").click()
    view.do("place-lateral")
    x, y = view.screen(POINTS[0]["uv"])
    view.mouse.move(x, y)
    view.mouse.down()
    view.mouse.move(x + 50, y + 50)

    def there() -> list[bool]:
        lateral = "sightlineXray.lateral.state.placing !== null"
        return view.core(f"[core.state.dragging !== null, {lateral}, core.state.maximised]")

    for left in ([True, True, True], [False, True, True], [False, False, True], [False, False, False]):
        assert there() == left
        view.page.keyboard.press("Escape")
    view.mouse.up()
    assert view.page.locator(".box-pa [data-testid=xray-pa]").count() == 1


def test_nothing_is_drawn_while_nothing_changes(view: View) -> None:
    view.do("beads")
    before = view.core("{...core.canvas.draws}")
    view.page.evaluate("async () => { for (let n = 0; n < 20; n++) await new Promise(requestAnimationFrame); }")
    assert view.core("{...core.canvas.draws}") == before
    start = view.screen(POINTS[0]["uv"])
    view.drag(start, (start[0] + 30, start[1] + 10))
    after = view.core("{...core.canvas.draws}")
    assert after["overlay"] > before["overlay"]
    assert (after["image"], after["table"]) == (before["image"], before["table"])


def test_marks_that_stand_still_look_in_a_drag_as_they_do_at_rest(view: View) -> None:
    """Fails a program that leaves a mark behind, or out, on the canvas that it keeps while a point moves. Marks do not
    overlap at the points, so that the order of painting does not show."""
    view.do("beads")
    start = view.screen(POINTS[0]["uv"])
    view.mouse.move(*start)
    view.mouse.down()
    view.mouse.move(start[0] + 20, start[1] + 10)
    view.settle()
    view.do("gallery")  # a layer that comes during the drag is painted too
    view.mouse.move(start[0] + 40, start[1] + 20)
    view.settle()
    size = "core.canvas.shown.canvas.width, core.canvas.shown.canvas.height"
    pixels = f"core.canvas.shown.getImageData(0, 0, {size}).data"
    kept = view.core("core.canvas.still.painted.size")
    view.core(f"window.before = {pixels}, 0")
    view.core("(core.canvas.still.of = () => new Set(), core.canvas.invalidate('overlay'), 0)")
    view.settle()
    unlike = view.core(f"{pixels}.filter((value, index) => Math.abs(value - window.before[index]) > 8).length")
    view.core("delete core.canvas.still.of, 0")
    view.mouse.up()
    assert kept > 10
    assert unlike == 0


# points and moves


def test_a_point_follows_the_hand_and_the_server_hears_where_it_was_left(view: View) -> None:
    start = view.screen(POINTS[0]["uv"])
    zoom = view.zoom()
    view.drag((start[0] + 4, start[1] - 3), (start[0] + 44, start[1] + 17))  # gripped beside its middle
    truth = (300 + 40 / zoom, 400 + 20 / zoom)
    assert near(view.point("entry"), truth) < 1e-6
    (dropped,) = view.heard("drop")
    assert dropped["id"] == "entry"
    assert near(dropped["uv"], truth) < 1e-6
    assert [one["id"] for one in view.heard("select")] in (["entry"], [])  # it may have been selected before
    curve = view.page.evaluate("sightlineXray.lateral.state.layers.get('curve').shapes[0]")
    assert curve["of"] == dropped["seq"]


def test_a_click_on_a_point_and_a_drag_of_one_that_may_not_move_move_nothing(view: View) -> None:
    view.mouse.click(*view.screen(POINTS[0]["uv"]))
    assert view.core("core.state.selected") == "entry"
    start = view.screen((512.0, 200.0))
    view.drag(start, (start[0] + 40, start[1] + 20))
    assert view.point("fixed") == (512.0, 200.0)
    assert view.heard("drag", "drop", "place") == []


def test_a_point_cannot_leave_the_field(view: View) -> None:
    """The field decides, not the rectangle about it: in the black corner is nothing to point at, which it says."""
    start, corner = view.screen(POINTS[0]["uv"]), view.screen((20.0, 20.0))
    view.drag(start, corner)
    (dropped,) = view.heard("drop")
    assert near(dropped["uv"], (SIDE / 2, SIDE / 2)) == pytest.approx(FIELD_PX, abs=1.0)
    expect(view.root.get_by_test_id("lost")).to_have_text(TEXTS["held_in_field"])
    view.do("place")
    view.mouse.click(*corner)
    expect(view.root.get_by_test_id("lost")).to_have_text(TEXTS["off_field"])
    assert view.heard("place") == []
    assert view.refused() == 0


def test_what_is_refused_is_not_shown_though_the_server_says_nothing_more(view: View) -> None:
    """Of what the browser shows there is one copy: the newest message. What was done is answered by it or gone."""
    view.do("refuse")
    start = view.screen(POINTS[0]["uv"])
    view.drag(start, (start[0] + 40, start[1] + 10))
    view.do("place")
    view.mouse.click(*view.screen((420.0, 460.0)))
    assert [one["type"] for one in view.heard("place", "drop")] == ["drop", "place"]
    assert view.point("entry") == POINTS[0]["uv"]
    assert view.core("core.state.points.get('aim').uv") is None
    assert view.core("core.state.placing") == "aim"


def test_an_older_message_changes_nothing(view: View) -> None:
    view.do("once-more")
    assert view.core("core.state.points.size") == len(POINTS)


def test_a_point_in_the_hand_stays_where_it_is_while_the_view_changes_its_size(view: View) -> None:
    x, y = view.screen(POINTS[1]["uv"])
    view.mouse.move(x, y)
    view.mouse.down()
    view.mouse.move(x + 20, y)
    before = view.point("end")
    view.page.evaluate("document.querySelector('.box-pa').style.marginTop = '300px'")
    view.page.wait_for_function("sightlineXray.pa.stage.getBoundingClientRect().top > 290")
    view.settle()
    view.mouse.move(x + 21, y)
    assert near(view.point("end"), before) < 2 / view.zoom()
    view.mouse.up()
    view.page.evaluate("document.querySelector('.box-pa').style.marginTop = ''")


def _lateral(view: View, expression: str) -> Any:
    return view.page.evaluate(f"() => {{ const core = window.sightlineXray.lateral; return {expression}; }}")


def test_a_curve_follows_the_hand_though_the_server_says_nothing(view: View) -> None:
    """And the point on it: to the same depth, until the server's word replaces both."""
    view.do("matching")
    view.page.wait_for_function("window.sightlineXray.lateral.matching.sights")
    view.forget(answering=False)
    before = _lateral(view, "core.state.points.get('end').uv")
    x, y = view.screen(POINTS[1]["uv"])
    view.mouse.move(x, y)
    view.mouse.down()
    view.mouse.move(x + 12.0, y + 31.0)
    view.settle()
    u, v = view.point("end")
    assert _lateral(view, "core.matching.drawn.get('end').uv") == [u, v]
    line = np.array(_lateral(view, "core.matching.drawn.get('end').curve.uv"))
    assert np.abs(line[:, 0] - lateral_column((u, v), line[:, 1])).max() < PLACE_PX
    there = _lateral(view, "core.state.points.get('end').uv")
    assert there != before
    assert abs(there[0] - lateral_column((u, v), there[1])) < PLACE_PX
    view.mouse.up()
    view.forget()
    view.do("refuse")
    view.drag((x + 12.0, y + 31.0), (x + 40.0, y))
    view.page.wait_for_function("!window.sightlineXray.pa.edits.moved.size")
    assert _lateral(view, "core.state.points.get('end').uv") == before


def test_the_button_of_a_point_is_over_it_again_once_a_drag_in_the_other_view_is_over(view: View) -> None:
    """Catches buttons that stay where they were while the point slid on its curve."""
    view.do("matching")
    view.page.wait_for_function("window.sightlineXray.lateral.matching.sights")
    x, y = view.screen(POINTS[1]["uv"])
    view.drag((x, y), (x + 12.0, y + 31.0))
    view.page.wait_for_function("!window.sightlineXray.pa.edits.moved.size")
    view.settle()
    there = _lateral(view, "core.toScreen(core.state.points.get('end').uv)")
    box = view.page.get_by_test_id("xray-lateral").get_by_test_id("point-end").bounding_box()
    assert box is not None
    assert near((box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), there) < 0.5  # [ours] CSS px


def test_a_lateral_point_slides_on_its_curve_wherever_the_pointer_is(view: View) -> None:
    view.do("matching")
    view.page.wait_for_function("window.sightlineXray.lateral.matching.sights")
    view.do("place-lateral")
    place = [POINTS[1]["uv"][0] + 90.0, POINTS[1]["uv"][1] + 70.0]  # far from the curve
    x, y = view.page.evaluate("uv => window.sightlineXray.lateral.toScreen(uv)", place)
    view.mouse.move(x, y)
    view.settle()
    seen = _lateral(view, "core.lens.uv")
    assert abs(seen[0] - lateral_column(view.point("aim"), seen[1])) < PLACE_PX
    view.mouse.click(x, y)
    view.heard()
    placed = next(one for one in view._said()["events"] if one["type"] == "place")
    assert placed["uv"] == pytest.approx(seen)


def test_a_drop_waits_for_nothing(view: View) -> None:
    """An undo that overtook it would undo something else."""
    view.forget(answering=False)
    x, y = view.screen(POINTS[0]["uv"])
    view.mouse.move(x, y)
    view.mouse.down()
    for away in (20, 40, 60):
        view.mouse.move(x + away, y)
    view.mouse.up()
    *dragged, dropped = view.heard("drag", "drop")
    assert ([one["type"] for one in dragged], dropped["type"]) == (["drag"], "drop")
    assert dropped["uv"] == pytest.approx((300 + 60 / view.zoom(), 400), abs=1e-6)
    view.do("acknowledge")
    assert view.core("sessionStorage.getItem('sightline-xray-pa')") is None


@pytest.mark.parametrize("deed", ["key", "pointer", "click"])
def test_nudges_do_not_queue_up_and_come_before_anything_else(view: View, deed: str) -> None:
    view.forget(answering=False)
    _nudge_twice_and_more(view)
    assert [one["uv"] for one in view.heard("nudge")] == [[301.0, 400.0]]
    if deed == "key":
        view.page.keyboard.press("Control+z")
    elif deed == "pointer":
        view.mouse.move(1.0, 1.0)  # beside the views
        view.mouse.down()
    else:
        view.page.evaluate("document.body.click()")  # as a screen reader does
    assert [one["uv"] for one in view.heard("nudge")] == [[301.0, 400.0], [303.0, 400.0]]
    view.mouse.up()


def _nudge_twice_and_more(view: View) -> None:
    view.stage.focus()
    view.page.keyboard.press("Tab")
    for _ in range(3):
        view.page.keyboard.press("ArrowRight")


@pytest.mark.parametrize("gesture", ["drag", "nudge"])
def test_what_is_done_on_an_image_ends_with_it(view: View, gesture: str) -> None:
    """Neither a drag in hand nor a nudge that waits behind another is carried over to the next image."""
    view.forget(answering=False)
    x, y = view.screen(POINTS[0]["uv"])
    if gesture == "nudge":
        _nudge_twice_and_more(view)
    else:
        view.mouse.move(x, y)
        view.mouse.down()
        for away in (20, 40, 60):
            view.mouse.move(x + away, y)
    assert [one["type"] for one in view.heard("drag", "nudge", "drop")] == [gesture]
    view.do("other")
    expect(view.root.get_by_test_id("lost")).to_contain_text("Entry")
    assert view.point("entry") == POINTS[0]["uv"]
    view.do("acknowledge")
    view.mouse.move(x + 80, y)
    view.mouse.up()
    assert [one["type"] for one in view.heard("drag", "nudge", "drop")] == [gesture]
    assert view.core("sessionStorage.getItem('sightline-xray-pa')") is None
    view.drag(view.screen(POINTS[0]["uv"]), (x + 20, y))  # on the new one
    assert [one["type"] for one in view.heard("drag", "nudge", "drop")] == [gesture, "drag", "drop"]
    assert view.refused() == 0


def test_the_server_moves_a_point_but_not_one_in_the_hand(view: View) -> None:
    view.do("move")
    assert view.point("entry") == (100.0, 500.0)
    x, y = view.screen((100.0, 500.0))
    view.mouse.move(x, y)
    view.mouse.down()
    view.mouse.move(x + 20, y)
    held = view.point("entry")
    view.do("move")
    assert view.point("entry") == held
    view.mouse.up()


def test_placing_ends_with_escape(view: View) -> None:
    view.do("place")
    expect(view.root.get_by_test_id("hint")).to_have_text(TEXTS["placing"].format(name="Aim"))
    view.page.keyboard.press("Escape")
    assert [one["id"] for one in view.heard("cancel")] == ["aim"]
    view.mouse.click(*view.screen((420.0, 460.0)))
    assert view.heard("place") == []


# keys


def test_the_tab_key_reaches_the_points_and_arrows_move_them(view: View) -> None:
    view.stage.focus()
    view.page.keyboard.press("Tab")
    focused = view.page.locator(":focus")
    expect(focused).to_have_attribute("aria-label", "Entry: column 300.0, row 400.0")
    assert focused.evaluate("element => getComputedStyle(element).outlineWidth") == "3px"
    view.page.keyboard.press("ArrowRight")
    view.page.keyboard.press("Shift+ArrowDown")
    assert view.point("entry") == pytest.approx((301.0, 400.1), abs=1e-9)
    assert near(view.heard("nudge")[-1]["uv"], (301.0, 400.1)) < 1e-9
    expect(view.root.get_by_test_id("live")).to_have_text("Entry: column 301.0, row 400.1")
    view.page.keyboard.press("Tab")
    expect(view.page.locator(":focus")).to_have_attribute(
        "aria-label", "End: column 700.0, row 600.0, on the matching curve"
    )
    view.page.keyboard.press("Tab")
    view.page.keyboard.press("ArrowLeft")
    assert view.point("fixed") == (512.0, 200.0)


def test_arrows_go_where_the_eye_sees_them_go(view: View) -> None:
    view.do("turn")  # mirrored, then a quarter turn clockwise: down on the screen is to the left in the image
    before = view.screen(POINTS[0]["uv"])
    view.root.get_by_test_id("point-entry").focus()
    view.page.keyboard.press("ArrowDown")
    assert view.point("entry") == pytest.approx((299.0, 400.0), abs=1e-9)
    after = view.screen(view.point("entry"))
    assert (after[0], after[1]) == pytest.approx((before[0], before[1] + view.zoom()))


def test_delete_asks(view: View) -> None:
    view.root.get_by_test_id("point-end").focus()
    view.page.keyboard.press("Delete")
    assert [one["id"] for one in view.heard("remove")] == ["end"]
    assert view.point("end") == (700.0, 600.0)  # the server decides


# bad and hostile


def test_hostile_text_stays_text(view: View) -> None:
    view.do("gallery")
    view.do("hostile")
    view.mouse.move(*view.screen((300.0, 310.0)))
    expect(view.root.get_by_test_id("tip")).to_have_text(HOSTILE)
    button = view.root.get_by_test_id("point-entry")
    expect(button).to_have_attribute("aria-label", f"{HOSTILE}: column 300.0, row 400.0")
    assert view.page.locator("img").count() == 0
    assert view.page.evaluate("window.hacked") is None


def test_an_image_of_the_wrong_size_is_not_shown(view: View) -> None:
    view.do("short")
    (said,) = view.heard("error")
    assert said["message"] == "image: 2097152 bytes, not 1024 x 1023 of two"
    expect(view.root.get_by_test_id("fault")).to_have_text(TEXTS["load_failed"])
    assert view.core("core.state.image") is None
    x, y = view.middle()
    assert view.grey()[round(y), round(x)] < 20


def test_an_unknown_style_is_said_and_not_drawn(view: View) -> None:
    view.do("unknown-style")
    (said,) = view.heard("error")
    assert said["message"] == 'layer odd: unknown style "pink"'
    assert view.core("core.state.layers.get('odd').shapes") == []


def test_what_the_browser_makes_up_is_dropped_and_the_rest_goes_on(view: View) -> None:
    for event in (
        {"type": "drop", "id": "nobody", "uv": [1, 2], "seq": 900},
        {"type": "drop", "id": "entry", "uv": [1e9, 2], "seq": 901, "image": "/picture"},
        {"type": ["drop"], "id": "entry", "seq": 902},
    ):
        view.core("core.emit(value)", event)
    assert view.refused() == 3
    start = view.screen(POINTS[0]["uv"])
    view.drag(start, (start[0] + 20, start[1]))
    assert len(view.heard("drop")) == 1


def test_no_point_is_moved_before_its_image_is_there(view: View) -> None:
    view.page.route("**/late", lambda route: None)
    view.do("late", loaded=False)
    assert view.core("core.shownUrl") == "/picture"
    x, y = view.screen(POINTS[0]["uv"])
    view.drag((x, y), (x + 20, y))
    view.root.get_by_test_id("point-entry").press("ArrowRight")
    assert view.heard("drag", "drop", "nudge") == []
    assert view.point("entry") == POINTS[0]["uv"]
    view.page.unroute("**/late")
    view.do("restore")


FIELD = ((10.0, -0.5), (99.5, -0.5), (99.5, 49.5), (-0.5, 49.5), (-0.5, 10.0))  # a corner is cut off
ON = XrayContent("one", XrayPicture("/one", 100, 50, Window(5.0, 9.0)), points=[{"id": "a"}])
IN_FIELD = XrayContent("one", XrayPicture("/one", 100, 50, Window(5.0, 9.0), FIELD), points=[{"id": "a"}])
MOVE = {"type": "drop", "id": "a", "uv": [1, 2.5], "seq": 3, "image": "/one"}
REMOVE = {"type": "remove", "id": "a", "uv": "x", "image": "/one"}
RULED = {"type": "measure", "image": "/one", "points": [[1, 2], [3.5, 4]]}
SHOWN = {
    "type": "display",
    "image": "/one",
    "seq": 4,
    "rotation": 90,
    "mirrored": True,
    "inverted": False,
    "window": {"centre": 5, "width": 9},
}


def test_good_events_are_taken_as_they_are() -> None:
    assert checked(MOVE, ON) == XrayEvent("drop", "a", (1.0, 2.5), 3)
    assert checked(REMOVE, ON) == XrayEvent("remove", "a")
    assert checked({"type": "select", "id": None}, ON) == XrayEvent("select")
    assert checked(RULED, ON) == XrayEvent("measure", points=((1.0, 2.0), (3.5, 4.0)))
    assert checked(RULED | {"points": []}, ON) == XrayEvent("measure")  # it was taken away
    assert checked({"type": "ready"}, ON) == XrayEvent("ready")
    assert checked({"type": "error", "message": "a\nb" * 1000}, ON) == XrayEvent("error", message="a b" * 100)
    event = checked(SHOWN, ON)
    assert event is not None
    assert event.display is not None
    assert (event.display.rotation, event.display.mirrored, event.display.window.width) == (90, True, 9.0)


@pytest.mark.parametrize(
    "said",
    [
        None,
        [],
        "drop",
        {},
        {"type": None},
        {"type": {}},
        {"type": "explode"},
        MOVE | {"id": "b"},
        MOVE | {"id": None},
        MOVE | {"id": ["a"]},
        MOVE | {"uv": None},
        MOVE | {"uv": [1]},
        MOVE | {"uv": [1, "2"]},
        MOVE | {"uv": [1, True]},
        MOVE | {"uv": [1, math.nan]},
        MOVE | {"uv": [1, math.inf]},
        MOVE | {"uv": [10**400, 1]},
        MOVE | {"uv": [-1.6, 1]},
        MOVE | {"uv": [1, 50.6]},
        MOVE | {"seq": None},
        MOVE | {"seq": True},
        MOVE | {"seq": 0},
        MOVE | {"seq": 1.0},
        MOVE | {"seq": 10**30},
        {"type": "select", "id": 3},
        {"type": "error", "message": 3},
        MOVE | {"image": "/other"},
        MOVE | {"image": None},
        MOVE | {"image": ["/one"]},
        {key: MOVE[key] for key in ("type", "id", "uv", "seq")},
        *(MOVE | {"image": "/other", "type": kind} for kind in ("place", "drag", "nudge")),
        REMOVE | {"image": "/other"},
        SHOWN | {"image": "/other"},
        *(RULED | {"points": points} for points in (None, [[1, 2]], [[1, 2]] * 4, [[1, 2], [1, 99]], [[1, 2], 3])),
        RULED | {"image": "/other"},
        SHOWN | {"rotation": 45},
        SHOWN | {"rotation": True},
        SHOWN | {"mirrored": 1},
        SHOWN | {"window": None},
        SHOWN | {"window": {"centre": 5, "width": 0}},
        SHOWN | {"window": {"centre": 5, "width": 10**400}},
    ],
    ids=repr,
)
def test_bad_events_are_not(said: object) -> None:
    assert checked(said, ON) is None


@pytest.mark.parametrize(
    ("uv", "taken"), [((4.0, 4.0), False), ((12.0, 2.0), True), ((4.9, 4.9), True), ((99.0, 1.0), True)]
)
def test_the_field_decides_what_is_on_the_image(uv: tuple[float, float], taken: bool) -> None:
    assert checked(MOVE | {"uv": list(uv)}, ON) is not None
    assert (checked(MOVE | {"uv": list(uv)}, IN_FIELD) is not None) is taken


def test_nothing_can_be_placed_before_there_is_an_image() -> None:
    assert checked(MOVE, XrayContent("one", points=[{"id": "a"}])) is None


def test_a_missing_text_is_named() -> None:
    with pytest.raises(KeyError, match="edit_lost"):
        XrayView("x", label="X", texts={key: "" for key in TEXT_KEYS if key != "edit_lost"})


def test_a_message_holds_only_what_has_changed() -> None:
    """Fails a program that sends the picture with each move of a point, or leaves out what has become None."""
    wire = [{"shape": "line", "points": [[1, 2], [3, 4]], "style": "plan"}]
    before = XrayContent("one", ON.picture, layers={"wire": wire, "aids": []}, points=[{"id": "a"}], notice="old")
    whole = before.document()
    assert set(whole) == {field.name for field in fields(XrayContent)}
    assert (whole["picture"]["url"], whole["layers"]) == ("/one", {"wire": wire, "aids": []})
    after = replace(before, layers={"wire": wire, "found": wire}, points=[{"id": "b"}], notice=None)
    news = {"points": [{"id": "b"}], "notice": None, "layers": {"wire": None, "found": wire}}
    assert after.document(before) == news


def test_what_a_message_leaves_out_stays_as_it_was(view: View) -> None:
    """Fails a page that takes a message for the complete content."""
    notice = view.root.get_by_test_id("notice")
    expect(notice).to_be_hidden()
    view.do("gallery")
    before = view.core("[core.state.points.size, core.shownShapes.length, core.url, core.word.revision]")
    view.do("notice")
    expect(notice).to_have_text("The image is 0.4 s old")
    assert view.core("[core.state.points.size, core.shownShapes.length, core.url, core.word.revision]") == before
    view.do("no-notice")
    expect(notice).to_be_hidden()


# touch: another page, to which commands go too from here on


@pytest.fixture(scope="module")
def dense(browser: Browser, server: Server) -> Iterator[Tab]:
    """A page on a dense screen that is touched."""
    tab = Tab(browser, server.url, has_touch=True, device_scale_factor=2.0)
    yield tab
    tab.close()


@pytest.fixture
def touched(dense: Tab, server: Server) -> Iterator[View]:
    view = View(dense.page, server)
    view.ready()
    view.do("restore")
    view.forget()
    yield view
    dense.check()


def test_on_a_dense_screen_too(touched: View) -> None:
    box = touched.stage.bounding_box()
    assert box is not None
    assert touched.core("core.chrome.canvas.width") == 2 * box["width"]
    touched.do("dim")
    seen = touched.seen_spot(touched.screen(SPOTS[1]), radius=12.0)
    touched.do("place")
    touched.mouse.click(*seen)
    (placed,) = touched.heard("place")
    assert near(placed["uv"], SPOTS[1]) < PLACE_PX


def test_a_finger_drags_a_point_it_touches_beside(touched: View) -> None:
    x, y = touched.screen(POINTS[0]["uv"])
    x, y = x + 20, y + 18  # 27 CSS px off
    stroke(touched.page, [(x, y)], [(x + 8, y)], [(x + 8, y + 30)], [(x + 48, y + 30)])
    (dropped,) = touched.heard("drop")
    zoom = touched.zoom()
    assert near(dropped["uv"], (300 + 40 / zoom, 400 + 30 / zoom)) < PLACE_PX  # from where the touch became a drag


def test_a_finger_places_where_it_is_lifted(touched: View) -> None:
    touched.do("place")
    x, y = touched.screen((420.0, 460.0))
    stroke(touched.page, [(x - 30, y - 30)], [(x - 10, y)], [(x, y)])
    (placed,) = touched.heard("place")
    assert near(placed["uv"], (420.0, 460.0)) < PLACE_PX


# the server went away: last, because it leaves the file's server with another revision


@pytest.mark.slow  # the server is started again, twice
def test_an_edit_made_while_the_server_is_away(server: Server, open_page: Callable[..., Page]) -> None:
    """It is sent again when the server is back; to one of another revision it is not, and the person is told."""
    page = open_page(server.url, allow=("ERR_CONNECTION_REFUSED", "WebSocket", "502", "Failed to load resource"))
    view = View(page, server)
    for revision in ("1", "2"):
        view.ready()
        view.do("fresh")
        server.stop()
        expect(view.root.get_by_test_id("stale")).to_be_visible()  # though the last report said that it is fresh
        start = view.screen(POINTS[0]["uv"])
        view.drag(start, (start[0] + 60, start[1] + 25))
        left = view.point("entry")
        server.argv[-1] = revision
        server.start()
        if revision == "1":
            arrived = "uv => sightlineXray?.pa?.state.points.get('entry')?.uv?.[0] === uv[0]"
            page.wait_for_function(arrived, arg=list(left))
            page.wait_for_function("sessionStorage.getItem('sightline-xray-pa') === null")
            assert near(view.heard("drop")[-1]["uv"], left) < 1e-9
            view.do("restore")
    expect(view.root.get_by_test_id("lost")).to_contain_text("Repeat the last change of Entry")
    assert view.heard("drop") == []
    assert view.point("entry") == (300.0, 400.0)
