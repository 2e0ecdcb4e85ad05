"""The holes of a nail, found in the images from the strokes and clicks of decisions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from sightline.app.plan.decisions import Decisions, Mark
from sightline.app.plan.marks import NAIL_EDGES, hole_mark
from sightline.calibration import BeadView
from sightline.case.views import NAMES
from sightline.errors import SightlineError
from sightline.from_images.interlocking import FoundNail, NailDrawn, find_hole, find_nail, hole_edges
from sightline.imaging import Radiograph
from sightline.planning import Hole, HoleSeen
from sightline.planning.procedures import kind as kind_of

_Found = TypeVar("_Found")
NAIL = "nail"  # key of `HolesFound.refused` for the strokes


def nail_drawn(decisions: Decisions) -> NailDrawn | None:
    """Return the nail as drawn: with the clicks of the holes that are clicked in both images; None until both of its
    edges are drawn in both, and for decisions without a nail."""
    edges = [decisions.mark(spec.name) for spec in NAIL_EDGES]
    if decisions.nail is None or not decisions.of_nail or not all(mark.complete() for mark in edges):
        return None
    wires = [wire.key for wire in kind_of(decisions.kind).document.wires]
    marks = {key: decisions.mark(hole_mark(key)) for key in wires}
    clicks = {key: _pixels([mark])[:, 0] for key, mark in marks.items() if mark.complete()}
    return NailDrawn(decisions.nail, _pixels(edges).reshape(2, 2, 2, 2), clicks)


def with_nail(decisions: Decisions, drawn: NailDrawn) -> Decisions:
    """Return the decisions with a nail as drawn, as `nail_drawn` returns it. Raises CaseError."""
    decisions = replace(decisions, nail=drawn.nail)
    strokes = drawn.strokes_px.reshape(len(NAMES), len(NAIL_EDGES), 2).swapaxes(0, 1)
    clicked = {hole_mark(key): uv for key, uv in drawn.clicks_px.items()}
    for name, uv in (*zip((spec.name for spec in NAIL_EDGES), strokes, strict=True), *clicked.items()):
        decisions = decisions.with_mark(name, Mark(dict(zip(NAMES, map(tuple, uv.tolist()), strict=True))))
    return decisions


def of_wire(decisions: Decisions, kind: str) -> Mapping[str, object]:
    """Return the decisions from which a wire follows, by its kind: its entry and end, or nail, edges and its hole."""
    if not decisions.of_nail:
        return decisions.ends(kind)
    names = [*(spec.name for spec in NAIL_EDGES), hole_mark(kind_of(kind).wire.key)]
    return {NAIL: decisions.nail, **{name: decisions.mark(name) for name in names}}


@dataclass(frozen=True, eq=False)
class HolesFound:
    """What the images show of a nail as drawn. `views`: of the `images`, calibrated one by one. `nail`: None where its
    strokes are refused. `holes`, and their `edges` in each image: by the wires' keys. `refused`: reasons, by NAIL or
    the name of a hole's mark."""

    drawn: NailDrawn
    views: tuple[BeadView, ...]
    images: tuple[Radiograph, ...]
    nail: FoundNail | None = None
    holes: Mapping[str, Hole] = field(default_factory=dict)
    edges: Mapping[str, Sequence[HoleSeen]] = field(default_factory=dict)
    refused: Mapping[str, str] = field(default_factory=dict)

    def is_of(self, drawn: NailDrawn | None, views: Sequence[BeadView]) -> bool:
        """Return True if this is what the images of these views show of a nail as drawn."""
        return drawn is not None and self._same_nail(drawn, views) and _same(self.drawn.clicks_px, drawn.clicks_px)

    def _same_nail(self, drawn: NailDrawn, views: Sequence[BeadView]) -> bool:
        same = self.drawn.nail == drawn.nail and np.array_equal(self.drawn.strokes_px, drawn.strokes_px)
        return same and self.views == tuple(views)

    @staticmethod
    def find(
        drawn: NailDrawn, views: Sequence[BeadView], images: Sequence[Radiograph], before: "HolesFound | None" = None
    ) -> "HolesFound":
        """Return what the images show, as `interlocking.plan_holes` finds it; what was found `before` from the same
        strokes and clicks is kept."""
        refused: dict[str, str] = {}
        if before is not None and not before._same_nail(drawn, views):
            before = None
        nail = None if before is None else before.nail
        if nail is None:
            nail = _tried(refused, NAIL, lambda: find_nail(views[:2], images[:2], drawn.strokes_px, drawn.nail))
        if nail is None:
            return HolesFound(drawn, tuple(views), tuple(images), refused=refused)
        holes: dict[str, Hole] = {}
        edges: dict[str, Sequence[HoleSeen]] = {}
        for key, clicks in drawn.clicks_px.items():
            if before is not None and key in before.holes and np.array_equal(before.drawn.clicks_px[key], clicks):
                holes[key], edges[key] = before.holes[key], before.edges[key]
            elif (
                hole := _tried(refused, hole_mark(key), lambda at=clicks, nail=nail: find_hole(nail, at))
            ) is not None:
                holes[key], edges[key] = hole, hole_edges(nail, hole)
        return HolesFound(drawn, tuple(views), tuple(images), nail, holes, edges, refused)


def _tried(refused: dict[str, str], name: str, find: Callable[[], _Found]) -> _Found | None:
    try:
        return find()
    except SightlineError as error:
        refused[name] = str(error)
        return None


def _same(one: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)


def _pixels(marks: Sequence[Mark]) -> np.ndarray:
    """Return the pixels (2, N, 2) of marks in PA and lateral image."""
    return np.array([[mark.at(name) for mark in marks] for name in NAMES], dtype=np.float64)
