"""Preview of the plan while a point is dragged; the browser draws the curves that guide the hand by itself."""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass

from sightline.app.drawing import shapes
from sightline.app.plan.decisions import Decisions, Pixel
from sightline.app.plan.planner import Planned, planned
from sightline.app.session.planning import Planning
from sightline.calibration import BeadView
from sightline.case.views import ALL_NAMES
from sightline.common.threads import one_blas_thread
from sightline.errors import SightlineError

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
        one = self._preview
        return one if one is not None and one.revision == self._planning.history.revision else None

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
    known = planned(decisions, views, planning.nail.found)
    layers = {image: {"wire": shapes.wire(known, image)} for image in ALL_NAMES}
    if any(spec.name == name and spec.group == "aid" for spec in decisions.specs):
        for shown, drawn in layers.items():
            drawn["aids"] = shapes.aids(known, shown)
    return decisions, known, layers
