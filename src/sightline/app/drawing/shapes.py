"""Overlays of an image: beads, curves, wire and corridor, aids; plain shapes in image pixels."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from sightline.app import texts
from sightline.app.plan.decisions import HEAD
from sightline.app.plan.found_bone import FoundBone
from sightline.app.plan.marks import by_borders
from sightline.app.plan.planner import Planned, aid_pixels, landmarks_of
from sightline.app.session.seen import SeenImage
from sightline.app.session.sent import SentPlan
from sightline.app.session.session import Session
from sightline.calibration import BeadView
from sightline.case.views import ALL_NAMES, CHECK_NAMES, NAMES, SHOT_NAMES
from sightline.errors import SightlineError
from sightline.planning import Line, MatchingCurve, Plan, reconstruct
from sightline.planning.bone.head import outline
from sightline.planning.check.result import CheckShot
from sightline.planning.points.curve import Corridor, corridor
from sightline.planning.procedures.document import AidAsked
from sightline.planning.verdict.implant import template

Shape = dict[str, Any]
Layers = dict[str, list[Shape]]
RESIDUAL_MM = 0.3  # end of the colour scale: six times the default tolerance of a plate [ours]
_ARROW_TIMES = 10  # [ours] enlarges residuals: a millimetre is two pixels of a screen, and they are a tenth of that
_NAIL_MM = 40.0  # [ours] of a nail's axis to either side of the strokes' middle: beyond both holes, 25 to 30 mm apart
_AXIS_PX = 4000.0  # extends an aid's axis across the whole image


def beads(seen: SeenImage) -> list[Shape]:
    """Return all beads found, coloured by their residuals once the view is calibrated."""
    if seen.beads is None:
        return []
    if seen.view is None:
        return [
            {"shape": "circle", "points": [uv.tolist()], "radius": float(radius), "style": "found"}
            for uv, radius in zip(seen.beads.uv_px, seen.beads.radius_px, strict=True)
        ]
    left = seen.view.residuals
    drawn = []
    for name, uv, residual, used in zip(left.ids, left.uv_px, left.residual_mm, left.used, strict=True):
        size = float(np.linalg.norm(residual))
        shape: Shape = {"shape": "circle", "points": [uv.tolist()], "radius": _radius(seen, uv), "style": "bead-good"}
        if used:
            shape |= {"value": min(size / RESIDUAL_MM, 1.0), "title": f"{name}: residual {size:.3f} mm"}
        else:
            shape |= {"style": "bead-bad", "title": f"{name}: left out, it contradicts the others by {size:.2f} mm"}
        drawn.append(shape)
    return drawn


def rejected(seen: SeenImage) -> list[Shape]:
    """Return the candidates that are not beads, each with its reason."""
    if seen.beads is None:
        return []
    return [
        {"shape": "cross", "points": [list(candidate.uv_px)], "style": "rejected", "title": candidate.reason}
        for candidate in seen.beads.rejected
    ]


def curves(drawn: Mapping[str, MatchingCurve]) -> list[Shape]:
    """Return image-matching curves with their bands and depth ticks, for the lateral image."""
    return [shape for name, curve in drawn.items() for shape in _curve(name, curve)]


def _curve(name: str, curve: MatchingCurve) -> list[Shape]:
    line = curve.uv_px.tolist()
    ticks = curve.uv_px[curve.is_tick].tolist()
    depths = [f"{depth:.0f}" if depth % 50 == 0 else "" for depth in curve.depth_mm[curve.is_tick]]
    drawn: list[Shape] = []
    if curve.half_width_px is not None:
        half = curve.half_width_px.tolist()
        band = {"shape": "band", "points": line, "halfWidth": half, "style": "curve-band"}
        drawn.append({**band, "from": float(curve.depth_mm[0])})
    drawn.append(
        {
            "shape": "line",
            "points": line,
            "style": "curve",
            "title": texts.CURVE_TITLE.format(name=name),
        }
    )
    if ticks:
        drawn.append({"shape": "ticks", "points": ticks, "style": "tick", "label": depths, "legend": texts.TICKS})
    for shape in drawn:
        shape["of"] = name
    return drawn


def wire(planned: Planned, image: str) -> list[Shape]:
    """Return the wires for one view: the current one last, at its true width with its 95 % corridor, over the implant
    that fits it."""
    view, drawn = _view(planned, image), []
    if view is None:
        return []
    for plan in sorted(planned.plans.values(), key=lambda each: each is planned.plan):
        kind = plan.kind
        with suppress(SightlineError):  # it is outside the view; the plan's checks say so
            path = corridor(view, plan.trajectory, wire_mm=kind.wire_mm, beyond_mm=kind.limits.beyond_mm)
            beside: Shape = {
                "shape": "line",
                "points": path.uv_px.tolist(),
                "style": "plan",
                "title": kind.wire.name,
            }
            if plan is planned.plan:
                with suppress(SightlineError):  # the wire is drawn where a view shows no more of the implant
                    drawn += _implant(path, plan)
                drawn += band(path, "wire" if plan.hole is None else "plan")  # the hole in the image must stay visible
            else:
                drawn.append(beside)
    return drawn


def _implant(wire: Corridor, plan: Plan) -> list[Shape]:
    """Return the outline of the implant that fits a plan's wire, and its thread; nothing where none fits."""
    document = plan.kind.document
    catalogue, outline_px = document.catalogue, template(wire, plan.trajectory.length_mm, document)
    if catalogue is None or outline_px is None:
        return []
    title = (
        f"{texts.titled(catalogue.implants)}: {outline_px.length_mm:g} mm from the entry point, "
        f"{outline_px.diameter_mm:g} mm thick"
    )
    parts = [("implant", 0)] if outline_px.thread is None else [("implant", 0), ("thread", outline_px.thread)]
    return [
        {
            "shape": "band",
            "points": outline_px.uv_px[first:].tolist(),
            "halfWidth": outline_px.half_px[first:].tolist(),
            "style": style,
            "title": title,
        }
        for style, first in parts
    ]


def nail_found(planned: Planned, image: str) -> list[Shape]:
    """Return a nail as the images show it, for one view: the edges found along its strokes, its axis, and the rims of
    its holes."""
    holes = planned.holes
    if holes is None or holes.nail is None or image not in NAMES:
        return []
    k, nail = NAMES.index(image), holes.nail
    axis = nail.point_mm + _NAIL_MM * np.linspace(-1.0, 1.0, 31)[:, None] * nail.along
    drawn = [_edge(edge.uv_px, "the nail's edge, as found in the image") for edge in nail.outlines[k]]
    drawn.append({**_edge(holes.views[k].project_seen(axis)[0], "axis of the nail"), "style": "aid"})
    rims = [rim.uv_px for edges in holes.edges.values() for rim in (edges[k].entry, edges[k].exit)]
    drawn += [_edge(_around(uv), "rim of the hole, as found in the image") for uv in rims if len(uv) > 1]
    return drawn


def _edge(uv_px: np.ndarray, title: str) -> Shape:
    return {"shape": "line", "points": uv_px.tolist(), "style": "edge", "title": title}


def _around(uv_px: np.ndarray) -> np.ndarray:
    """Return points (N, 2) in their order around a rim, begun after the largest gap between them."""
    gaps = np.linalg.norm(np.roll(uv_px, -1, axis=0) - uv_px, axis=1)
    return np.roll(uv_px, -1 - int(np.argmax(gaps)), axis=0)


def bone(found: FoundBone | None, image: str) -> list[Shape]:
    """Return the edges of the bone's shadow in an image, as its CT or mesh was registered."""
    lines = () if found is None else found.edges.get(image, ())
    return [{"shape": "line", "points": line, "style": "edge", "title": "edge of the CT or mesh"} for line in lines]


def drilled(planned: Planned, image: str, depth_mm: float) -> list[Shape]:
    """Return the part of the planned wire that is drilled, to this depth beyond the entry point, for one view. A drill
    that passes its end point is shown as far as it is planned."""
    view = _view(planned, image)
    if planned.plan is None or view is None or depth_mm <= 0.0:
        return []
    path = planned.plan.trajectory
    most_mm = path.length_mm + planned.plan.kind.limits.beyond_mm
    along = path.entry_mm + np.linspace(0.0, min(depth_mm, most_mm), 12)[:, None] * path.direction
    uv, _ = view.project_seen(along)
    return (
        [{"shape": "line", "points": uv.tolist(), "style": "found", "title": "the wire, drilled so far"}]
        if len(uv) > 1
        else []
    )


def band(path: Corridor, style: str = "wire") -> list[Shape]:
    """Return a wire, in a style, and its corridor in an image."""
    line = path.uv_px.tolist()
    drawn: list[Shape] = []
    if path.half_95_px is not None:
        half = (path.wire_half_px + path.half_95_px).tolist()
        drawn.append({"shape": "band", "points": line, "halfWidth": half, "style": "corridor"})
    drawn.append({"shape": "band", "points": line, "halfWidth": path.wire_half_px.tolist(), "style": style})
    return drawn


def aids(planned: Planned, image: str) -> list[Shape]:
    """Return the aids' axes with the borders that they lie between, and the outline of the head, for one view."""
    drawn: list[Shape] = []
    for aid in planned.kind.aids:
        uv = None if aid.type in ("point", "sphere") else _lines(planned, aid, image)
        title = f"{aid.key} axis" if aid.type == "line" else aid.name
        for ends in () if uv is None else uv:
            drawn += _line(ends, 0.0 if aid.type != "line" or len(uv) > 1 else _AXIS_PX, title)
        if uv is not None and by_borders(aid, planned.decisions.borders):
            drawn += _line(Line.between(uv).uv_px, _AXIS_PX, title)
    head, view = planned.anatomy.head, _view(planned, image)
    name = next((aid.name for aid in planned.kind.aids if aid.key == HEAD), "")
    if head is not None and view is not None:
        seen = outline(view, head)
        if len(seen) > 2:
            drawn.append({"shape": "polygon", "points": seen.tolist(), "style": "aid", "title": name})
    return drawn


def _lines(planned: Planned, aid: AidAsked, image: str) -> np.ndarray | None:
    """Return the lines (N, 2, 2) of an aid in one image, each from end to end: borders as fitted where they were; None
    until all clicks are placed."""
    uv = aid_pixels(planned.decisions, aid, image)
    fitted = planned.fitted_axis(aid.key) if image in NAMES else None
    if uv is None or fitted is None:
        return None if uv is None else uv.reshape(-1, 2, 2)
    return fitted.axis[NAMES.index(image)].borders_px


def _line(ends: np.ndarray, beyond_px: float, title: str) -> list[Shape]:
    """Return a line from end to end, and so far beyond both; nothing where they coincide."""
    length = float(np.linalg.norm(ends[1] - ends[0]))
    if length <= 0.0:
        return []
    beyond = beyond_px * (ends[1] - ends[0]) / length
    points = [(ends[0] - beyond).tolist(), (ends[1] + beyond).tolist()]
    return [{"shape": "line", "points": points, "style": "aid", "title": title}]


def expected(planned: Planned) -> list[Shape]:
    """Return where PA and lateral image together expect the landmarks in the third image, and the ends of the wire.

    The lines of sight of both cross there. After a movement the bone shows the landmark elsewhere.
    """
    decisions, pair = planned.decisions, planned.views[: len(NAMES)]
    wire = [spec for spec in decisions.specs if spec.group == "wire" and decisions.complete((spec.name,))]
    listed = [*wire, *landmarks_of(decisions, len(NAMES))]
    if not listed or len(planned.views) == len(pair):
        return []
    uv = np.array([[decisions.mark(spec.name).at(name) for spec in listed] for name in NAMES], dtype=np.float64)
    seen, shown = planned.views[2].project_seen(reconstruct(pair, uv).xyz_mm)
    named = zip(seen, (spec for spec, there in zip(listed, shown, strict=True) if there), strict=True)
    return [
        {
            "shape": "cross",
            "points": [at.tolist()],
            "style": "rejected",
            "title": f"{spec.label}: expected here by the other two images",
        }
        for at, spec in named
    ]


def _view(planned: Planned, image: str) -> BeadView | None:
    """Return the view of an image; None for a third one that the plan was made without."""
    k = ALL_NAMES.index(image)
    return planned.views[k] if k < len(planned.views) else None


def found(session: Session, image: str) -> list[Shape]:
    """Return the wires measured in a check image, and their plans."""
    drawn: list[Shape] = []
    for kind, seen in session.verifying.found.items():
        if (wire := seen.get(image)) is not None:
            line = {"shape": "line", "points": wire.uv_px.tolist(), "style": "found"}
            shot, sent = session.verifying.shots.get(kind), session.planning.all_sent.get(kind)
            drawn += _planned_there(session, shot, sent, image, CHECK_NAMES)
            arrows = _deviations_there(session, kind, image)
            if kind != session.planning.decisions.kind:  # the numbers over the image are those of the current wire
                arrows = [{key: value for key, value in arrow.items() if key != "label"} for arrow in arrows]
            drawn += arrows
            drawn += [
                {**line, "title": "the wire as this image shows it", "legend": texts.MEASURED},
                {"shape": "cross", "points": [wire.tip_uv_px.tolist()], "style": "found", "title": "its tip"},
            ]
    return drawn


def shot(session: Session, image: str) -> list[Shape]:
    """Return the plan in an image taken while drilling, once the shot is measured."""
    measured = session.shots.found
    return _planned_there(
        session, None if measured is None else measured.wire, session.drilling.held, image, SHOT_NAMES
    )


def _planned_there(
    session: Session, shot: CheckShot | None, sent: SentPlan | None, image: str, names: tuple[str, ...]
) -> list[Shape]:
    """Return a wire's plan projected into one of two images taken later, with the bone's movement applied."""
    views = session.planning.views(names)
    if shot is None or sent is None or views is None:
        return []
    path = sent.plan.trajectory
    along = np.linspace(0.0, 1.0, 40)[:, None]
    points = shot.movement.apply((1.0 - along) * path.entry_mm + along * path.end_mm)
    uv, _ = views[names.index(image)].project_seen(points)
    return [{"shape": "line", "points": uv.tolist(), "style": "plan", "title": "the plan"}] if len(uv) > 1 else []


def _deviations_there(session: Session, kind: str, image: str) -> list[Shape]:
    """Return the deviations of a wire from its plan in a check image, with the bone's movement applied."""
    shot, sent = session.verifying.shots.get(kind), session.planning.all_sent.get(kind)
    views = session.planning.views(CHECK_NAMES)
    if shot is None or sent is None or views is None:
        return []
    path = sent.plan.trajectory
    tip_mm = path.end_mm + sent.plan.kind.limits.beyond_mm * path.direction  # a drill is planned past its far hole
    planned = shot.movement.apply(np.stack([path.entry_mm, tip_mm]))
    measured = shot.movement.apply(np.stack([shot.entry_mm, shot.tip_mm]))
    off = (
        (shot.entry_deviation_mm, shot.entry_error_95_mm),
        (shot.tip_deviation_mm, shot.tip_error_95_mm),
    )
    return deviations(views[CHECK_NAMES.index(image)], planned, measured, off)


def deviations(
    view: BeadView, planned_mm: np.ndarray, measured_mm: np.ndarray, off_mm: Sequence[tuple[float, float]]
) -> list[Shape]:
    """Return an arrow from the planned to the measured place (2, 3) of entry and tip, drawn longer than it is, with the
    deviation in space and its 95 % error; none for a place outside the view."""
    drawn: list[Shape] = []
    for name, planned, measured, (mm, error) in zip(("entry", "tip"), planned_mm, measured_mm, off_mm, strict=True):
        uv, seen = view.project_seen(np.stack([planned, measured]))
        if seen.all():
            ends = [uv[0].tolist(), (uv[0] + _ARROW_TIMES * (uv[1] - uv[0])).tolist()]
            label = f"{name} {mm:.2f} ± {error:.2f} mm off"
            title = f"{label} its plan; the arrow is drawn {_ARROW_TIMES} times as long"
            drawn.append({"shape": "arrow", "points": ends, "style": "deviation", "label": label, "title": title})
    return drawn


def _radius(seen: SeenImage, uv: np.ndarray) -> float:
    assert seen.beads is not None  # noqa: S101
    nearest = int(np.argmin(np.linalg.norm(seen.beads.uv_px - uv, axis=1)))
    return float(seen.beads.radius_px[nearest])
