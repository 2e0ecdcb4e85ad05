"""Preview while a point is dragged: the curves first, because they guide the hand, then the plan."""

import asyncio
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass

from sightline.app.drawing import shapes
from sightline.app.plan.decisions import Decisions, Pixel
from sightline.app.plan.marks import names_of
from sightline.app.plan.planner import Planned, drawn_curves, planned
from sightline.app.session.planning import Planning
from sightline.calibration import BeadView
from sightline.case.views import ALL_NAMES, NAMES
from sightline.errors import SightlineError
from sightline.planning import MatchingCurve

_Views = tuple[BeadView, ...]


@dataclass(frozen=True, eq=False)
class Preview:
    """Preview of a dragged point, as far as computed. `revision`: of the decisions it started from. `layers`: changed
    layers, by image. `known`: the plan, once computed."""

    revision: int
    decisions: Decisions
    layers: Mapping[str, Mapping[str, list[shapes.Shape]]]
    known: Planned | None = None


class Dragging:
    """The drag on one page. `show` redraws the two views with the current preview."""

    def __init__(self, planning: Planning, show: Callable[[], None]) -> None:
        self._planning, self._show = planning, show
        self._preview: Preview | None = None
        self._dragged: tuple[object, int] | None = None  # the latest unfinished drag, and its revision

    @property
    def preview(self) -> Preview | None:
        """The preview of the current drag; None if it is over."""
        one = self._preview
        return one if one is not None and one.revision == self._planning.history.revision else None

    def end(self) -> None:
        """End the drag and discard its preview."""
        self._preview = self._dragged = None

    async def follow(self, name: str, image: str, uv: Pixel) -> bool:
        """Compute the preview of a dragged point. Returns True if the page must be refreshed, False if the point has
        moved on meanwhile or there is no preview."""
        planning = self._planning
        views, drag = planning.views(), (object(), planning.history.revision)
        if views is None:
            return False
        self._dragged = drag
        try:
            decisions, curves = await asyncio.to_thread(_moved_curves, planning, views, name, image, uv)
            if not self._goes_on(drag):
                return False
            before, drawn = self.preview, {NAMES[1]: {"curves": shapes.curves(curves)}}
            if before is not None:  # keep the old wire until its plan is computed
                drawn = {of: {**before.layers.get(of, {}), **drawn.get(of, {})} for of in ALL_NAMES}
            self._preview = Preview(drag[1], decisions, drawn, None if before is None else before.known)
            self._show()
            known, layers = await asyncio.to_thread(_planned_layers, decisions, views, name)
            if not self._goes_on(drag):
                return False
            layers[NAMES[1]]["curves"] = drawn[NAMES[1]]["curves"]
            self._preview = Preview(drag[1], decisions, layers, known)
        except SightlineError:  # the drop reports it; there is no preview here
            if not self._goes_on(drag):
                return False
            self._preview = None
        except Exception:
            self._preview = None
            raise
        return True

    def _goes_on(self, drag: tuple[object, int]) -> bool:
        """Return False once the point was dropped or dragged on, or any decision was made meanwhile, even if undone."""
        return drag is self._dragged and drag[1] == self._planning.history.revision


def _moved_curves(
    planning: Planning, views: _Views, name: str, image: str, uv: Pixel
) -> tuple[Decisions, dict[str, MatchingCurve]]:
    """Return the decisions and curves after moving a mark; runs on another thread."""
    decisions = planning.moved(name, image, uv)
    return decisions, drawn_curves(decisions, views)[0]


def _planned_layers(decisions: Decisions, views: _Views, moved: str) -> tuple[Planned, dict[str, shapes.Layers]]:
    """Return the plan with its metrics, and the changed layers by image; runs on another thread."""
    known = planned(decisions, views)
    layers = {image: {"wire": shapes.wire(known, image)} for image in ALL_NAMES}
    if moved in names_of(decisions.kind, "aid"):
        for image, drawn in layers.items():
            drawn["aids"] = shapes.aids(known, image)
    with suppress(SightlineError):  # compute them here; the panel reports errors
        _ = known.metrics
    return known, layers
