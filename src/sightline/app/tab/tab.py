"""One open page: its step, its message and the person's actions. Several pages may show the same procedure."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from nicegui import ui

from sightline.app import texts
from sightline.app.drawing.pictures import Pictures, head_up
from sightline.app.drawing.xray import XrayEvent, XrayView
from sightline.app.plan.decisions import Decisions, Display, Pixel
from sightline.app.plan.marks import MarkSpec
from sightline.app.plan.planner import Planned
from sightline.app.session.jobs import failure_of, report
from sightline.app.session.planning import Planning
from sightline.app.session.session import Session, export_files, report_files
from sightline.app.tab.placing import Goal, Placing, ProcedureStep
from sightline.app.tab.views import Dragging, Views
from sightline.errors import SightlineError
from sightline.planning.points.reconstruct import Measured, measured_in_plane, measured_in_space

if TYPE_CHECKING:
    from sightline.case.watch.analyser import Watched

Clicks = Sequence[Pixel]


def measured_in_both(planning: Planning, clicks: Mapping[str, Clicks]) -> tuple[str, str] | None:
    """Return what `measured` returns of as many clicks in both images, by the images' names: of the places in space.
    None where the images do not show the same places."""
    views = [seen.view for seen in map(planning.seen, clicks) if seen is not None and seen.view is not None]
    if len(views) < 2 or len({len(each) for each in clicks.values()}) > 1:
        return None
    try:
        uv = np.array(list(clicks.values()))
        return _label(measured_in_space(views, uv), angle=uv.shape[1] == 3), texts.RULER_SPACE
    except SightlineError:
        return None


def measured(planning: Planning, image: str | None, clicks: Clicks) -> tuple[str, str]:
    """Return length or angle with its error, empty where it cannot be measured, and what it means: it holds in the
    plane through the middle of the planned wire, parallel to the plate."""
    known, seen = planning.planned, None if image is None else planning.seen(image)
    if known is None or known.plan is None or seen is None or seen.view is None:
        return "", texts.RULER_NEEDS_WIRE
    path = known.plan.trajectory
    try:
        value = measured_in_plane(seen.view, np.array(clicks), (path.entry_mm + path.end_mm) / 2.0)
    except SightlineError as error:
        return "", str(error)
    plane = (
        (
            "Measured in the plane of the wire, parallel to the image: "
            f"{1000.0 * value.per_mm:.1f} % more or less for each 10 mm before or behind it. "
            "Error: 95 %."
        )
        if len(clicks) == 2
        else "Measured between lines parallel to the image. Error: 95 %."
    )
    return _label(value, angle=len(clicks) == 3), plane


def _label(measured_value: Measured, *, angle: bool) -> str:
    """Return length or angle with its error."""
    if angle:
        off = "" if measured_value.error_95 is None else f" ± {np.rad2deg(measured_value.error_95):.1f}°"
        return f"{np.rad2deg(measured_value.value):.1f}°{off}"
    off = "" if measured_value.error_95 is None else f" ± {measured_value.error_95:.1f}"
    return f"{measured_value.value:.1f}{off} mm"


class Tab:
    """State of one page. `message`: a sentence for the person, empty for none;
    `is_good`: it is good news; `notices`: how many there were, so that a repeated one is told from the one before.
    `on_refresh`: called to update the parts beside the views; `on_drag`: those of them that follow a drag.
    """

    def __init__(
        self, session: Session, pictures: Pictures, *, fast_robot: bool = False, live_source: str | None = None
    ) -> None:
        """`fast_robot`: run a simulated robot's time as fast as possible. `live_source`: source of the live image."""
        self.session, self.planning = session, session.planning
        self.fast_robot, self.live_source = fast_robot, live_source
        self.views = Views(session, pictures)
        self.dragging = Dragging(self.planning)
        self._placing = Placing(session)
        self.step, self.message, self.is_good, self.notices = ProcedureStep.IMAGES, "", False, 0
        self.on_refresh: list[Callable[[], None]] = []
        self.on_drag: list[Callable[[], None]] = []
        self._waiting = False
        self._ruled: dict[XrayView, tuple[str | None, object, Clicks]] = {}  # by view: image, its picture, clicks
        self._ruled_on: Planned | None = None  # the plan whose wire the ruler measures at

    # Display.

    @property
    def goal(self) -> Goal | None:
        """The next mark to place; None if there is none."""
        return self._placing.goal(self.step)

    @property
    def progress(self) -> tuple[int, int]:
        """The number of the next mark to place, and of all that are asked for."""
        return self._placing.progress(self.step)

    @property
    def optional(self) -> MarkSpec | None:
        """The mark that is asked for, if the plan can do without it."""
        return self._placing.optional(self.step)

    @property
    def skipped(self) -> tuple[MarkSpec, ...]:
        """The marks that the person passed over."""
        return self._placing.skipped

    def skip(self) -> None:
        """Pass over the mark that is asked for; a click in the checklist asks for it again."""
        self._placing.skip(self.step)
        self.refresh()

    @property
    def known(self) -> Planned | None:
        """The plan shown: the preview of a dragged point, else the current plan."""
        preview = self.dragging.preview
        return self.planning.planned if preview is None else preview.known

    def build_views(self, *boxes: ui.element) -> None:
        """Build the two X-ray views, each in its box."""
        self.views.build(self._heard, *boxes)

    def go_to(self, step: ProcedureStep) -> None:
        """Go to another step; nothing is lost."""
        self.step, self.message = step, ""
        self.views.watched = None
        # On later steps they would hide the bone.
        self.views.show_beads = step in (ProcedureStep.IMAGES, ProcedureStep.CALIBRATE)
        self._placing.begin_step()
        self.refresh()

    def show_live(self, watched: "Watched | None") -> None:
        """Show a live image in the view it belongs to; None: the images of the plan again."""
        ended = watched is None and self.views.watched is not None
        self.views.watch(watched)
        if watched is not None:
            self.show_views()
        elif ended:
            self.refresh()

    def say(self, text: str, *, good: bool = False) -> None:
        """Show a message; an empty one removes it. `good`: it is good news."""
        self.notify(text, good=good)
        self.refresh()

    def notify(self, text: str, *, good: bool = False) -> None:
        """Set the message without showing it."""
        self.message, self.is_good = text, good
        self.notices += bool(text)

    def later(self) -> None:
        """Schedule one refresh, however often this is called until then."""
        if not self._waiting:
            self._waiting = True
            asyncio.get_running_loop().call_soon(self._refresh_now)

    def _refresh_now(self) -> None:
        self._waiting = False
        self.refresh()

    def refresh(self) -> None:
        """Update the views and the parts beside them; an error in one part does not stop the others."""
        self._refresh(self.on_refresh)

    def _refresh(self, parts: list[Callable[[], None]]) -> None:
        self.show_views()
        if self._ruled and self._ruled_on is not self.planning.planned:
            self._say_measured()
        refused = [why for why in map(failure_of, list(parts)) if why]
        if refused and not self.message:
            self.notify(refused[0])
            self.later()

    def show_views(self) -> None:
        """Update the two views."""
        self.views.show(self.step, self.goal, self.dragging.preview)

    # Actions of the person.

    def place(self, listed: Sequence[MarkSpec], images: tuple[str, ...] = ()) -> None:
        """Ask for those of these marks that are not placed in `images`, by default those of the plan; where all are,
        for the first anew."""
        self._placing.choose(listed, images or self.planning.names)
        self.refresh()

    async def act(self, what: Callable[[], Awaitable[Any] | None]) -> None:
        """Run an action; an error becomes a message on the page."""
        try:
            pending = what()
            self.message = ""
            if pending is not None:
                await pending
        except Exception as error:
            self.notify(report(error))
        self.refresh()

    async def save_report(self) -> None:
        """Keep the plan shown in the case, and write its report, as a page, into the case's folder and to the browser.

        Raises SightlineError.
        """
        planning = self.planning
        planning.keep_plan()
        files = await planning.jobs.during(
            "writing the report",
            lambda: planning.worker.do(report_files, planning.case.folder, self.session.readiness.confirmations),
        )
        for name, data in files.items():
            ui.download.content(data, name)
            self.notify(f"The report is saved in the case, as report/{name}, and was sent to this browser.", good=True)

    async def export(self) -> None:
        """Keep the plan shown in the case, and write what may be handed on of it into the case's folder and to the
        browser. Raises SightlineError.
        """
        planning = self.planning
        planning.keep_plan()
        files, written_in = await planning.jobs.during(
            "writing the export",
            lambda: planning.worker.do(export_files, planning.case.folder, self.session.readiness.confirmations),
        )
        views = texts.DISPLAY_AND.join(texts.image_label(view, planning.decisions.kind) for view in written_in)
        found = f"; it was found in: {views}" if views else ""
        for name, data in files.items():
            ui.download.content(data, name)
            self.notify(texts.EXPORTED.format(file=f"export/{name}", found=found), good=True)

    async def choose(self, decisions: Decisions) -> None:
        """Plan another procedure, another wire of it, or through the holes of another nail, and ask for its points."""
        self._placing.begin_step()
        await self.act(lambda: self.planning.edit(decisions))

    def doing(self, what: Callable[[], Awaitable[Any] | None]) -> Callable[[], Awaitable[None]]:
        """Return a button's handler that runs an action."""

        return lambda: self.act(what)

    async def _heard(self, view: XrayView, event: XrayEvent) -> None:
        if event.type == "cancel":
            self._placing.cancel()
            self.refresh()
        elif event.type == "refused":
            self._let_go()
        elif event.type == "error":
            self.say(event.message or texts.XRAY["load_failed"])
        elif event.type == "measure":
            self._measure(view, event.points)
        elif event.type in ("place", "drop", "nudge", "drag", "remove", "display"):
            image = self.views.image_in(view, self.step)
            if image is None:
                view.drop(event)
                self._let_go()
            else:
                await self._done_on(image, event, view.shown.head)

    def _measure(self, view: XrayView, clicks: Clicks) -> None:
        """Keep the ruler's clicks, and show what it measures."""
        self._ruled[view] = (self.views.image_in(view, self.step), view.shown.picture, clicks)
        self._say_measured()

    def _say_measured(self) -> None:
        """Show what the ruler measures: in space where it has as many clicks in the other view, on the image shown."""
        self._ruled_on = self.planning.planned
        now = {view: (self.views.image_in(view, self.step), view.shown.picture) for view in self.views.pair}
        ruled = {view: each for view, each in self._ruled.items() if each[2] and each[:2] == now[view]}
        in_space = measured_in_both(self.planning, {image: uv for image, _, uv in ruled.values() if image})
        for view, (image, _, uv) in ruled.items():
            view.say_measured(*(in_space or measured(self.planning, image, uv)))

    def _let_go(self) -> None:
        self.dragging.end()
        self.refresh()

    async def _done_on(self, image: str, event: XrayEvent, head: int | None) -> None:
        planning, name, uv = self.planning, event.id, event.uv
        if name is not None and uv is not None and event.type == "drag":
            await self._drag(name, image, uv)
        elif name is not None and uv is not None:
            self.dragging.end()
            anew = event.type == "place"
            await self.act(lambda: planning.edit(planning.moved(name, image, uv, anew=anew)))
        elif name is not None:
            without = planning.decisions.mark(name).placed(image, None)
            await self.act(lambda: planning.edit(planning.decisions.with_mark(name, without)))
        elif event.display is not None:
            shown = event.display
            turned = None if shown.rotation == head_up(head) else shown.rotation
            display = Display(turned, shown.mirrored, shown.inverted, (shown.window.centre, shown.window.width))
            await self.act(lambda: planning.decide(display={**planning.decisions.display, image: display}))

    async def _drag(self, name: str, image: str, uv: tuple[float, float]) -> None:
        try:
            if await self.dragging.follow(name, image, uv):
                self._refresh(self.on_drag)
        except Exception as error:
            self.say(report(error))
