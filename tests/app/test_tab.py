"""One open page without a browser: on which image an event was made, what a live image is said to be, what one part
that fails does to the others."""

import asyncio
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from markupsafe import Markup
from nicegui import Client, ui
from nicegui.events import GenericEventArguments
from nicegui.page import page
from tests.app.given import mark, marked
from tests.planning import bone
from tests.planning.standin import stand_in
from tests.planning.test_wires import KEYS, WIRES_MM

from sightline.app import texts
from sightline.app.drawing import shapes
from sightline.app.drawing.xray import Window, XrayPicture, XrayView
from sightline.app.panels import plan, top, verdict
from sightline.app.panels.section import Section, note
from sightline.app.plan.decisions import Decisions, Mark, Side
from sightline.app.session.jobs import WorkerProcess
from sightline.app.session.planning import Planning
from sightline.app.session.seen import SeenImage
from sightline.app.session.session import Session
from sightline.app.session.shots import LATE_S
from sightline.app.tab.placing import ProcedureStep
from sightline.app.tab.tab import Tab, measured_in_both
from sightline.case.views import CHECK_NAMES, NAMES
from sightline.case.watch.analyser import STALE_S
from sightline.errors import UnusableInputError

SIZE = 4096
AT_PX = np.array([[900.0, 700.0], [800.0, 600.0]])  # anywhere
VIEWS = dict(zip(NAMES, (stand_in("pa", 0.4, 0.3), stand_in("lateral", -0.2, 0.3)), strict=True))


class Drawn:
    """In place of published pictures: an address for each image."""

    def of(self, seen: SeenImage) -> XrayPicture:
        return XrayPicture(f"/image/{seen.acquired.number}", SIZE, SIZE, Window(1.0, 2.0))

    def sight(self, view: object, picture: XrayPicture) -> str:
        return f"/sight/{picture.url}"

    def live(self, image: object) -> XrayPicture:
        return XrayPicture(f"/live/{image}", SIZE, SIZE, Window(1.0, 2.0))


@dataclass
class Page:
    """A tab with the calls to its views: (view, method, arguments)."""

    tab: Tab
    told: list[tuple[str, str, tuple[Any, ...]]] = field(default_factory=list)

    @property
    def planning(self) -> Planning:
        return self.tab.planning

    def add_image(self, name: str, number: int) -> None:
        """An image that is calibrated, under a name."""
        acquired: Any = SimpleNamespace(number=number, at=None, by=None)
        image: Any = None
        view: Any = VIEWS[name.removeprefix("check-")]
        self.planning.lightbox._images[number] = SeenImage(acquired, image, view=view)
        self.planning.edit(self.planning.decisions.with_image(name, number, same_pixels=False))

    def hear(self, view: str, said: dict[str, Any]) -> None:
        """Of the browser."""
        asyncio.get_event_loop().run_until_complete(self.heard(view, said))

    async def heard(self, view: str, said: dict[str, Any]) -> None:
        """Within the loop."""
        xray = self.tab.views.pair[NAMES.index(view)]
        await xray._hear(GenericEventArguments(sender=xray, client=xray.client, args=said))

    def of(self, view: str, method: str) -> list[tuple[Any, ...]]:
        return [arguments for name, called, arguments in self.told if (name, called) == (view, method)]

    def word(self, view: str) -> dict[str, Any]:
        """The content of a view after its newest message: what a message leaves out, and a layer that is None, is as it
        was before."""
        word: dict[str, Any] = {"layers": {}}
        for (news,) in self.of(view, "show"):
            before = word["layers"]
            layers = {name: before.get(name) if sent is None else sent for name, sent in news["layers"].items()}
            word = {**word, **news, "layers": layers}
        return word

    def elements(self) -> list[ui.element]:
        return list(self.tab.views.pair[0].client.elements.values())

    def sentences(self) -> list[str]:
        """What labels say, and elements of HTML."""
        labels = [one.text for one in self.elements() if isinstance(one, ui.label)]
        put = [one.content for one in self.elements() if isinstance(one, ui.html)]
        return labels + [Markup(html).striptags() for html in put]  # noqa: S704 - to take the tags away


@pytest.fixture
def opened(tmp_path: Path, worker: WorkerProcess, monkeypatch: pytest.MonkeyPatch) -> Iterator[Page]:
    """On the step Plan, both images of planning calibrated; their numbers are 101 and 102."""
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)
    session = Session.open(tmp_path, "gamma", None, worker)
    drawn: Any = Drawn()
    made = Page(Tab(session, drawn))

    def told(view: XrayView, method: str, *arguments: Any) -> None:
        made.told.append((view.name, method, arguments))

    monkeypatch.setattr(XrayView, "run_method", told)

    async def build() -> Client:
        client = Client(page("/tab"), request=None)
        with client:
            made.tab.build_views(ui.element("div"), ui.element("div"))
        return client

    with loop.run_until_complete(build()):
        for number, name in enumerate(NAMES, 101):
            made.add_image(name, number)
        made.tab.go_to(ProcedureStep.PLAN)
        yield made
    session.planning.case.close()
    loop.close()


def _move(image: str, name: str, kind: str = "drop") -> dict[str, Any]:
    return {"type": kind, "id": name, "uv": [300.0, 400.0], "seq": 7, "image": image}


LANDMARK = "landmark-head-centre"


def _check_images(opened: Page) -> None:
    for number, name in enumerate(CHECK_NAMES, 103):
        opened.add_image(name, number)


def test_a_move_made_on_the_planned_image_is_not_taken_for_the_check_image(opened: Page) -> None:
    _check_images(opened)
    opened.tab.go_to(ProcedureStep.VERIFY)
    before = opened.planning.decisions
    for kind in ("place", "drop", "nudge", "drag"):
        opened.told.clear()
        opened.hear("pa", _move("/image/101", LANDMARK, kind))
        assert opened.planning.decisions is before
        assert opened.of("pa", "acknowledge") == [(7,)]  # those behind it are not held up
        assert opened.of("pa", "sayLost") == ([] if kind == "drag" else [(LANDMARK,)])
    opened.hear("pa", {"type": "remove", "id": LANDMARK, "image": "/image/101"})
    turned = {"rotation": 90, "mirrored": False, "inverted": False, "window": {"centre": 9.0, "width": 9.0}}
    opened.hear("pa", {"type": "display", "image": "/image/101", **turned})
    assert opened.planning.decisions is before
    for kind in ("place", "nudge", "drop"):
        opened.planning.edit(before)
        opened.hear("pa", _move("/image/103", LANDMARK, kind))
        assert opened.planning.decisions.mark(LANDMARK).places == {"check-pa": (300.0, 400.0)}


def test_nor_before_the_page_has_drawn_what_the_procedure_has_already(opened: Page) -> None:
    opened.tab.go_to(ProcedureStep.VERIFY)  # still the images of the plan
    _check_images(opened)
    before = opened.planning.decisions
    opened.hear("pa", _move("/image/101", LANDMARK))
    assert opened.planning.decisions is before
    assert opened.of("pa", "sayLost") == [(LANDMARK,)]
    opened.tab.refresh()
    opened.hear("pa", _move("/image/103", LANDMARK))
    assert set(opened.planning.decisions.mark(LANDMARK).places) == {"check-pa"}


def _drag_and_meanwhile(opened: Page, deed: Callable[[], object]) -> None:
    """A drag of the end, and what is done while its consequences are computed."""

    async def drag() -> None:
        following = asyncio.create_task(opened.heard("pa", _move("/image/101", "end", "drag")))
        await asyncio.sleep(0)
        deed()
        opened.told.clear()
        await following

    asyncio.get_event_loop().run_until_complete(drag())


def test_a_drag_is_followed(opened: Page) -> None:
    _drag_and_meanwhile(opened, lambda: None)
    assert opened.tab.dragging.preview is not None
    assert opened.tab.known is opened.tab.dragging.preview.known is not opened.planning.planned
    assert _uv(opened, "pa", "end") == (300.0, 400.0)
    opened.hear("pa", _move("/image/101", "end"))
    assert opened.tab.known is opened.planning.planned


def test_what_follows_a_drag_late_is_not_shown_where_it_was_dropped_and_undone_meanwhile(opened: Page) -> None:
    """The decisions are the very ones that the drag began with, and yet not what it led to."""

    def drop_and_undo() -> None:
        opened.planning.edit(opened.planning.moved("end", "pa", (300.0, 400.0)))
        opened.planning.undo()

    _drag_and_meanwhile(opened, drop_and_undo)
    assert opened.tab.dragging.preview is None
    assert opened.tab.known is opened.planning.planned


def test_nor_where_it_was_dropped_where_it_had_been(opened: Page) -> None:
    opened.hear("pa", _move("/image/101", "end"))
    revision = opened.planning.history.revision
    _drag_and_meanwhile(opened, lambda: asyncio.create_task(opened.heard("pa", _move("/image/101", "end"))))
    assert opened.planning.history.revision == revision
    assert opened.tab.dragging.preview is None
    assert opened.tab.known is opened.planning.planned


def _live(number: int, age_s: float = 0.05) -> Any:
    return SimpleNamespace(
        number=number, age_s=age_s, stale=age_s > STALE_S, image=number, view=SimpleNamespace(name="pa"), corridor=None
    )


def test_a_move_on_the_planned_image_is_not_taken_for_the_live_one(opened: Page) -> None:
    opened.tab.show_live(_live(1))
    before = opened.planning.decisions
    for image in ("/image/101", "/live/1"):
        opened.hear("pa", _move(image, LANDMARK, "place"))
    assert opened.planning.decisions is before
    opened.hear("lateral", _move("/image/102", LANDMARK))  # the other view shows the plan's still
    assert set(opened.planning.decisions.mark(LANDMARK).places) == {"lateral"}


def test_the_browser_is_told_at_every_look_how_long_a_live_image_is_what_is_now(opened: Page) -> None:
    opened.told.clear()
    opened.tab.show_live(_live(1, 0.05))
    ((word,),) = opened.of("pa", "show")
    assert word["freshMs"] == pytest.approx(1000.0 * (STALE_S - 0.05 + LATE_S))
    opened.tab.show_live(_live(1, 0.15))
    ((url, left),) = opened.of("pa", "setFresh")
    assert (url, left) == ("/live/1", pytest.approx(1000.0 * (STALE_S - 0.15 + LATE_S)))
    opened.tab.show_live(_live(1, 0.25))
    assert opened.word("pa")["freshMs"] == 0.0
    opened.tab.show_live(None)
    assert opened.word("pa")["freshMs"] is None  # the plan's image does not grow old


@pytest.mark.parametrize("error", [UnusableInputError("this cannot be said"), ZeroDivisionError()])
@pytest.mark.parametrize("in_key", [False, True])
def test_a_section_that_fails_says_so_and_holds_no_other_up(opened: Page, error: Exception, in_key: bool) -> None:
    broken, count = False, 0

    def fail(value: str) -> str:
        if broken:
            raise error
        return value

    def key(tab: Tab) -> object:
        return fail("key") if in_key else (broken, count)

    def build(tab: Tab) -> None:
        ui.label("half of it")
        fail("built")
        ui.label("in order")

    Section(opened.tab, key, build)
    Section(opened.tab, lambda tab: count, lambda tab: note(f"the next {count}"))
    assert {"in order", "the next 0"} <= set(opened.sentences())
    broken, count = True, 1
    opened.tab.refresh()
    said = opened.sentences()
    assert "the next 1" in said
    assert "half of it" not in said and "in order" not in said
    assert any(texts.titled(str(error)) in text if str(error) else "ZeroDivisionError" in text for text in said)
    broken, count = False, 2
    opened.tab.refresh()
    assert {"in order", "the next 2"} <= set(opened.sentences())


def _place_all(opened: Page, side: Side) -> None:
    """Wire, head and shaft of a right hip, as both images show them."""
    uv = bone.pixels([VIEWS[name] for name in NAMES])
    clicks = {"entry": ("wire", 0), "end": ("wire", 1)}
    clicks |= {f"{aid}-{k + 1}": (aid, k) for aid, count in {"head": 3, "shaft": 2}.items() for k in range(count)}
    places = {name: [at[k] for at in uv[drawn]] for name, (drawn, k) in clicks.items()}
    opened.planning.edit(marked(opened.planning.decisions, places))
    opened.planning.decide(side=side)


@pytest.mark.parametrize(("side", "refused"), [("right", False), ("left", True)])
def test_metrics_that_are_refused_leave_those_of_the_plan(opened: Page, side: Side, refused: bool) -> None:
    _place_all(opened, side)
    html = plan.metrics_html(opened.tab)
    assert html.count("the shaft lies above the head") == (1 if refused else 0)
    assert "entry, 95 % error" in html
    assert "tip to bone along wire" in html  # which no side changes
    assert ("wire to shaft" in html) is not refused


def test_layers_that_stay_as_they_are_are_not_sent_again(opened: Page) -> None:
    _place_all(opened, "right")
    opened.tab.refresh()
    u, v = _uv(opened, "pa", "end")
    opened.told.clear()
    opened.hear("pa", _move("/image/101", "end", "drag") | {"uv": [u + 9.0, v]})
    for view in NAMES:
        ((word,),) = opened.of(view, "show")
        assert {name for name, sent in word["layers"].items() if sent is not None} == {"wire"}
    opened.hear("pa", _move("/image/101", "end") | {"uv": [u + 9.0, v]})
    assert opened.word("lateral")["layers"]["curves"]


def test_a_layer_that_cannot_be_drawn_is_empty_and_the_others_are_there(
    opened: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    _place_all(opened, "right")
    opened.tab.refresh()
    assert _last(opened, "aids") and _last(opened, "wire")

    def fail(*_: object) -> list[shapes.Shape]:
        raise UnusableInputError("no outline can be drawn")

    monkeypatch.setattr(shapes, "aids", fail)
    opened.told.clear()
    opened.planning.edit(opened.planning.decisions.with_mark(LANDMARK, Mark({"pa": (9.0, 9.0)})))
    opened.tab.refresh()
    assert _last(opened, "aids") == [] and _last(opened, "wire")
    assert opened.word("pa")["notice"] == "No outline can be drawn"


def _last(opened: Page, layer: str) -> list[shapes.Shape]:
    return opened.word("pa")["layers"].get(layer, [])


def _uv(opened: Page, view: str, name: str) -> Any:
    return next(point["uv"] for point in opened.word(view)["points"] if point["id"] == name)


def test_a_drop_that_is_refused_leaves_both_views_as_they_were(opened: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the drag has shown meanwhile in the other view: what is shown follows from the decisions."""
    _place_all(opened, "right")
    opened.tab.refresh()
    before = {view: opened.word(view) for view in NAMES}
    u, v = _uv(opened, "pa", "end")
    dragged = {"type": "drag", "id": "end", "uv": [u + 9.0, v], "seq": 8, "image": "/image/101"}
    opened.hear("pa", dragged)
    assert _uv(opened, "lateral", "end") is not None
    assert opened.word("lateral")["layers"]["wire"] != before["lateral"]["layers"]["wire"]
    off = _move("/image/101", "end") | {"uv": [u + 60.0, v]}

    def refuse(*_: object, **__: object) -> None:
        raise UnusableInputError("outside the calibrated area")

    monkeypatch.setattr(opened.planning, "moved", refuse)
    opened.hear("pa", off | {"type": "drag", "seq": 9})
    opened.hear("pa", off)
    for view in NAMES:
        now, was = opened.word(view), before[view]
        assert now["version"] > was["version"]
        assert {key: now[key] for key in ("layers", "points")} == {key: was[key] for key in ("layers", "points")}
        assert opened.told.index((view, "show", opened.of(view, "show")[-1])) < opened.told.index(
            ("pa", "acknowledge", (7,))
        )
    assert opened.tab.message == "Outside the calibrated area"
    assert opened.tab.known is opened.planning.planned


@pytest.mark.parametrize("wrong", [{"uv": [9e6, 1.0]}, {"image": "/image/99"}])
def test_nor_does_a_drop_that_is_not_even_heard(opened: Page, wrong: dict[str, Any]) -> None:
    _place_all(opened, "right")
    opened.tab.refresh()
    before = {view: (opened.word(view)["points"], opened.word(view)["layers"]) for view in NAMES}
    u, v = _uv(opened, "pa", "end")
    opened.hear("pa", _move("/image/101", "end", "drag") | {"uv": [u + 9.0, v]})
    assert opened.word("lateral")["layers"] != before["lateral"][1]
    opened.hear("pa", _move("/image/101", "end") | wrong)
    assert {view: (opened.word(view)["points"], opened.word(view)["layers"]) for view in NAMES} == before


def test_the_ruler_measures_anew_when_the_wire_is_another(opened: Page) -> None:
    """It holds in the plane of the wire: fails a page that keeps a length of the wire before, or of one removed."""
    uv = bone.pixels([VIEWS[name] for name in NAMES])["wire"]
    for k, name in enumerate(("entry", "end")):
        for view in NAMES:
            at = uv[NAMES.index(view)][k].tolist()
            opened.hear(view, _move(f"/image/{101 + NAMES.index(view)}", name, "place") | {"uv": at})
    clicks = (uv[0] + [5.0, 3.0]).tolist()
    opened.hear("pa", {"type": "measure", "image": "/image/101", "points": clicks})
    told = [opened.of("pa", "measured")[-1]]
    known = opened.planning.planned
    assert known is not None
    for name in ("entry", "end"):
        opened.hear("lateral", _move("/image/102", name) | {"uv": known.curves[name].uv_px[5].tolist()})
    told.append(opened.of("pa", "measured")[-1])
    assert all(label.endswith("mm") for label, _ in told) and told[0] != told[1]
    opened.planning.remove(("end",))
    opened.tab.refresh()
    assert opened.of("pa", "measured")[-1] == ("", texts.RULER_NEEDS_WIRE)
    for _ in range(3):
        opened.planning.history.undo()
    opened.tab.refresh()
    assert opened.of("pa", "measured")[-1] == told[0]


def test_the_guide_follows_from_the_decisions(opened: Page) -> None:
    """Undo steps back in it, redo forward; a removed mark is asked for again."""

    def asked() -> tuple[str, str] | None:
        opened.tab.refresh()
        goal = opened.tab.goal
        shown = [(view, opened.word(view)["placing"]) for view in NAMES]
        assert shown == [(view, goal.spec.name if goal and goal.image == view else None) for view in NAMES]
        return goal and (goal.spec.name, goal.image)

    assert asked() == ("entry", "pa")
    uv = bone.pixels([VIEWS[name] for name in NAMES])["wire"]
    for k, name in enumerate(("entry", "end")):
        opened.hear("pa", _move("/image/101", name, "place") | {"uv": uv[0][k].tolist()})
    assert asked() == ("entry", "lateral")
    opened.planning.history.undo()
    assert asked() == ("end", "pa")
    opened.planning.history.undo()
    assert asked() == ("entry", "pa")
    opened.planning.history.redo()
    opened.planning.history.redo()
    assert asked() == ("entry", "lateral")
    opened.planning.remove(("end",))
    assert asked() == ("end", "pa")
    opened.planning.history.undo()
    entry = opened.tab.goal.spec if opened.tab.goal else None
    assert entry is not None
    opened.hear("lateral", {"type": "cancel", "id": "entry", "seq": 11})
    assert asked() is None
    opened.hear("lateral", _move("/image/102", "entry", "place") | {"uv": uv[1][0].tolist()})
    opened.tab.place([entry])  # it is in both images: the first is placed anew
    assert asked() == ("entry", "pa")
    opened.hear("pa", _move("/image/101", "entry", "place") | {"uv": (uv[0][0] + 2.0).tolist()})
    assert asked() is None
    opened.planning.history.undo()
    assert asked() == ("entry", "pa")


def test_a_landmark_more_than_two_is_skipped_unless_something_is_measured_from_it(opened: Page) -> None:
    """Fails for a page that insists on all of them, and for one that gives up what the verdict needs."""
    tab, planning = opened.tab, opened.planning

    def optional(kind: str, *placed: str) -> str:
        planning.edit(marked(Decisions(images=planning.decisions.images, kind=kind), dict.fromkeys(placed, AT_PX)))
        return "" if tab.optional is None else tab.optional.of

    wire = ("entry", "end")
    assert not optional("hip-screw", *wire) and not optional("hip-screw", *wire, "landmark-head-centre")
    hip = (*wire, "landmark-head-centre", "landmark-lesser-trochanter")
    assert optional("hip-screw", *hip) == "greater-trochanter"
    assert "Greater trochanter" in verdict.left(tab)
    tab.skip()
    assert (tab.goal, tab.optional) == (None, None) and "Greater trochanter" not in verdict.left(tab)
    assert optional("free-wire", *wire) == "landmark-1"
    tab.skip()
    assert tab.goal is not None and tab.goal.spec.of == "landmark-2" and tab.optional is None  # two are needed
    tab.place([spec for spec in planning.specs if spec.of == "landmark-1"])
    assert tab.goal.spec.of == "landmark-1"


@pytest.mark.parametrize(
    ("placed", "said"), [(1, "Propose the other wires"), (2, "Next: posterior wire"), (3, "Place femoral head")]
)
def test_the_big_button_is_the_next_thing_to_do_for_three_screws(
    opened: Page, monkeypatch: pytest.MonkeyPatch, placed: int, said: str
) -> None:
    views: Any = tuple(bone.views())
    monkeypatch.setattr(opened.planning, "views", lambda names=None: views)
    monkeypatch.setattr(top, "_done", lambda tab: False)
    monkeypatch.setattr(top, "waits_for", lambda session, step: None)
    at = {f"landmark-{key}": AT_PX for key in ("head-centre", "lesser-trochanter", "greater-trochanter")}
    decisions = Decisions(images=opened.planning.decisions.images, kind=f"cannulated-hip-screws:{KEYS[0]}")
    for key, wire in zip(KEYS[:placed], WIRES_MM, strict=False):
        ends = [mark([view.project(end[None])[0] for view in views]) for end in wire]
        decisions = decisions.with_ends(f"cannulated-hip-screws:{key}", dict(zip(("entry", "end"), ends, strict=True)))
    opened.planning.edit(marked(decisions, at))
    assert opened.tab.goal is None
    top._lead(opened.tab)
    assert [one.text for one in opened.elements() if isinstance(one, ui.button)] == [said]


def test_a_notice_that_is_repeated_is_told_again(opened: Page) -> None:
    """Fails where the second of two identical notices changes nothing, and a screen reader stays silent."""
    opened.tab.say("click inside the field")
    first = top._said(opened.tab)
    opened.tab.say("click inside the field")
    assert top._said(opened.tab) != first
    opened.tab.say("")
    assert opened.tab.notices == 2


def test_stop_says_what_to_do_where_the_robot_s_link_is_lost(opened: Page) -> None:
    drilling: Any = opened.tab.session.drilling
    drilling.session = SimpleNamespace(now=SimpleNamespace(lost=False))
    top._stop(opened.tab)()
    assert texts.LINKS["open"] in opened.sentences()
    drilling.session.now.lost = True
    top._stop(opened.tab)()
    assert "link lost: use the red button" in opened.sentences()


# The ruler in both images: in space where they show the same places, else in each image alone.

PLANNING: Any = SimpleNamespace(seen={view.name: SimpleNamespace(view=view) for view in bone.views()}.get)


def _clicks(*points_mm: np.ndarray) -> dict[str, list[tuple[float, float]]]:
    return {view.name: [(u, v) for u, v in view.project(np.array(points_mm))] for view in bone.views()}


def test_as_many_clicks_on_the_same_places_are_measured_in_space() -> None:
    said = measured_in_both(PLANNING, _clicks(bone.CENTRE_MM, bone.ENTRY_MM))
    assert said is not None
    label, note = said
    assert label.startswith(f"{np.linalg.norm(bone.ENTRY_MM - bone.CENTRE_MM):.1f} ± ") and label.endswith("mm")
    assert note == texts.RULER_SPACE
    turned = measured_in_both(
        PLANNING, _clicks(bone.CENTRE_MM, bone.ENTRY_MM, bone.CENTRE_MM + np.array([0.0, 0.0, 30.0]))
    )
    assert turned is not None and "°" in turned[0]


def test_clicks_in_one_image_more_in_one_or_on_other_places_are_not() -> None:
    both = _clicks(bone.CENTRE_MM, bone.ENTRY_MM)
    assert measured_in_both(PLANNING, {"pa": both["pa"]}) is None
    assert measured_in_both(PLANNING, both | {"pa": [*both["pa"], (400.0, 400.0)]}) is None
    assert measured_in_both(PLANNING, both | {"pa": both["pa"][::-1]}) is None
