"""One open page: what it shows of the procedure, and what its person does. Several may show the same procedure."""

import asyncio
import traceback
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from nicegui import ui

from sightline.app.drawing import shapes
from sightline.app.drawing.pictures import Pictures
from sightline.app.drawing.xray.view import Display as XrayDisplay
from sightline.app.drawing.xray.view import Shown, Window, XrayEvent, XrayView
from sightline.app.plan.decisions import Decisions, Display, Pixel
from sightline.app.plan.marks import CHECK_NAMES, Asked, asked_of, names_of
from sightline.app.plan.planner import Planned, drawn_curves, planned
from sightline.app.texts import BUG, IMAGE_LABELS, LIVE_LABELS, LIVE_UNKNOWN, STALE, STEPS, XRAY
from sightline.app.work.failures import told, why_not
from sightline.app.work.live import fresh_s
from sightline.app.work.procedure import Procedure
from sightline.app.work.seen import SeenImage
from sightline.calibration import BeadView
from sightline.case.views import NAMES
from sightline.errors import SightlineError
from sightline.planning import MatchingCurve

if TYPE_CHECKING:
    from sightline.case.watch.eye import Watched

_STYLES = {"wire": "plan", "landmark": "landmark", "aid": "aid"}


@dataclass(frozen=True)
class Goal:
    """A mark to be placed in an image: reached once it is elsewhere than `before`, None for not placed at all."""

    asked: Asked
    image: str
    before: Pixel | None = None

    def reached(self, decisions: Decisions) -> bool:
        """True once it is placed."""
        return decisions.mark(self.asked.name).at(self.image) != self.before


@dataclass(frozen=True, eq=False)
class Preview:
    """What follows from a point on its way, as far as it is computed. `revision`: of the decisions that it left.
    `layers`: by image, those that are drawn otherwise. `known`: the plan, once it is there."""

    revision: int
    decisions: Decisions
    layers: Mapping[str, Mapping[str, list[shapes.Shape]]]
    known: Planned | None = None


class Tab:
    """State of one page that is nobody else's: its step, what its person wants to place, what was said to them. What
    the views show follows from it and from the procedure, anew at each refresh."""

    def __init__(
        self, procedure: Procedure, pictures: Pictures, *, fast_robot: bool = False, live_source: str | None = None
    ) -> None:
        """`fast_robot`: a simulated robot's time runs as fast as it computes. `live_source`: of the live image."""
        self.procedure, self.planning, self.pictures = procedure, procedure.planning, pictures
        self.fast_robot, self.live_source = fast_robot, live_source
        self.live: Watched | None = None  # what is shown of it
        self._live_in = NAMES[0]  # the view it is shown in
        self.step = STEPS[0]
        self._wanted: tuple[Goal, ...] | None = None  # what a person chose to place; None: what the step asks for
        self.message = ""
        self.show_beads, self.show_rejected = True, False
        self.views: tuple[XrayView, XrayView]
        self._preview: Preview | None = None  # while a point is dragged
        self._dragged: tuple[object, int] | None = None  # the last drag that is not over, and the revision it is of
        self.on_refresh: list[Callable[[], None]] = []
        self.on_step: Callable[[str, str], None] = lambda before, step: None
        self._drawn: dict[str, tuple[tuple[object, ...], _Layers, str]] = {}  # by image: of what, layers, why not all
        self._waiting = False

    # What is shown.

    @property
    def images(self) -> tuple[str, str]:
        """Names of the images in the two views."""
        return CHECK_NAMES if self.step == STEPS[4] and self.planning.seen(CHECK_NAMES[0]) else NAMES

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
        before, self.step, self.message = self.step, step, ""
        self.live = None
        self.show_beads = step in STEPS[:2]  # where bone is looked at they are in the way
        self._wanted = None
        self.on_step(before, step)
        self.refresh()

    def show_live(self, watched: "Watched | None") -> None:
        """A live image in the view it belongs to; None: the images of the plan again."""
        self.live, ended = watched, watched is None and self.live is not None
        if watched is not None:
            if watched.view is not None:
                self._live_in = watched.view.name
            self._show_views()
        elif ended:
            self.refresh()

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
        """Show what is so now."""
        self._show_views()
        self._refresh_parts()

    def _refresh_parts(self) -> None:
        """All that is beside the two views; none holds another up."""
        refused = [why for why in map(why_not, list(self.on_refresh)) if why]
        if refused and not self.message:
            self.message = refused[0]
            self.later()

    def _show_views(self) -> None:
        for view, image in zip(self.views, self.images, strict=True):
            if self.live is not None and view.name == self._live_in:
                view.show(self._shown_live(view, self.live), fresh_s=fresh_s(self.live))
            else:
                view.show(self._shown(image))

    def _shown_live(self, view: XrayView, watched: "Watched") -> Shown:
        picture = self.pictures.live(watched.image)
        turned = self.planning.decisions.display.get(view.name, Display())
        return Shown(
            LIVE_LABELS[view.name] if watched.view is not None else LIVE_UNKNOWN,
            picture,
            XrayDisplay(turned.rotation, turned.mirrored, False, picture.window),
            {"wire": [] if watched.corridor is None else shapes.band(watched.corridor)},
            notice=STALE.format(age=watched.age_s) if watched.stale else None,
        )

    def _shown(self, image: str) -> Shown:
        """What the view of an image shows."""
        procedure, seen = self.procedure, self.planning.seen(image)
        if seen is None:
            return Shown(IMAGE_LABELS[image])
        layers, undrawn = self._layers(image, seen)
        preview = self.preview
        if preview is not None:
            layers = {**layers, **preview.layers.get(image, {})}
        hidden = {name for name, on in (("beads", self.show_beads), ("rejected", self.show_rejected)) if not on}
        picture, display = self.pictures.of(seen), procedure.planning.decisions.display.get(image, Display())
        window = picture.window if display.window is None else Window(*display.window)
        goal = self.goal
        # Case and image are part of the revision: an edit that a killed server lost belongs to no other.
        return Shown(
            IMAGE_LABELS[image],
            picture,
            XrayDisplay(display.rotation, display.mirrored, display.inverted, window),
            {name: drawn for name, drawn in layers.items() if name not in hidden},
            self._points(image, procedure.planning.decisions if preview is None else preview.decisions),
            goal.asked.name if goal is not None and goal.image == image else None,
            (f"{seen.doing.capitalize()} …" if seen.doing else seen.refused) or undrawn or None,
            f"{procedure.planning.case.number} {image} {seen.acquired.number} {procedure.planning.history.revision}",
        )

    def _layers(self, image: str, seen: SeenImage) -> "tuple[_Layers, str]":
        """What is drawn over an image by layer, and why one of them is not there. Computed once for the same plan."""
        verifying, known = self.procedure.verifying, self.planning.planned
        of = (seen, known, verifying.wires.get(image), verifying.shot)
        if image in self._drawn and self._drawn[image][0] == of:
            return self._drawn[image][1:]
        makers: dict[str, Callable[[], list[shapes.Shape]]] = {
            "beads": lambda: shapes.beads(seen),
            "rejected": lambda: shapes.rejected(seen),
        }
        if image in CHECK_NAMES:
            makers["found"] = lambda: shapes.found(self.procedure, image)
        elif known is not None:
            makers["curves"] = lambda: shapes.curves(known.curves) if image == NAMES[1] else []
            makers["wire"] = lambda: shapes.wire(known, image)
            makers["aids"] = lambda: shapes.aids(known, image)
        layers: dict[str, list[shapes.Shape]] = {}
        refused = [why_not(lambda name=name: layers.update({name: makers[name]()})) for name in makers]
        self._drawn[image] = of, layers, next(filter(None, refused), "")
        return self._drawn[image][1:]

    def _points(self, image: str, decisions: Decisions) -> list[dict[str, Any]]:
        """The points of an image, placed or not."""
        out = []
        for asked in asked_of(decisions.kind):
            check = image in CHECK_NAMES
            if (check and asked.group != "landmark") or (not check and image not in asked.images):
                continue
            mark = decisions.mark(asked.name)
            out.append(
                {
                    "id": asked.name,
                    "label": asked.label,
                    "uv": mark.at(image),
                    "style": _STYLES[asked.group],
                    "movable": self.step in (STEPS[2], STEPS[4]),
                    "snapped": image == NAMES[1] and asked.group == "wire" and not mark.free,
                }
            )
        return out

    # What is placed next: it follows from the decisions, so that undo steps back in it too.

    @property
    def goal(self) -> Goal | None:
        """What is to be placed now."""
        wanted = self._asked_by_step() if self._wanted is None else self._wanted
        return next((one for one in wanted if not one.reached(self.planning.decisions)), None)

    def _asked_by_step(self) -> tuple[Goal, ...]:
        asked, procedure = asked_of(self.planning.decisions.kind), self.procedure
        if self.step == STEPS[4] and procedure.planning.views(CHECK_NAMES) is not None:
            return _goals([one for one in asked if one.group == "landmark"], CHECK_NAMES)
        if self.step == STEPS[2] and procedure.planning.planned is not None:
            return _goals([one for one in asked if one.group != "aid"], NAMES)
        return ()

    def place(self, listed: Sequence[Asked], images: tuple[str, str] = NAMES) -> None:
        """Ask for those of these marks that are not placed; where all are, for the first anew."""
        goals, decisions = _goals(listed, images), self.planning.decisions
        if all(one.reached(decisions) for one in goals):
            first = goals[0]
            goals = (replace(first, before=decisions.mark(first.asked.name).at(first.image)),)
        self._wanted = goals
        self.refresh()

    # What a person does in a view.

    async def _heard(self, view: XrayView, event: XrayEvent) -> None:
        if event.type == "cancel":
            self._wanted = ()
            self.refresh()
        elif event.type == "refused":
            self._let_go()
        elif event.type == "error":
            self.say(event.message or XRAY["load_failed"])
        elif event.type in ("place", "drop", "nudge", "drag", "remove", "display"):
            image = self._shown_in(view)
            if image is None:
                view.drop(event)
                self._let_go()
            else:
                await self._done_on(image, event)

    def _let_go(self) -> None:
        """Nothing is dragged any more: what followed from it is not so."""
        self._preview = self._dragged = None
        self.refresh()

    async def _done_on(self, image: str, event: XrayEvent) -> None:
        if event.id is not None and event.uv is not None:
            await self._moved(image, event.type, event.id, event.uv)
        elif event.id is not None:
            without = self.planning.decisions.mark(event.id).placed(image, None)
            await self.act(lambda: self.planning.edit(self.planning.decisions.with_mark(event.id or "", without)))
        elif event.display is not None:
            shown = event.display
            display = Display(shown.rotation, shown.mirrored, shown.inverted, (shown.window.centre, shown.window.width))
            await self.act(lambda: self.planning.show(image, display))

    def _shown_in(self, view: XrayView) -> str | None:
        """Name of the image that a view shows; None of a live one, and of one in whose place another is by now."""
        image = self.images[self.views.index(view)]
        seen, shown = self.planning.seen(image), view.shown.picture
        return None if seen is None or shown is None or shown.url != self.pictures.of(seen).url else image

    async def _moved(self, image: str, how: str, name: str, uv: Pixel) -> None:
        if how == "drag":
            await self._follow(name, image, uv)
            return
        self._preview = self._dragged = None
        await self.act(lambda: self.planning.edit(self.planning.moved(name, image, uv, anew=how == "place")))

    async def _follow(self, name: str, image: str, uv: Pixel) -> None:
        """Curves, wire and figures follow a point that is being dragged: the curves first, they guide the hand."""
        procedure = self.procedure
        pair, drag = procedure.planning.views(), (object(), procedure.planning.history.revision)
        if pair is None:
            return
        self._dragged = drag
        try:
            decisions, curves = await asyncio.to_thread(_moved_curves, procedure, pair, name, image, uv)
            if not self._goes_on(drag):
                return
            before, drawn = self.preview, {NAMES[1]: {"curves": shapes.curves(curves)}}
            if before is not None:  # the wire waits for its plan
                drawn = {of: {**before.layers.get(of, {}), **drawn.get(of, {})} for of in NAMES}
            self._preview = Preview(drag[1], decisions, drawn, None if before is None else before.known)
            self._show_views()
            known, layers = await asyncio.to_thread(_planned_layers, decisions, pair, name)
            if not self._goes_on(drag):
                return
            layers[NAMES[1]]["curves"] = drawn[NAMES[1]]["curves"]
            self._preview = Preview(drag[1], decisions, layers, known)
        except SightlineError:  # told where it is dropped; nothing follows from here
            if not self._goes_on(drag):
                return
            self._preview = None
        except Exception as error:
            traceback.print_exc()
            self._preview, self.message = None, BUG.format(kind=type(error).__name__)
        self.refresh()

    def _goes_on(self, drag: tuple[object, int]) -> bool:
        """False once the point was dropped or dragged on, or anything was decided meanwhile, undone again or not."""
        return drag is self._dragged and drag[1] == self.planning.history.revision

    @property
    def preview(self) -> Preview | None:
        """What follows from the point that is being dragged; None of a drag that is over."""
        one = self._preview
        return one if one is not None and one.revision == self.planning.history.revision else None

    # How anything a person asks for is done.

    async def act(self, what: Callable[[], Awaitable[Any] | None]) -> None:
        """Do it; what goes wrong ends in a sentence on the page."""
        try:
            pending = what()
            self.message = ""
            if pending is not None:
                await pending
        except Exception as error:
            self.message = told(error)
        self.refresh()

    def doing(self, what: Callable[[], Awaitable[Any] | None]) -> Callable[[], Awaitable[None]]:
        """A handler for a button."""

        async def handler() -> None:
            await self.act(what)

        return handler

    @property
    def known(self) -> Planned | None:
        """The plan that figures are shown of: of the point being dragged, or as it is."""
        preview = self.preview
        return self.planning.planned if preview is None or preview.known is None else preview.known


_Pair = tuple[BeadView, BeadView]
_Layers = dict[str, list[shapes.Shape]]


def _goals(listed: Iterable[Asked], images: tuple[str, str]) -> tuple[Goal, ...]:
    """Wire and aids image by image, entry and end in the PA image, then both in the lateral one; landmarks one by one
    in both."""
    listed = tuple(listed)
    wire = [Goal(a, image) for image in images for a in listed if a.group != "landmark" and image in a.images]
    return (*wire, *(Goal(a, image) for a in listed if a.group == "landmark" for image in images))


def _moved_curves(
    procedure: Procedure, pair: _Pair, name: str, image: str, uv: Pixel
) -> tuple[Decisions, dict[str, MatchingCurve]]:
    """What moving a mark would come to, and the curves then; runs beside the page."""
    decisions = procedure.planning.moved(name, image, uv)
    return decisions, drawn_curves(decisions, pair)[0]


def _planned_layers(decisions: Decisions, pair: _Pair, moved: str) -> tuple[Planned, dict[str, _Layers]]:
    """All that follows from decisions, its figures too, and by image what is drawn otherwise; runs beside the page."""
    known = planned(decisions, pair)
    layers = {image: {"wire": shapes.wire(known, image)} for image in NAMES}
    if moved in names_of(decisions.kind, "aid"):
        for image, drawn in layers.items():
            drawn["aids"] = shapes.aids(known, image)
    with suppress(SightlineError):  # whoever shows them says why they are not there
        _ = known.figures
    return known, layers
