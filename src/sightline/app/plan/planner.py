"""Computes curves, a nail's holes, plan, anatomy and metrics, and the place of the robot's own wire, from decisions and
calibrated views, without state."""

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np

from sightline.app.plan.decisions import HEAD, NECK, SHAFT, Decisions, FittedAxis, Mark, Pixel
from sightline.app.plan.found_bone import BoneInViews
from sightline.app.plan.marks import END, ENTRY, NAIL_EDGES, MarkSpec, aid_marks, hole_mark, images_of
from sightline.calibration import BeadView, CalibratedView
from sightline.case.contents import PlanRequest
from sightline.case.picks import NailSizes, PickedWire, Picks
from sightline.case.views import ALL_NAMES, NAMES
from sightline.common.checks import failed
from sightline.errors import RobotRefusedError, SightlineError, UnusableInputError
from sightline.from_images.interlocking import FoundNail, NailDrawn, find_hole, find_nail, hole_edges
from sightline.imaging import Radiograph
from sightline.planning import (
    Hole,
    HoleSeen,
    MatchingCurve,
    Plan,
    Proposal,
    WirePicks,
    WirePlans,
    matching_curve,
    propose,
    propose_others,
    reconstruct,
    snap,
)
from sightline.planning.bone.aids import Aids, Circle, Line
from sightline.planning.bone.anatomy import Anatomy, locate
from sightline.planning.bone.metrics import Metric, metrics
from sightline.planning.nail.files import known_nails
from sightline.planning.points.picks import DEFAULT_PICK_SD_PX
from sightline.planning.points.results import SpacePoints, Verdict
from sightline.planning.procedures import Procedure
from sightline.planning.procedures import kind as kind_of
from sightline.planning.procedures.document import AidAsked, ProcedureDocument
from sightline.planning.procedures.procedure import each_wire, keeping

PICK_SD_PX = DEFAULT_PICK_SD_PX
_PICK_PX2 = PICK_SD_PX**2 * np.eye(2)


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
    clicks = {key: _pair_pixels([mark])[:, 0] for key, mark in marks.items() if mark.complete()}
    return NailDrawn(decisions.nail, _pair_pixels(edges).reshape(2, 2, 2, 2), clicks)


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


def _same(first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray]) -> bool:
    return first.keys() == second.keys() and all(np.array_equal(first[key], second[key]) for key in first)


def _pair_pixels(marks: Sequence[Mark]) -> np.ndarray:
    """Return the pixels (2, N, 2) of marks in PA and lateral image."""
    return np.array([[mark.at(name) for mark in marks] for name in NAMES], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Planned:
    """The results of decisions. `curves`: image-matching curves in the lateral image, by point of the wire. `plan`: of
    the current wire; `wires`: the plans of all, where the procedure has several. `refused`: reasons for missing
    results, by their names. `holes`: what was found of a nail, once it was looked for. `bone`: registered in
    these images."""

    decisions: Decisions
    views: tuple[BeadView, ...]
    curves: Mapping[str, MatchingCurve] = field(default_factory=dict)
    plan: Plan | None = None
    refused: Mapping[str, str] = field(default_factory=dict)
    wires: WirePlans | None = None
    holes: HolesFound | None = None
    bone: BoneInViews | None = None

    @property
    def verdict(self) -> Verdict | None:
        """The verdict on the plans of all wires; None without any."""
        if self.wires is not None:
            return self.wires.verdict
        return None if self.plan is None else self.plan.verdict

    @property
    def plans(self) -> Mapping[str, Plan]:
        """The plans of all wires, by their kinds."""
        plans = () if self.plan is None else (self.plan,)
        return {plan.kind.key: plan for plan in (plans if self.wires is None else self.wires.plans.values())}

    @cached_property
    def kind(self) -> Procedure:
        """The procedure."""
        return kind_of(self.decisions.kind)

    @cached_property
    def anatomy(self) -> Anatomy:
        """The aids located in space."""
        if self.plan is not None and self.plan.anatomy is not None:
            return self.plan.anatomy
        return locate(self.views, _aids(self.decisions))

    def fitted_axis(self, key: str) -> FittedAxis | None:
        """Return the lines of shaft or neck as fitted to edges; None where their drawing is used."""
        return fitted_axis(self.decisions, key)

    @cached_property
    def metrics(self) -> tuple[Metric, ...]:
        """Metrics of the implant; none until the side is confirmed, because signs and names depend on it."""
        side = self.decisions.side
        return () if side is None else metrics(self.anatomy, side)

    def proposal(self) -> Proposal:
        """Return a wire proposed from the drawn aids by the procedure's rule. Raises SightlineError."""
        side, rule = self.decisions.side, self.kind.proposal
        if side is None and (rule is None or rule.side):
            raise _NoSideError
        assert rule is not None  # noqa: S101 - the page offers it only where there is one
        return propose(self.views, self.anatomy, side, rule=rule)

    def with_others_proposed(self, kept: Collection[str] = ()) -> Decisions:
        """Return the decisions with the other wires of the triangle proposed, but those of the kinds `kept`. Raises
        SightlineError."""
        document, decisions = self.kind.document, self.decisions
        first = Procedure.of(document, lowest_wire(document) or "")
        if first.key not in self.plans:
            raise UnusableInputError(f"place entry and end of the {first.wire.name} first")
        for key, proposal in propose_others(self.plans[first.key]).items():
            kind = Procedure.of(document, key).key
            if kind not in kept:
                decisions = decisions.with_ends(kind, proposed(decisions.ends(kind), proposal))
        return decisions


class _NoSideError(SightlineError):
    """The side of the patient is not confirmed."""

    def __init__(self) -> None:
        super().__init__("confirm the patient's side first: superior and anterior depend on it")


def lowest_wire(document: ProcedureDocument) -> str | None:
    """Return the key of the wire beside which others can be proposed; None where the file states no such wires."""
    return next(
        (relation.wires[0] for relation in document.relations if relation.relation == "inverted triangle"), None
    )


def proposed(ends: Mapping[str, Mark], proposal: Proposal) -> Mapping[str, Mark]:
    """Return the marks of a wire's entry and end where a proposal has them; in other images they stay."""
    marks = dict(ends)
    for name, uv in ((ENTRY, proposal.entry_uv_px), (END, proposal.end_uv_px)):
        for image, at in zip(NAMES, uv, strict=True):
            marks[name] = marks.get(name, Mark()).placed(image, _pixel(at), free=False)
    return marks


def planned(
    decisions: Decisions,
    views: Sequence[BeadView],
    holes: HolesFound | None = None,
    bone: BoneInViews | None = None,
) -> Planned:
    """Return the results of decisions on calibrated views: PA, lateral, and a third where there is one.

    `holes`: what the images show of the nail of these decisions; None where they have none, or it is not known yet.
    `bone`: registered in these images."""
    if decisions.of_nail:
        return _planned_through(decisions, views, holes, bone)
    apart = views if bone is None else bone.views  # which planning adjusts to each other
    curves, refused = _drawn_curves(decisions, views)
    current: Plan | None = None
    wires: WirePlans | None = None
    if not refused and wires_placed(decisions):
        asked = request_of(decisions, len(views), bone)
        try:
            if asked.others is None:
                current = asked.plan_on(apart, _curve)
            else:
                wires = asked.plan_wires_on(apart, _curve)
                current = wires.plans.get(kind_of(decisions.kind).wire.key)
        except SightlineError as error:
            refused["plan"] = str(error)
    return Planned(decisions, tuple(views), curves, current, refused, wires, bone=bone)


def _planned_through(
    decisions: Decisions, views: Sequence[BeadView], holes: HolesFound | None, bone: BoneInViews | None
) -> Planned:
    """Return the plans of the holes that were found, unless one of those clicked was refused."""
    refused = {} if holes is None else dict(holes.refused)
    wires: WirePlans | None = None
    if holes is not None and holes.holes and not refused:
        asked = request_of(decisions, len(views), bone)
        try:
            wires = asked.plan_holes_on(holes.views, holes.holes, _curve)
        except SightlineError as error:
            refused["plan"] = str(error)
    current = None if wires is None else wires.plans.get(kind_of(decisions.kind).wire.key)
    return Planned(decisions, tuple(views), {}, current, refused, wires, holes, bone)


def wires_placed(decisions: Decisions) -> list[str]:
    """Return the kinds of the procedure's wires whose entry and end are placed in both images; of a nail those whose
    holes are clicked in both."""
    each = [wire.key for wire in each_wire(kind_of(decisions.kind).document)]
    if decisions.of_nail:
        return [kind for kind in each if decisions.complete([hole_mark(kind_of(kind).wire.key)])]
    return [kind for kind in each if all(decisions.ends(kind).get(name, Mark()).complete() for name in (ENTRY, END))]


def _drawn_curves(
    decisions: Decisions, views: Sequence[CalibratedView]
) -> tuple[dict[str, MatchingCurve], dict[str, str]]:
    """Return the curves of the wire's points in the second view, by name, and the reasons for missing ones."""
    curves: dict[str, MatchingCurve] = {}
    refused: dict[str, str] = {}
    for name in (ENTRY, END):
        at = decisions.mark(name).at(NAMES[0])
        if at is not None:
            try:
                curves[name] = _curve(views[0], np.array(at), views[1])
            except SightlineError as error:
                refused[name] = str(error)
    return curves, refused


def _curve(
    from_view: CalibratedView, uv_px: np.ndarray, to_view: CalibratedView, uv_covariance_px2: np.ndarray = _PICK_PX2
) -> MatchingCurve:
    """Return `matching_curve`, cached: moving, planning and drawing a point need the same one."""
    return _remembered(from_view, to_view, uv_px.tobytes(), uv_covariance_px2.tobytes())


@lru_cache(maxsize=8)  # [calc] the curves of two points, before and after a move, for two pages
def _remembered(from_view: CalibratedView, to_view: CalibratedView, uv_px: bytes, covariance_px2: bytes):
    covariance = np.frombuffer(covariance_px2).reshape(2, 2)
    return matching_curve(from_view, np.frombuffer(uv_px), to_view, covariance)


def landmarks_of(decisions: Decisions, views: int) -> tuple[MarkSpec, ...]:
    """Return the landmarks that a plan on this number of views uses: those placed in two of their images or more."""
    listed = (spec for spec in decisions.specs if spec.group == "landmark")
    images = ALL_NAMES[:views]
    return tuple(spec for spec in listed if sum(decisions.mark(spec.name).at(name) is not None for name in images) > 1)


def request_of(decisions: Decisions, views: int, bone: BoneInViews | None = None) -> PlanRequest:
    """Return `plan_input` of the current wire, or of the first that is placed where the current one is not."""
    kinds = wires_placed(decisions)
    return plan_input(decisions, views, decisions.kind if decisions.kind in kinds else kinds[0], bone)


def plan_input(decisions: Decisions, views: int, kind: str = "", bone: BoneInViews | None = None) -> PlanRequest:
    """Return a plan's input besides its views, of this number: of the wire of this kind, default the current one. Its
    entry and end, or its hole, must be placed in PA and lateral; the procedure's other wires are in it where theirs
    are."""
    known = kind_of(kind or decisions.kind)
    entry, end, snapped = _picks(decisions, known.key, views)
    others = {
        kind_of(other).wire.key: WirePicks(*_picks(decisions, other, views))
        for other in wires_placed(decisions)
        if other != known.key
    }
    landmarks = landmarks_of(decisions, views)
    picked = np.reshape([_pixels(decisions.mark(spec.name), views) for spec in landmarks], (-1, views, 2))
    return PlanRequest(
        entry,
        end,
        PICK_SD_PX,
        snapped,
        landmarks_uv_px=picked.swapaxes(0, 1),
        landmark_names=tuple(spec.of for spec in landmarks),
        kind=known.key,
        procedure=keeping(known),
        side=decisions.side,
        aids=_aids(decisions),
        others=others if known.several else None,
        nail=nail_drawn(decisions),
        bone=None if bone is None else bone.bone,
    )


def picks_of(decisions: Decisions, images: tuple[str, ...]) -> Picks:
    """Return the picks in the images of a plan, from which `sightline plan --picks` makes it again."""
    wires, nail = {}, nail_drawn(decisions)
    if not decisions.of_nail:
        for kind in wires_placed(decisions):
            wire = PickedWire.of(WirePicks(*_picks(decisions, kind, len(images))))
            wires[kind_of(kind).wire.key] = wire.model_dump(mode="json", exclude_defaults=True)
    aids = {
        key: {view: uv.tolist() for view, uv in zip(NAMES, both, strict=True) if uv is not None}
        for key, both in _clicked(decisions).items()
    }
    fits = {HEAD: decisions.fitted_head, **{key: fitted_axis(decisions, key) for key in (SHAFT, NECK)}}
    landmarks = [
        {"name": spec.of, **{view: decisions.mark(spec.name).at(view) for view in images}}
        for spec in landmarks_of(decisions, len(images))
    ]
    picked: dict[str, Any] = {
        "wires": wires,
        "landmarks": landmarks,
        "aids": aids,
        "fit": [key for key, fitted in fits.items() if fitted is not None and key in aids],
        "pick_sd_px": PICK_SD_PX,
        "mirrored": [view for view in images if decisions.mirrored.get(decisions.images.get(view, 0))],
    }
    if nail is not None:
        edges = dict(zip(NAMES, nail.strokes_px.reshape(2, 4, 2).tolist(), strict=True))
        holes = {key: dict(zip(NAMES, uv.tolist(), strict=True)) for key, uv in nail.clicks_px.items()}
        sizes = {name: getattr(nail.nail, name) for name in NailSizes.model_fields}
        known = next((key for key, file in known_nails().items() if file.nail == nail.nail), sizes)
        picked["nail"] = {"nail": known, "edges": edges, "holes": holes}
    return Picks.model_validate_json(json.dumps(picked))


def _picks(decisions: Decisions, kind: str, views: int) -> tuple[np.ndarray, np.ndarray, bool | list[bool]]:
    """Return the pixels (V, 2) of a wire's entry and end, and whether each is snapped; the click in a nail's hole
    stands for both."""
    if decisions.of_nail:
        clicked = _pixels(decisions.mark(hole_mark(kind_of(kind).wire.key)), views)
        return clicked, clicked, False
    entry, end = (decisions.ends(kind)[name] for name in (ENTRY, END))
    return _pixels(entry, views), _pixels(end, views), [not entry.free, not end.free]


def _pixels(mark: Mark, views: int) -> np.ndarray:
    """Return the pixels (V, 2) of a mark, a row for each view, NaN where it is not placed."""
    return np.array([mark.at(name) or (np.nan, np.nan) for name in ALL_NAMES[:views]], dtype=np.float64)


def moved(
    decisions: Decisions, views: Sequence[CalibratedView], name: str, image: str, uv_px: Pixel, *, anew: bool
) -> Decisions:
    """Return the decisions with a mark placed (`anew`) or moved.

    With `decisions.snapping`, a point of the wire is snapped to its curve in the lateral image, and slides along the
    curve when its PA pixel moves. A snapped point stays snapped when it is moved, because it gives no evidence of a gap
    between the lines of sight. Raises what `snap` raises.
    """
    mark = decisions.mark(name)
    if name not in (ENTRY, END) or len(views) < 2:
        return decisions.with_mark(name, mark.placed(image, uv_px))
    if image == NAMES[1]:
        first, kept = mark.at(NAMES[0]), not anew and mark.at(image) is not None and not mark.free
        if first is None or not (decisions.snapping or kept):
            return decisions.with_mark(name, mark.placed(image, uv_px, free=True))
        curve = _curve(views[0], np.array(first), views[1])
        return decisions.with_mark(name, mark.placed(image, _pixel(snap(curve, np.array(uv_px)).uv_px), free=False))
    after = mark.placed(image, uv_px)
    if image == NAMES[0] and not mark.free and mark.complete():
        after = after.placed(NAMES[1], _slid(views, mark, uv_px))
    return decisions.with_mark(name, after)


def _slid(views: Sequence[CalibratedView], mark: Mark, uv_px: Pixel) -> Pixel | None:
    """Return a snapped point's pixel on the curve of another PA pixel: at the same depth, limited to the visible
    curve."""
    before, after = (_curve(views[0], np.array(uv), views[1]) for uv in (mark.at(NAMES[0]), uv_px))
    at = np.array(mark.at(NAMES[1]))
    nearest = int(np.argmin(np.linalg.norm(before.uv_px - at, axis=1)))
    ahead = float((at - before.uv_px[nearest]) @ before.tangent_px[nearest])
    first, last = max(nearest - 1, 0), min(nearest + 1, len(before.depth_mm) - 1)
    step_px = float(np.linalg.norm(before.uv_px[last] - before.uv_px[first]))
    pitch = (before.depth_mm[last] - before.depth_mm[first]) / max(step_px, 1e-9)
    depth = before.depth_mm[nearest] + ahead * pitch
    return _pixel(np.array([np.interp(depth, after.depth_mm, after.uv_px[:, k]) for k in range(2)]))


def _pixel(uv_px: np.ndarray) -> Pixel:
    return float(uv_px[0]), float(uv_px[1])


def has_head(decisions: Decisions) -> bool:
    """Return True if the procedure asks for the rim of a head."""
    return not decisions.of_nail and any(aid.key == HEAD for aid in kind_of(decisions.kind).aids)


def has_borders(decisions: Decisions) -> bool:
    """Return True if the procedure asks for axes, which may be drawn by both borders of the bone."""
    return not decisions.of_nail and any(aid.type == "line" for aid in kind_of(decisions.kind).aids)


def has_borders_of(decisions: Decisions, key: str) -> bool:
    """Return True if the procedure asks for this axis, shaft or neck, and it is drawn by both borders."""
    return has_borders(decisions) and decisions.borders and any(aid.key == key for aid in kind_of(decisions.kind).aids)


def drawn_axis(decisions: Decisions, key: str) -> tuple[Line, Line] | None:
    """Return shaft or neck between its drawn borders; None until all clicks are placed."""
    return getattr(_drawn(decisions), key) if decisions.borders else None


def fitted_axis(decisions: Decisions, key: str) -> FittedAxis | None:
    """Return shaft or neck as fitted to edges; None where it is not, or axes are not drawn by borders."""
    return {SHAFT: decisions.fitted_shaft, NECK: decisions.fitted_neck}.get(key) if decisions.borders else None


def drawn_head(decisions: Decisions) -> tuple[Circle, Circle] | None:
    """Return the circles through the clicks on the head's rim; None until all are placed."""
    return _drawn(decisions).head


def fitted_head(decisions: Decisions) -> tuple[Circle, Circle] | None:
    """Return the head's circles, as fitted to edges where they were fitted; None until they are drawn."""
    return _aids(decisions).head


def _aids(decisions: Decisions) -> Aids:
    """Return the aids that are drawn, head, shaft and neck as fitted to edges where they were fitted."""
    drawn = _drawn(decisions)
    if drawn.head is not None and decisions.fitted_head is not None:
        drawn = replace(drawn, head=decisions.fitted_head.head)
    for key in (SHAFT, NECK):
        fitted = fitted_axis(decisions, key)
        if fitted is not None and getattr(drawn, key) is not None:
            drawn = replace(drawn, **{key: fitted.axis})
    return drawn


def _drawn(decisions: Decisions) -> Aids:
    """Return the aids whose clicks are all placed, in all images that the procedure wants them in."""
    types = {aid.key: aid.type for aid in kind_of(decisions.kind).aids}
    return Aids.clicked(types, _clicked(decisions), PICK_SD_PX)


def _clicked(decisions: Decisions) -> dict[str, list[np.ndarray | None]]:
    """Return the clicks of the aids that are complete, by their keys: in PA and lateral image, where they are drawn."""
    known = kind_of(decisions.kind)
    clicked: dict[str, list[np.ndarray | None]] = {}
    for aid in known.aids:
        images = images_of(known, aid)
        uv = [aid_pixels(decisions, aid, image) if image in images else None for image in NAMES]
        if images and sum(clicks is not None for clicks in uv) == len(images):
            clicked[aid.key] = uv
    return clicked


def aid_pixels(decisions: Decisions, aid: AidAsked, image: str) -> np.ndarray | None:
    """Return an aid's clicks in one image, (clicks, 2); None until all are placed."""
    at = [decisions.mark(name).at(image) for name in aid_marks(aid, decisions.borders)]
    return None if any(uv is None for uv in at) else np.array(at, dtype=np.float64)


# The robot's own wire in the planning images of a block, which register the robot more accurately than its encoders.
ROBOT_WIRE = (
    MarkSpec(
        "robot-guide",
        "Robot's wire 1",
        "Any point in the middle of the robot's own wire, 25 mm or more behind its tip.",
        "robot",
        "robot-wire",
    ),
    MarkSpec("robot-tip", "Robot's wire 2", "The tip of the robot's own wire, before the bone.", "robot", "robot-wire"),
)


def robot_wire_seen(decisions: Decisions, views: Sequence[CalibratedView]) -> SpacePoints | None:
    """Return a point of the robot's own wire and its tip as PA and lateral image show them; None where neither is
    clicked.

    Nothing on the wire tells the same point in both images, so the first click counts across the wire only: along it,
    its error is the distance to the tip (1 s.d.). Raises RobotRefusedError where a click is missing or both images do
    not show one tip, and what `reconstruct` raises.
    """
    marks = [decisions.mark(spec.name) for spec in ROBOT_WIRE]
    if not any(mark.places for mark in marks):
        return None
    if not all(mark.complete() for mark in marks):
        raise RobotRefusedError(
            "click tip and middle of the robot's wire in both images, or remove their marks: the robot is registered "
            "by all four clicks, or by its encoders"
        )
    uv = np.array([[mark.at(name) for mark in marks] for name in NAMES])
    spread = np.tile(PICK_SD_PX**2 * np.eye(2), (*uv.shape[:2], 1, 1))
    for view, (point, tip) in enumerate(uv):
        spread[view, 0] += np.outer(tip - point, tip - point)
    seen = reconstruct(views[: len(NAMES)], uv, spread)
    if wrong := failed(seen.checks):  # point 1 is on the wire, point 2 its tip
        raise RobotRefusedError(f"click the robot's wire again in both images: {wrong[0].sentence}")
    return seen
