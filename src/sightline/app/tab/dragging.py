"""What follows from a point while it is dragged: the curves first, since they guide the hand, then the plan."""

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
from sightline.case.views import NAMES
from sightline.errors import SightlineError
from sightline.planning import MatchingCurve

_Pair = tuple[BeadView, BeadView]


@dataclass(frozen=True, eq=False)
class Preview:
    """What follows from a point on its way, as far as it is computed. `revision`: of the decisions that it left.
    `layers`: by image, those that are drawn otherwise. `known`: the plan, once it is there."""

    revision: int
    decisions: Decisions
    layers: Mapping[str, Mapping[str, list[shapes.Shape]]]
    known: Planned | None = None


class Dragging:
    """The point that is dragged on one page. `show` draws the two views, with the preview as it is then."""

    def __init__(self, planning: Planning, show: Callable[[], None]) -> None:
        self._planning, self._show = planning, show
        self._preview: Preview | None = None
        self._dragged: tuple[object, int] | None = None  # the last drag that is not over, and the revision it is of

    @property
    def preview(self) -> Preview | None:
        """What follows from the point that is being dragged; None of a drag that is over."""
        one = self._preview
        return one if one is not None and one.revision == self._planning.history.revision else None

    def end(self) -> None:
        """Nothing is dragged any more: what followed from it is not so."""
        self._preview = self._dragged = None

    async def follow(self, name: str, image: str, uv: Pixel) -> bool:
        """Compute what follows from a point on its way. Return True where the page shows something else now, False
        where the point went on meanwhile, or nothing can follow it."""
        planning = self._planning
        pair, drag = planning.views(), (object(), planning.history.revision)
        if pair is None:
            return False
        self._dragged = drag
        try:
            decisions, curves = await asyncio.to_thread(_moved_curves, planning, pair, name, image, uv)
            if not self._goes_on(drag):
                return False
            before, drawn = self.preview, {NAMES[1]: {"curves": shapes.curves(curves)}}
            if before is not None:  # the wire waits for its plan
                drawn = {of: {**before.layers.get(of, {}), **drawn.get(of, {})} for of in NAMES}
            self._preview = Preview(drag[1], decisions, drawn, None if before is None else before.known)
            self._show()
            known, layers = await asyncio.to_thread(_planned_layers, decisions, pair, name)
            if not self._goes_on(drag):
                return False
            layers[NAMES[1]]["curves"] = drawn[NAMES[1]]["curves"]
            self._preview = Preview(drag[1], decisions, layers, known)
        except SightlineError:  # told where it is dropped; nothing follows from here
            if not self._goes_on(drag):
                return False
            self._preview = None
        except Exception:
            self._preview = None
            raise
        return True

    def _goes_on(self, drag: tuple[object, int]) -> bool:
        """False once the point was dropped or dragged on, or anything was decided meanwhile, undone again or not."""
        return drag is self._dragged and drag[1] == self._planning.history.revision


def _moved_curves(
    planning: Planning, pair: _Pair, name: str, image: str, uv: Pixel
) -> tuple[Decisions, dict[str, MatchingCurve]]:
    """What moving a mark would come to, and the curves then; runs beside the page."""
    decisions = planning.moved(name, image, uv)
    return decisions, drawn_curves(decisions, pair)[0]


def _planned_layers(decisions: Decisions, pair: _Pair, moved: str) -> tuple[Planned, dict[str, shapes.Layers]]:
    """All that follows from decisions, its figures too, and by image what is drawn otherwise; runs beside the page."""
    known = planned(decisions, pair)
    layers = {image: {"wire": shapes.wire(known, image)} for image in NAMES}
    if moved in names_of(decisions.kind, "aid"):
        for image, drawn in layers.items():
            drawn["aids"] = shapes.aids(known, image)
    with suppress(SightlineError):  # whoever shows them says why they are not there
        _ = known.figures
    return known, layers
