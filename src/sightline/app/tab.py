"""One open page: what it shows of the procedure, and what its person does. Several may show the same procedure."""

import asyncio
import traceback
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from nicegui import ui

from sightline.app import shapes
from sightline.app.decisions import Decisions, Display
from sightline.app.drawn import Pictures
from sightline.app.live import fresh_s
from sightline.app.marks import CHECK_NAMES, Asked, asked_of, names_of
from sightline.app.planner import Planned, drawn_curves, planned
from sightline.app.procedure import Procedure
from sightline.app.texts import BUG, IMAGE_LABELS, LIVE_LABELS, LIVE_UNKNOWN, STALE, STEPS, XRAY
from sightline.app.xray import Window, XrayEvent, XrayView
from sightline.calibration import BeadView
from sightline.case.views import NAMES
from sightline.errors import SightlineError
from sightline.planning import MatchingCurve

if TYPE_CHECKING:
    from sightline.case.watch import Watched

_STYLES = {"wire": "plan", "landmark": "landmark", "aid": "aid"}


class Tab:
    """State of one page that is nobody else's: its step, what is to be placed next, what was said to its person."""

    def __init__(
        self, procedure: Procedure, pictures: Pictures, *, fast_robot: bool = False, live_source: str | None = None
    ) -> None:
        """`fast_robot`: a simulated robot's time runs as fast as it computes. `live_source`: of the live image."""
        self.procedure, self.pictures = procedure, pictures
        self.fast_robot, self.live_source = fast_robot, live_source
        self.live: Watched | None = None  # what is shown of it
        self._live_in = NAMES[0]  # the view it is shown in
        self.step = STEPS[0]
        self.placing: tuple[str, str] | None = None  # a mark and the image it is placed in
        self.sequence: tuple[Asked, ...] = ()  # what is placed one after the other
        self.message = ""
        self.show_beads, self.show_rejected = True, False
        self.views: tuple[XrayView, XrayView]
        self.preview: Planned | None = None  # while a point is dragged
        self._dragged: tuple[object, int] | None = None  # the last drag that is not over, and the revision it is of
        self.on_refresh: list[Callable[[], None]] = []
        self._shown: dict[tuple[str, str], Any] = {}
        self._undrawn: dict[str, str] = {}  # by view, why a layer of the plan is not there
        self._waiting = self._offered = False

    # What is shown.

    @property
    def images(self) -> tuple[str, str]:
        """Names of the images in the two views."""
        return CHECK_NAMES if self.step == STEPS[4] and self.procedure.seen(CHECK_NAMES[0]) else NAMES

    def build_views(self, *boxes: ui.element) -> None:
        """The two X-ray views, each in its box."""
        made = []
        for name, box in zip(NAMES, boxes, strict=True):
            with box:
                made.append(XrayView(name, label=IMAGE_LABELS[name], texts=XRAY))
            made[-1].on_event(self._heard)
        self.views = (made[0], made[1])

    def go_to(self, step: str) -> None:
        """Another step; nothing is lost by it."""
        self.step, self.message = step, ""
        self.show_live(None)
        self.show_beads = step in STEPS[:2]  # where bone is looked at they are in the way
        self.placing, self._offered = None, False
        self.refresh()

    def _offer(self) -> None:
        """Ask for the points of a step once, as soon as its images are there."""
        check = self.step == STEPS[4] and self.procedure.views(CHECK_NAMES) is not None
        plan = self.step == STEPS[2] and self.procedure.planned is not None
        if (check or plan) and not self._offered:
            self._offered = True
            self.place_next(self._landmarks() if check else self._wire_and_landmarks(), self.images)

    def show_live(self, watched: "Watched | None") -> None:
        """A live image in the view it belongs to; None: the images of the plan again."""
        if watched is not None:
            if self.live is None or self.live.number != watched.number:
                self._draw_live(watched)
            else:
                self.views[NAMES.index(self._live_in)].fresh_for(fresh_s(watched))
            self.live = watched
            view = self.views[NAMES.index(self._live_in)]
            view.notice(STALE.format(age=watched.age_s) if watched.stale else None)
        elif self.live is not None:
            self.live = None
            self._show_planned(self._live_in)
            self.refresh()

    def _draw_live(self, watched: "Watched") -> None:
        """A new live image."""
        before = self._live_in
        self._live_in = before if watched.view is None else watched.view.name
        if before != self._live_in:
            self._show_planned(before)
        view = self.views[NAMES.index(self._live_in)]
        picture = self.pictures.live(watched.image)
        view.set_label(LIVE_LABELS[self._live_in] if watched.view is not None else LIVE_UNKNOWN)
        size = picture.width, picture.height
        view.set_image(picture.url, *size, window=picture.window, fresh_s=fresh_s(watched))
        view.draw("wire", [] if watched.corridor is None else shapes.band(watched.corridor))
        for layer in ("beads", "curves", "aids"):
            view.draw(layer, [])
        view.set_points([])

    def _show_planned(self, name: str) -> None:
        """The plan's image again in the view that a live one was in."""
        view = self.views[NAMES.index(name)]
        for key in [key for key in self._shown if key[0] == name]:
            del self._shown[key]
        self._show(view, self.images[NAMES.index(name)])

    def say(self, text: str) -> None:
        """A sentence for the person; empty: nothing to say."""
        self.message = text
        self.refresh()

    def later(self) -> None:
        """Refresh soon, once however often this is called until then."""
        if not self._waiting:
            self._waiting = True
            asyncio.get_running_loop().call_soon(self._refresh_now)

    def _refresh_now(self) -> None:
        self._waiting = False
        self.refresh()

    def refresh(self) -> None:
        """Show all that is another than what is shown."""
        self._offer()
        for view, image in zip(self.views, self.images, strict=True):
            if self.live is None or view.name != self._live_in:
                self._show(view, image)
        self._refresh_parts()

    def _refresh_parts(self) -> None:
        """All that is beside the two views; none holds another up."""
        refused = [why for why in map(why_not, list(self.on_refresh)) if why]
        if refused and not self.message:
            self.message = refused[0]
            self.later()

    def _show(self, view: XrayView, image: str) -> None:
        procedure, seen = self.procedure, self.procedure.seen(image)
        key = view.name
        if self._is_new(key, "label", image):
            view.set_label(IMAGE_LABELS[image])
        if seen is not None and self._is_new(key, "image", (image, seen.acquired.number)):
            picture = self.pictures.of(seen)
            view.set_image(picture.url, picture.width, picture.height, window=picture.window)
            self._shown.pop((key, "display"), None)  # the image comes with a window of its own
            self._shown.pop((key, "points"), None)  # and without what was being done on the one before
        display = procedure.decisions.display.get(image, Display())
        if self._is_new(key, "display", (image, display)):
            own = None if seen is None else self.pictures.of(seen).window  # also where a change of it is undone
            window = own if display.window is None else Window(*display.window)
            view.set_display(
                rotation=display.rotation, mirrored=display.mirrored, inverted=display.inverted, window=window
            )
        if seen is not None and self._is_new(key, "beads", (seen, image)):
            view.draw("beads", shapes.beads(seen))
            view.draw("rejected", shapes.rejected(seen))
        if self._is_new(key, "show beads", self.show_beads):
            view.show_layer("beads", self.show_beads)
        if self._is_new(key, "rejected", self.show_rejected):
            view.show_layer("rejected", self.show_rejected)
        self._draw_plan(view, key, image, procedure.planned)
        doing = "" if seen is None else (seen.doing and f"{seen.doing.capitalize()} …") or (seen.refused or "")
        notice = doing or self._undrawn.get(key, "")
        if self._is_new(key, "notice", notice):
            view.notice(notice or None)
        marks = self._points(image)
        if self._is_new(key, "points", marks):
            view.set_points([dict(mark) for mark in marks])
        placing = self.placing[0] if self.placing is not None and self.placing[1] == image else None
        if self._is_new(key, "placing", placing):
            view.place(placing)
        # Case and image are part of it: an edit that a killed server lost belongs to no other.
        number = 0 if seen is None else seen.acquired.number
        revision = f"{procedure.case.number} {image} {number} {procedure.history.revision}"
        if seen is not None and self._is_new(key, "revision", revision):
            view.set_revision(revision)

    def _draw_plan(self, view: XrayView, key: str, image: str, known: Planned | None) -> None:
        verifying = self.procedure.verifying
        if not self._is_new(key, "plan", (image, known, verifying.wires.get(image), verifying.shot)):
            return
        layers: dict[str, Callable[[], list[shapes.Shape]]] = dict.fromkeys(("curves", "wire", "aids", "found"), list)
        if image in CHECK_NAMES:
            layers["found"] = lambda: shapes.found(self.procedure, image)
        elif known is not None:
            layers["wire"] = lambda: shapes.wire(known, image)
            layers["aids"] = lambda: shapes.aids(known, image)
            layers["curves"] = lambda: shapes.curves(known.curves) if image == NAMES[1] else []
        refused = [self._draw(view, layer, shapes_of) for layer, shapes_of in layers.items()]
        self._undrawn[key] = next(filter(None, refused), "")

    def _draw(self, view: XrayView, layer: str, shapes_of: Callable[[], list[shapes.Shape]]) -> str:
        """Draw a layer, or where it cannot be drawn nothing: what was there is of another plan. Why it cannot."""
        drawn: list[shapes.Shape] = []
        refused = why_not(lambda: drawn.extend(shapes_of()))
        view.draw(layer, drawn)
        return refused

    def _points(self, image: str) -> tuple[tuple[tuple[str, Any], ...], ...]:
        """What `set_points` wants, in a form that can be compared."""
        decisions = self.procedure.decisions
        out = []
        for asked in asked_of(decisions.kind):
            check = image in CHECK_NAMES
            if (check and asked.group != "landmark") or (not check and image not in asked.images):
                continue
            mark = decisions.mark(asked.name)
            snapped = image == NAMES[1] and asked.group == "wire" and not mark.free
            values = (
                asked.name,
                asked.label,
                mark.at(image),
                _STYLES[asked.group],
                self.step in (STEPS[2], STEPS[4]),
                snapped,
            )
            out.append(tuple(zip(("id", "label", "uv", "style", "movable", "snapped"), values, strict=True)))
        return tuple(out)

    def _is_new(self, view: str, what: str, value: Any) -> bool:
        if (view, what) in self._shown and self._shown[view, what] == value:
            return False
        self._shown[view, what] = value
        return True

    # What is placed next.

    def place_next(self, sequence: tuple[Asked, ...], images: tuple[str, str] = NAMES) -> None:
        """Ask for the first of these marks that is not placed; after it for the next."""
        self.sequence = sequence
        decisions, self.placing = self.procedure.decisions, None
        # Image by image for each two: entry and end in the PA image, then both in the lateral one.
        wire = [(a, image) for image in images for a in sequence if a.group != "landmark" and image in a.images]
        others = [(a, image) for a in sequence if a.group == "landmark" for image in images]
        for asked, image in (*wire, *others):
            if decisions.mark(asked.name).at(image) is None:
                self.placing = (asked.name, image)
                return

    def place_again(self, asked: Asked, image: str) -> None:
        """Place one mark anew in one image."""
        self.sequence, self.placing = (asked,), (asked.name, image)
        self.refresh()

    @property
    def asked(self) -> Asked | None:
        """What is to be placed now."""
        if self.placing is None:
            return None
        return next((one for one in asked_of(self.procedure.decisions.kind) if one.name == self.placing[0]), None)

    def _wire_and_landmarks(self) -> tuple[Asked, ...]:
        return tuple(a for a in asked_of(self.procedure.decisions.kind) if a.group != "aid")

    def _landmarks(self) -> tuple[Asked, ...]:
        return tuple(a for a in asked_of(self.procedure.decisions.kind) if a.group == "landmark")

    # What a person does in a view.

    async def _heard(self, view: XrayView, event: XrayEvent) -> None:
        if event.type == "cancel":
            self.placing = None
            self.refresh()
        elif event.type == "error":
            self.say(event.message or XRAY["load_failed"])
        elif event.type in ("place", "drop", "nudge", "drag", "remove", "display"):
            image = self._shown_in(view)
            if image is None:
                self._shown.pop((view.name, "placing"), None)  # which the view has ended
                view.drop(event)
            else:
                await self._done_on(view, image, event)

    async def _done_on(self, view: XrayView, image: str, event: XrayEvent) -> None:
        if event.uv is not None:
            await self._moved(view, image, event)
        elif event.type == "remove" and event.id is not None:
            await self.act(lambda: self.procedure.edit(self._without(event.id or "", image)))
        elif event.display is not None:
            shown = event.display
            window = (shown.window.centre, shown.window.width)
            display = Display(shown.rotation, shown.mirrored, shown.inverted, window)
            self._shown[view.name, "display"] = (image, display)
            await self.act(lambda: self.procedure.show(image, display))

    def _shown_in(self, view: XrayView) -> str | None:
        """Name of the image that a view shows; None of a live one, and of one in whose place another is by now."""
        image = self.images[self.views.index(view)]
        seen, live = self.procedure.seen(image), self.live is not None and view.name == self._live_in
        if live or seen is None or self._shown.get((view.name, "image")) != (image, seen.acquired.number):
            return None
        return image

    def _without(self, name: str, image: str):
        decisions = self.procedure.decisions
        return decisions.with_mark(name, decisions.mark(name).placed(image, None))

    async def _moved(self, view: XrayView, image: str, event: XrayEvent) -> None:
        assert event.id is not None and event.uv is not None and event.seq is not None  # noqa: S101 - checked by the view
        name, uv = event.id, event.uv
        try:
            if event.type == "drag":
                await self._follow(name, image, uv)
            else:
                self.preview = self._dragged = None
                self.procedure.edit(self.procedure.moved(name, image, uv, anew=event.type == "place"))
                self.message = ""
                if event.type == "place" and self.placing is not None:
                    self.place_next(self.sequence, self.images)
                self._forget_plan()
                self.refresh()
        except SightlineError as error:
            if event.type != "drag":
                self._back(view, str(error))
        except Exception as error:
            traceback.print_exc()
            self._back(view, BUG.format(kind=type(error).__name__))
        finally:
            view.acknowledge(event.seq)

    def _back(self, view: XrayView, why: str) -> None:
        """The point goes back to where it was, and the person is told why."""
        self._forget_plan()
        for what in ("points", "placing"):  # the view has ended both
            self._shown.pop((view.name, what), None)
        self.say(why)

    async def _follow(self, name: str, image: str, uv: tuple[float, float]) -> None:
        """Curves, wire and figures follow a point that is being dragged: the curves first, they guide the hand."""
        procedure = self.procedure
        pair, drag = procedure.views(), (object(), procedure.history.revision)
        if pair is None:
            return
        self._dragged = drag
        decisions, curves = await asyncio.to_thread(_moved_curves, procedure, pair, name, image, uv)
        if not self._goes_on(drag):
            return
        lateral = self.views[self.images.index(NAMES[1])] if NAMES[1] in self.images else None
        if lateral is not None:
            others = {n: at for n, at in shapes.snapped(decisions).items() if (n, NAMES[1]) != (name, image)}
            lateral.follow({"curves": shapes.curves(curves)}, others)
        known, drawn = await asyncio.to_thread(_planned_shapes, decisions, pair, self.images, name)
        if not self._goes_on(drag):
            self._forget_plan()
            self.later()
            return
        self.preview = known
        for view, layers in zip(self.views, drawn, strict=True):
            view.follow(layers, {})
        self._forget_plan()
        self._refresh_parts()

    def _goes_on(self, drag: tuple[object, int] | None) -> bool:
        """False once the point was dropped or dragged on, or anything was decided meanwhile, undone again or not."""
        return drag is not None and drag is self._dragged and drag[1] == self.procedure.history.revision

    def _forget_plan(self) -> None:
        for view in self.views:
            self._shown.pop((view.name, "plan"), None)

    # How anything a person asks for is done.

    async def act(self, what: Callable[[], Awaitable[Any] | None]) -> None:
        """Do it; what goes wrong ends in a sentence on the page."""
        try:
            pending = what()
            self.message = ""
            if pending is not None:
                await pending
        except SightlineError as error:
            self.message = str(error)
        except Exception as error:
            traceback.print_exc()
            self.message = BUG.format(kind=type(error).__name__)
        self.refresh()

    def doing(self, what: Callable[[], Awaitable[Any] | None]) -> Callable[[], Awaitable[None]]:
        """A handler for a button."""

        async def handler() -> None:
            await self.act(what)

        return handler

    @property
    def known(self) -> Planned | None:
        """The plan that figures are shown of: of the point being dragged, or as it is."""
        return self.preview if self.preview is not None and self._goes_on(self._dragged) else self.procedure.planned


_Pair = tuple[BeadView, BeadView]


def _moved_curves(
    procedure: Procedure, pair: _Pair, name: str, image: str, uv: tuple[float, float]
) -> tuple[Decisions, dict[str, MatchingCurve]]:
    """What moving a mark would come to, and the curves then; runs beside the page."""
    decisions = procedure.moved(name, image, uv)
    return decisions, drawn_curves(decisions, pair)[0]


def _planned_shapes(
    decisions: Decisions, pair: _Pair, images: tuple[str, str], moved: str
) -> tuple[Planned, list[dict[str, list[shapes.Shape]]]]:
    """All that follows from decisions, its figures too, and what is drawn otherwise in each view; runs beside the
    page."""
    known = planned(decisions, pair)
    layers = [{"wire": shapes.wire(known, image)} for image in images]
    if moved in names_of(decisions.kind, "aid"):
        for image, drawn in zip(images, layers, strict=True):
            drawn["aids"] = shapes.aids(known, image)
    with suppress(SightlineError):  # whoever shows them says why they are not there
        _ = known.figures
    return known, layers


def why_not(work: Callable[[], object]) -> str:
    """Do it. Empty, or the sentence why it could not be done."""
    try:
        work()
    except SightlineError as error:
        return str(error)
    except Exception as error:
        traceback.print_exc()
        return BUG.format(kind=type(error).__name__)
    return ""
