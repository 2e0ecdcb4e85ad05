"""The content of a page's two X-ray views, derived from procedure, step and drag at each refresh; and the preview of
the plan during a drag. The browser draws the curves that guide the hand by itself."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from nicegui import ui

from sightline.app import texts
from sightline.app.drawing import shapes
from sightline.app.drawing.pictures import Pictures, head_in, head_up
from sightline.app.drawing.xray import Window, XrayContent, XrayDisplay, XrayEvent, XrayView
from sightline.app.plan.decisions import Decisions, Display, Pixel, Side
from sightline.app.plan.marks import GUIDE, MarkSpec
from sightline.app.plan.planner import Planned, planned
from sightline.app.session.jobs import failure_of
from sightline.app.session.planning import Planning
from sightline.app.session.seen import SeenImage
from sightline.app.session.session import Session
from sightline.app.session.shots import fresh_s
from sightline.app.tab.placing import Goal, ProcedureStep
from sightline.app.texts import image_label
from sightline.calibration import BeadView
from sightline.case.views import ALL_NAMES, CHECK_NAMES, NAMES, OBLIQUE, SHOT_NAMES
from sightline.common.threads import one_blas_thread
from sightline.errors import SightlineError

if TYPE_CHECKING:
    from sightline.case.watch.analyser import Watched

_Views = tuple[BeadView, ...]


@dataclass(frozen=True, eq=False)
class Preview:
    """Preview of a dragged point. `revision`: of the decisions it started from. `layers`: changed layers, by image,
    without the curves, which the page draws. `known`: the plan."""

    revision: int
    decisions: Decisions
    layers: Mapping[str, Mapping[str, list[shapes.Shape]]]
    known: Planned


class Dragging:
    """The drag on one page. One move is computed at a time; of those that come meanwhile only the newest is."""

    def __init__(self, planning: Planning) -> None:
        self._planning = planning
        self._preview: Preview | None = None
        self._newest: object = None  # the latest unfinished move
        self._ended = 0  # number of drags ended
        self._computing = asyncio.Lock()

    @property
    def preview(self) -> Preview | None:
        """The preview of the current drag; None if it is over."""
        preview = self._preview
        return preview if preview is not None and preview.revision == self._planning.history.revision else None

    def end(self) -> None:
        """End the drag and discard its preview."""
        self._preview = self._newest = None
        self._ended += 1

    async def follow(self, name: str, image: str, uv: Pixel) -> bool:
        """Compute the preview of a dragged point. Returns True if the page must be refreshed, False if the drag has
        ended meanwhile, a newer move waits, or there is no preview."""
        planning, drag = self._planning, (self._ended, self._planning.history.revision)
        if name in {spec.name for spec in planning.decisions.specs if spec.group == "nail"}:
            return False  # the images are searched once the mark is dropped
        move = self._newest = object()
        async with self._computing:
            views = planning.views()
            if views is None or move is not self._newest or not self._goes_on(drag):
                return False
            try:
                decisions, known, layers = await asyncio.to_thread(_preview, planning, views, name, image, uv)
                made = Preview(drag[1], decisions, layers, known)
            except SightlineError:  # the drop reports it; there is no preview here
                made = None
            except Exception:
                self._preview = None
                raise
        if not self._goes_on(drag):
            return False
        self._preview = made
        return True

    def _goes_on(self, drag: tuple[int, int]) -> bool:
        """Return False once the drag has ended or any decision was made meanwhile, even if undone."""
        return drag == (self._ended, self._planning.history.revision)


@one_blas_thread
def _preview(
    planning: Planning, views: _Views, name: str, image: str, uv: Pixel
) -> tuple[Decisions, Planned, dict[str, shapes.Layers]]:
    """Return decisions, plan and changed layers after moving a mark; runs on another thread."""
    decisions = planning.moved(name, image, uv)
    known = planned(decisions, views, planning.nail.found, planning.bone)
    layers = {image: {"wire": shapes.wire(known, image)} for image in ALL_NAMES}
    if any(spec.name == name and spec.group == "aid" for spec in decisions.specs):
        for shown, drawn in layers.items():
            drawn["aids"] = shapes.aids(known, shown)
    return decisions, known, layers


# Of points, by the group of their mark, where not that.
_STYLES = {"guide": "aid", "nail": "aid", "robot": "aid", "bone": "landmark"}
_FILLED_MM = 0.5  # the drilled wire grows in steps of this, so that images are not redrawn all the time [ours]


class Views:
    """The X-ray views of one page. `pair`: both, once built. `watched`: the live image in one of them, if any.
    `show_oblique`: the second view shows the third image."""

    pair: tuple[XrayView, XrayView]

    def __init__(self, session: Session, pictures: Pictures) -> None:
        self._session, self._planning, self._pictures = session, session.planning, pictures
        self.show_beads, self.show_rejected, self.show_oblique = True, False, False
        self._placing_oblique = False
        self.watched: Watched | None = None
        self._live_in = NAMES[0]  # the view that shows the live image
        self._drawn: dict[str, tuple[tuple[object, ...], shapes.Layers, str]] = {}  # by image: input, layers, error
        self._heads: dict[
            str, tuple[tuple[BeadView | None, Side | None], int | None]
        ] = {}  # by image: input, direction

    def build(self, heard: Callable[[XrayView, XrayEvent], Awaitable[None]], *boxes: ui.element) -> None:
        """Build both views, each in its box. `heard` is called with the person's actions in them."""
        made = []
        for name, box in zip(NAMES, boxes, strict=True):
            with box:
                made.append(XrayView(name, label=image_label(name, self._planning.decisions.kind), texts=texts.XRAY))
            made[-1].on_event(heard)
        self.pair = (made[0], made[1])

    def watch(self, watched: "Watched | None") -> None:
        """Show a live image in the view it belongs to; None: show the images of the plan again."""
        self.watched = watched
        if watched is not None and watched.view is not None:
            self._live_in = watched.view.name

    def image_in(self, view: XrayView, step: ProcedureStep) -> str | None:
        """Return the name of the image that a view shows; None for a live image, and for one replaced meanwhile."""
        image = self._images(step)[self.pair.index(view)]
        seen, shown = self._planning.seen(image), view.shown.picture
        return None if seen is None or shown is None or shown.url != self._pictures.of(seen).url else image

    def show(self, step: ProcedureStep, goal: Goal | None, preview: Preview | None) -> None:
        """Update both views; the second shows the third image also while a mark is to be placed in it."""
        self._placing_oblique = goal is not None and goal.image == OBLIQUE
        for view, image in zip(self.pair, self._images(step), strict=True):
            if self.watched is not None and view.name == self._live_in:
                view.show(self._shown_live(view, self.watched), fresh_s=fresh_s(self.watched))
            else:
                view.show(self._shown(image, step, goal, preview))

    def _images(self, step: ProcedureStep) -> tuple[str, str]:
        """Return the names of the images in the two views."""
        # Of a simulated patient the images of the plan are shown until the check images are taken.
        taken = any(map(self._planning.seen, CHECK_NAMES)) or self._planning.patient is None
        if step is ProcedureStep.VERIFY and taken:
            return CHECK_NAMES
        if step is ProcedureStep.DRILL and self._session.shots.shown:
            return SHOT_NAMES
        third = (self.show_oblique or self._placing_oblique) and self._planning.seen(OBLIQUE) is not None
        return (NAMES[0], OBLIQUE) if third else NAMES

    def _shown_live(self, view: XrayView, watched: "Watched") -> XrayContent:
        picture = self._pictures.live(watched.image)
        decisions = self._planning.decisions
        head = head_in(watched.view, self._planning.frame, decisions.side)
        return XrayContent(
            "Live, view unknown" if watched.view is None else "PA, live" if view.name == NAMES[0] else "Lateral, live",
            picture,
            replace(_display(decisions.display.get(view.name, Display()), head, picture.window), inverted=False),
            {"wire": [] if watched.corridor is None else shapes.band(watched.corridor)},
            notice=texts.STALE.format(age=watched.age_s) if watched.stale else None,
            head=head,
            identity=self._identity,
        )

    @property
    def _identity(self) -> str:
        """The patient's side and the case, which an image shows wherever it is seen."""
        case, side = self._planning.case.number, self._planning.decisions.side
        return texts.IDENTITY.format(side=texts.SIDE_UNKNOWN if side is None else side.title(), case=case)

    def _shown(self, image: str, step: ProcedureStep, goal: Goal | None, preview: Preview | None) -> XrayContent:
        """Return the content of an image's view."""
        planning, seen = self._planning, self._planning.seen(image)
        if seen is None:
            return XrayContent(image_label(image, planning.decisions.kind))
        layers, undrawn = self._layers(image, seen)
        if step is ProcedureStep.DRILL and image in ALL_NAMES:  # a shot shows the wire itself
            layers = {**layers, "drilled": self._filled(image)}
        if step is ProcedureStep.CALIBRATE:
            layers = {**layers, "bone": shapes.bone(self._session.bone.shown, image)}
        if preview is not None:
            layers = {**layers, **preview.layers.get(image, {})}
        hidden = {name for name, on in (("beads", self.show_beads), ("rejected", self.show_rejected)) if not on}
        if step is ProcedureStep.CALIBRATE and self._session.bone.found is not None:
            hidden.add("beads")  # they hide its edges, which a person judges now
        picture, display = self._pictures.of(seen), planning.decisions.display.get(image, Display())
        window = picture.window if display.window is None else Window(*display.window)
        head = self._head(image, seen.view)
        # The revision includes case and image, so that an edit lost by a killed server is not applied to another one.
        return XrayContent(
            image_label(image, planning.decisions.kind),
            picture,
            _display(display, head, window),
            {name: drawn for name, drawn in layers.items() if name not in hidden},
            _points(image, step, self._specs(step), planning.decisions if preview is None else preview.decisions),
            goal.spec.name if goal is not None and goal.image == image else None,
            (texts.in_progress(seen.doing) if seen.doing else seen.refused) or undrawn or None,
            f"{planning.case.number} {image} {seen.acquired.number} {planning.history.revision}",
            self._matching() if image == NAMES[1] and step is ProcedureStep.PLAN else None,
            head,
            self._identity,
        )

    def _specs(self, step: ProcedureStep) -> tuple[MarkSpec, ...]:
        """Return the marks shown on a step: those of the bone's CT or mesh only where they are placed."""
        own = self._session.bone.asked if step is ProcedureStep.CALIBRATE else ()
        return (*self._planning.specs, *own)

    def _head(self, image: str, view: BeadView | None) -> int | None:
        """Return `head_in` of an image, computed once: each move of a dragged point refreshes both views."""
        of = view, self._planning.decisions.side
        if self._heads.get(image, (None,))[0] != of:
            self._heads[image] = of, head_in(view, self._planning.frame, of[1])
        return self._heads[image][1]

    def _matching(self) -> dict[str, Any] | None:
        """Return what the lateral view needs to draw curves by itself; None until both views are calibrated."""
        views, seen = self._planning.views(), [self._planning.seen(name) for name in NAMES]
        if views is None:
            return None
        drawn = [
            self._pictures.sight(view, self._pictures.of(image))
            for view, image in zip(views, seen, strict=False)
            if image is not None
        ]
        return {
            "from": NAMES[0],
            "title": texts.CURVE_TITLE,
            "names": {"entry": "entry", "end": "end"},
            "sights": drawn,
        }

    def _filled(self, image: str) -> list[shapes.Shape]:
        """Return the wire that the robot has drilled, over an image of the plan that it has."""
        depth_mm, sent, images = self._drilled_mm(), self._planning.sent, self._planning.decisions.images
        if depth_mm is None or sent is None or sent.planned.decisions.images.get(image) != images.get(image):
            return []
        return shapes.drilled(sent.planned, image, round(depth_mm / _FILLED_MM) * _FILLED_MM)

    def _drilled_mm(self) -> float | None:
        """Return how deep the current wire is: as recorded once it is drilled, because the robot retracts without it;
        else as the robot says that has its plan; None where none says so."""
        drilling, drilled = self._session.drilling, self._planning.drilled
        now = drilling.now if drilling.held is not None and drilling.held is self._planning.sent else None
        if drilled is not None and len(drilled.record.depth_mm):
            return float(drilled.record.depth_mm.max())
        return None if now is None or now.lost else now.depth_mm

    def _layers(self, image: str, seen: SeenImage) -> tuple[shapes.Layers, str]:
        """Return the layers over an image and the reason for a missing one; cached for the same plan."""
        verifying, known = self._session.verifying, self._planning.planned
        of = (
            seen,
            known,
            self._session.shots.found,
            *(ends.get(image) for ends in verifying.found.values()),
            *verifying.shots.values(),
        )
        if image in self._drawn and self._drawn[image][0] == of:
            return self._drawn[image][1:]
        makers: dict[str, Callable[[], list[shapes.Shape]]] = {
            "beads": lambda: shapes.beads(seen),
            "rejected": lambda: shapes.rejected(seen),
        }
        if image in CHECK_NAMES:
            makers["found"] = lambda: shapes.found(self._session, image)
        elif image in SHOT_NAMES:
            makers["found"] = lambda: shapes.shot(self._session, image)
        elif known is not None:
            makers["curves"] = lambda: shapes.curves(known.curves) if image == NAMES[1] else []
            makers["expected"] = lambda: shapes.expected(known) if image == OBLIQUE else []
            makers["wire"] = lambda: shapes.wire(known, image)
            makers["nail"] = lambda: shapes.nail_found(known, image)
            makers["aids"] = lambda: shapes.aids(known, image)
        layers: shapes.Layers = {}
        refused = [failure_of(lambda name=name: layers.update({name: makers[name]()})) for name in makers]
        self._drawn[image] = of, layers, next(filter(None, refused), "")
        return self._drawn[image][1:]


def _display(chosen: Display, head: int | None, window: Window) -> XrayDisplay:
    turned = head_up(head) if chosen.rotation is None else chosen.rotation
    return XrayDisplay(turned, chosen.mirrored, chosen.inverted, window)


def _is_editable(image: str, step: ProcedureStep, group: str) -> bool:
    """Return True if points in an image can be moved on a step: those of the plan, and those of the
    bone's CT or mesh, only on their own."""
    if image in SHOT_NAMES:
        return True
    if group == "bone":
        return step is ProcedureStep.CALIBRATE
    return step is (ProcedureStep.VERIFY if image in CHECK_NAMES else ProcedureStep.PLAN)


def _points(image: str, step: ProcedureStep, specs: tuple[MarkSpec, ...], decisions: Decisions) -> list[dict[str, Any]]:
    """Return the points of an image, placed or not, as JSON types."""
    points = []
    for spec in (*specs, *GUIDE):
        if not spec.shown_in(image):
            continue
        mark, on_curve = decisions.mark(spec.name), image == NAMES[1] and spec.group == "wire"
        points.append(
            {
                "id": spec.name,
                "label": spec.label,
                "uv": mark.at(image),
                "style": spec.of if spec.group == "wire" else _STYLES.get(spec.group, spec.group),
                "movable": _is_editable(image, step, spec.group),
                "snapped": on_curve and not mark.free,
                "slides": on_curve and decisions.snapping and mark.at(NAMES[0]) is not None,
            }
        )
    return points
