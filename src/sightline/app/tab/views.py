"""What the two X-ray views of a page show. It follows from the procedure, the step and the drag, at each refresh."""

from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from nicegui import ui

from sightline.app.drawing import shapes
from sightline.app.drawing.pictures import Pictures
from sightline.app.drawing.xray.view import Display as XrayDisplay
from sightline.app.drawing.xray.view import Shown, Window, XrayEvent, XrayView
from sightline.app.plan.decisions import Decisions, Display
from sightline.app.plan.marks import CHECK_NAMES, asked_of
from sightline.app.session.failures import why_not
from sightline.app.session.live import fresh_s
from sightline.app.session.procedure import Procedure
from sightline.app.session.seen import SeenImage
from sightline.app.tab.dragging import Preview
from sightline.app.tab.placing import Goal
from sightline.app.texts import IMAGE_LABELS, LIVE_LABELS, LIVE_UNKNOWN, STALE, STEPS, XRAY
from sightline.case.views import NAMES

if TYPE_CHECKING:
    from sightline.case.watch.eye import Watched

_STYLES = {"wire": "plan", "landmark": "landmark", "aid": "aid"}


class Views:
    """The views of one page. `pair`: both, once they are built. `watched`: the live image in one of them, if any."""

    pair: tuple[XrayView, XrayView]

    def __init__(self, procedure: Procedure, pictures: Pictures) -> None:
        self._procedure, self._planning, self._pictures = procedure, procedure.planning, pictures
        self.show_beads, self.show_rejected = True, False
        self.watched: Watched | None = None
        self._live_in = NAMES[0]  # the view that the live image is shown in
        self._drawn: dict[str, tuple[tuple[object, ...], shapes.Layers, str]] = {}  # by image: of what, layers, why not

    def build(self, heard: Callable[[XrayView, XrayEvent], Awaitable[None]], *boxes: ui.element) -> None:
        """Build both views, each in its box. `heard` is told of what a person does in one of them."""
        made = []
        for name, box in zip(NAMES, boxes, strict=True):
            with box:
                made.append(XrayView(name, label=IMAGE_LABELS[name], texts=XRAY))
            made[-1].on_event(heard)
        self.pair = (made[0], made[1])

    def watch(self, watched: "Watched | None") -> None:
        """Show a live image from now on, in the view it belongs to; None: the images of the plan again."""
        self.watched = watched
        if watched is not None and watched.view is not None:
            self._live_in = watched.view.name

    def image_in(self, view: XrayView, step: str) -> str | None:
        """Name of the image that a view shows; None of a live one, and of one in whose place another is by now."""
        image = self._images(step)[self.pair.index(view)]
        seen, shown = self._planning.seen(image), view.shown.picture
        return None if seen is None or shown is None or shown.url != self._pictures.of(seen).url else image

    def show(self, step: str, goal: Goal | None, preview: Preview | None) -> None:
        """Show in both views what is so now."""
        for view, image in zip(self.pair, self._images(step), strict=True):
            if self.watched is not None and view.name == self._live_in:
                view.show(self._shown_live(view, self.watched), fresh_s=fresh_s(self.watched))
            else:
                view.show(self._shown(image, step, goal, preview))

    def _images(self, step: str) -> tuple[str, str]:
        """Names of the images in the two views."""
        return CHECK_NAMES if step == STEPS[4] and self._planning.seen(CHECK_NAMES[0]) else NAMES

    def _shown_live(self, view: XrayView, watched: "Watched") -> Shown:
        picture = self._pictures.live(watched.image)
        turned = self._planning.decisions.display.get(view.name, Display())
        return Shown(
            LIVE_LABELS[view.name] if watched.view is not None else LIVE_UNKNOWN,
            picture,
            XrayDisplay(turned.rotation, turned.mirrored, False, picture.window),
            {"wire": [] if watched.corridor is None else shapes.band(watched.corridor)},
            notice=STALE.format(age=watched.age_s) if watched.stale else None,
        )

    def _shown(self, image: str, step: str, goal: Goal | None, preview: Preview | None) -> Shown:
        """What the view of an image shows."""
        planning, seen = self._planning, self._planning.seen(image)
        if seen is None:
            return Shown(IMAGE_LABELS[image])
        layers, undrawn = self._layers(image, seen)
        if preview is not None:
            layers = {**layers, **preview.layers.get(image, {})}
        hidden = {name for name, on in (("beads", self.show_beads), ("rejected", self.show_rejected)) if not on}
        picture, display = self._pictures.of(seen), planning.decisions.display.get(image, Display())
        window = picture.window if display.window is None else Window(*display.window)
        # Case and image are part of the revision: an edit that a killed server lost belongs to no other.
        return Shown(
            IMAGE_LABELS[image],
            picture,
            XrayDisplay(display.rotation, display.mirrored, display.inverted, window),
            {name: drawn for name, drawn in layers.items() if name not in hidden},
            _points(image, step, planning.decisions if preview is None else preview.decisions),
            goal.asked.name if goal is not None and goal.image == image else None,
            (f"{seen.doing.capitalize()} …" if seen.doing else seen.refused) or undrawn or None,
            f"{planning.case.number} {image} {seen.acquired.number} {planning.history.revision}",
        )

    def _layers(self, image: str, seen: SeenImage) -> tuple[shapes.Layers, str]:
        """What is drawn over an image by layer, and why one of them is not there. Computed once for the same plan."""
        verifying, known = self._procedure.verifying, self._planning.planned
        of = (seen, known, verifying.wires.get(image), verifying.shot)
        if image in self._drawn and self._drawn[image][0] == of:
            return self._drawn[image][1:]
        makers: dict[str, Callable[[], list[shapes.Shape]]] = {
            "beads": lambda: shapes.beads(seen),
            "rejected": lambda: shapes.rejected(seen),
        }
        if image in CHECK_NAMES:
            makers["found"] = lambda: shapes.found(self._procedure, image)
        elif known is not None:
            makers["curves"] = lambda: shapes.curves(known.curves) if image == NAMES[1] else []
            makers["wire"] = lambda: shapes.wire(known, image)
            makers["aids"] = lambda: shapes.aids(known, image)
        layers: shapes.Layers = {}
        refused = [why_not(lambda name=name: layers.update({name: makers[name]()})) for name in makers]
        self._drawn[image] = of, layers, next(filter(None, refused), "")
        return self._drawn[image][1:]


def _points(image: str, step: str, decisions: Decisions) -> list[dict[str, Any]]:
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
                "movable": step in (STEPS[2], STEPS[4]),
                "snapped": image == NAMES[1] and asked.group == "wire" and not mark.free,
            }
        )
    return out
