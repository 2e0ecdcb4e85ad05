"""Checks of a frame's design, before any image of it is acquired: rules for plates and for solids."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist

from sightline.common.checks import Check, failed
from sightline.errors import FrameError
from sightline.frame.model import MIN_COMMON, Frame, common_ids, fits_mirrored, misfits_mm
from sightline.frame.patterns import Triples, in_steps, nearest_likeness
from sightline.frame.plate import SOURCE_TO_HIP_MM, FrameView, Plate, RigidBody
from sightline.frame.solid_shape import FIELDS_MM, clear_beads, in_words, offset_mm, symmetry_of

MAX_CHANGE_MM = 1.0  # [ours] rms; a larger change means another frame, as in "plate-flat"
WIRE_END_MM = 95 / np.sqrt(8)  # half a 95 mm wire at 45° (physics.md, Frame), along each axis of the view

_NOMINAL = f"a C-arm with the hip {SOURCE_TO_HIP_MM:g} mm from its source"
SYMMETRY_MM = 1.0  # [ours] five times the error of a printed ball: nearer to a symmetry, labels may be exchanged
_RARE = 0.02  # [ours] share of the directions in which an image may be refused

Values = Iterator[tuple[str, float | None]]  # (place, value; None where it cannot be measured)


@dataclass(frozen=True)
class Rule:
    """The rule of a check: `measure` yields a value for every place of a frame; `limit` applies to the worst."""

    name: str
    measure: Callable[[Frame], Values]
    at_least: bool
    limit: float
    unit: str
    meaning: str
    advice: str


def _judged(rules: tuple[Rule, ...], frame: Frame) -> tuple[Check, ...]:
    """Return a check of each rule that applies to some place of the frame."""
    measured = ((rule, list(rule.measure(frame))) for rule in rules)
    return tuple(_judge(rule, values) for rule, values in measured if values)


def _judge(rule: Rule, values: list[tuple[str, float | None]]) -> Check:
    """Return the check of the worst place; a place that cannot be measured is the worst."""
    sign = 1 if rule.at_least else -1
    where, value = min(values, key=lambda entry: -np.inf if entry[1] is None else sign * entry[1])
    passed = value is not None and sign * value >= sign * rule.limit
    sentence = f"{where}: {rule.meaning}" if passed else f"{where}: {rule.advice}"
    return Check(rule.name, passed, None if value is None else float(value), rule.limit, rule.unit, sentence)


def check_frame(frame: Frame) -> tuple[Check, ...]:
    """Return the checks that a frame can be labelled and calibrated with; the names are keys of docs/refusals.md.

    A rule of plates does not apply to a solid, nor a solid's to plates; a plate on the detector has those of plates
    that need no focal point. Later stages rely on earlier ones (that plates have planes, that a beam runs through
    them), so the stages after a failed one are left out.
    """
    checks: tuple[Check, ...] = ()
    for stage in ((*_BEADS, *_SOLID_BEADS), _PLATES, (*_VIEWS, *_SOLID_VIEWS)):
        checks += _judged(stage, frame)
        if failed(checks):
            break
    return checks


def before_check(frame: Frame, before: Frame) -> Check:
    """Return the check that the beads lie as in the earlier file, up to a rigid motion.

    Raises FrameError for fewer than 4 common ids.
    """
    now, then = frame.xyz_mm_by_id, before.xyz_mm_by_id
    if (common := len(common_ids(now, then))) < MIN_COMMON:
        raise FrameError(
            f"the frames {frame.key.rstrip('/')} and {before.key.rstrip('/')} have {common} ids in common (at least "
            f"{MIN_COMMON} are needed to compare them); give two files of one frame"
        )
    upright, mirrored = misfits_mm(now, then)
    passed = upright <= MAX_CHANGE_MM
    sentence = f"Aligned with the earlier file, the beads differ by {upright:.2f} mm rms"
    if fits_mirrored(upright, mirrored):
        sentence += (
            f", mirrored by {mirrored:.2f} mm: this file is the mirror image of the earlier one; write the coordinates "
            "in a right-handed system"
        )
    elif not passed:
        sentence += ": this is another frame, or its beads are numbered differently; give an earlier file of this frame"
    return Check("frame-before", passed, upright, MAX_CHANGE_MM, "mm", f"{sentence}.")


def _plates(frame: Frame) -> Iterator[tuple[str, FrameView, Plate]]:
    for name, role, plate in frame.named_plates:
        yield f"{name}, {'XRII' if role == 'xrii' else 'source'} plate", frame.views[name], plate


def _flat(frame: Frame) -> Iterator[tuple[str, Plate]]:
    yield from ((where, plate) for where, _, plate in _plates(frame))
    if frame.detector is not None:
        yield "plate on the detector", frame.detector


def _bodies(frame: Frame) -> Iterator[tuple[str, RigidBody]]:
    yield from _flat(frame)
    if frame.solid is not None:
        yield frame.name, frame.solid


def _views(frame: Frame) -> Values:
    if frame.solid is None:
        yield frame.name, len(frame.views)


def _repeated_ids(frame: Frame) -> Values:
    ids = [f.id for f in frame.fiducials]
    yield frame.name, len(ids) - len(set(ids))


def _beads(frame: Frame) -> Values:
    for where, plate in _flat(frame):
        yield where, len(plate.ids)


def _breadth(frame: Frame) -> Values:
    """Yield the rms distance of each plate's beads from their best-fitting line."""
    for where, plate in _flat(frame):
        centred = plate.xyz_mm - plate.xyz_mm.mean(axis=0)
        spread = np.linalg.svd(centred, compute_uv=False)
        yield where, float(spread[1] / np.sqrt(len(centred)))


def _height(frame: Frame) -> Values:
    for where, plate in _flat(frame):
        yield where, float(np.abs(plate.plane.height_mm(plate.xyz_mm)).max())


def _clearance(frame: Frame) -> Values:
    """Yield the smallest distance between the surfaces of two fiducials of each plate or solid."""
    for where, body in _bodies(frame):
        radius = body.diameter_mm / 2
        first, second = np.triu_indices(len(radius), 1)
        yield where, float((pdist(body.xyz_mm) - radius[first] - radius[second]).min())


def _datums(frame: Frame) -> Values:
    """Yield the number of datums of each plate; 0 where they are collinear."""
    for where, plate in _flat(frame):
        points = _datum_steps(plate)
        broad = len(points) < 3 or len(Triples.of(points).broad().area) > 0
        yield where, len(points) if broad else 0


def _datum_size(frame: Frame) -> Values:
    """Yield the ratio of the smallest datum ball to the largest ordinary ball; washers are known by their shape."""
    for where, plate in _flat(frame):
        datums = [f.diameter_mm for f in plate.fiducials if f.datum and f.shape == "ball"]
        ordinary = [f.diameter_mm for f in plate.fiducials if not f.datum]
        if datums and ordinary:
            yield where, min(datums) / max(ordinary)


def _symmetry(frame: Frame) -> Values:
    """Yield the share of each plate's datum triples that resemble others of the plate, or themselves rotated."""
    for where, plate in _flat(frame):
        yield where, _share(nearest_likeness(_datum_steps(plate)))


def _twins(frame: Frame) -> Values:
    """Yield the share of each plate's datum triples that resemble one of another plate, mirrored or not."""
    plates = [(where, _datum_steps(plate)) for where, _, plate in _plates(frame)]
    for index, (where, points) in enumerate(plates):
        for other, theirs in plates[:index]:
            shares = _share(nearest_likeness(points, [theirs])), _share(nearest_likeness(theirs, [points]))
            yield f"{where} and {other}", max(shares)


def _share(likeness: np.ndarray) -> float:
    return float((likeness < 1).mean()) if len(likeness) else 0.0


def _spacing(frame: Frame) -> Values:
    for name, view in frame.views.items():
        yield name, float(np.abs(view.xrii.plane.height_mm(view.source.xyz_mm)).min())


def _tilt(frame: Frame) -> Values:
    for where, view, plate in _plates(frame):
        yield where, float(np.degrees(np.arccos(min(1.0, abs(plate.plane.normal @ view.axis)))))


def _field(frame: Frame) -> Values:
    """Yield the share of each plate's beads that lie in the nominal C-arm's field."""
    for where, view, plate in _plates(frame):
        yield where, float(view.in_field(plate.xyz_mm).mean())


def reach_mm(view: FrameView, plate: Plate) -> float | None:
    """Return the margin, mm at the hip, between the ends of a 95 mm wire at 45° and the plate's convex hull.

    Negative where the wire reaches beyond it. None where a bead lies behind the nominal source, and for a plate seen
    edge-on.
    """
    if (view.depth_mm(plate.xyz_mm) <= 0).any():
        return None
    ends = WIRE_END_MM * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
    try:
        hull = ConvexHull(view.at_distance_mm(plate.xyz_mm, SOURCE_TO_HIP_MM)).equations
    except QhullError:
        return None
    return float(-(ends @ hull[:, :2].T + hull[:, 2]).max())


def _reach(frame: Frame) -> Values:
    for where, view, plate in _plates(frame):
        yield where, reach_mm(view, plate)


def _datum_steps(plate: Plate) -> np.ndarray:
    return in_steps(plate.plane.to_plane(plate.xyz_mm))[plate.is_datum]


def _solid_beads(frame: Frame) -> Values:
    if frame.solid is not None:
        yield frame.name, len(frame.solid.ids)


def _solid_extent(frame: Frame) -> Values:
    """Yield the rms distance of the balls from their best-fitting plane; that from a line is never smaller."""
    if frame.solid is not None:
        centred = frame.solid.xyz_mm - frame.solid.xyz_mm.mean(axis=0)
        yield frame.name, float(np.linalg.svd(centred, compute_uv=False)[2] / np.sqrt(len(centred)))


def _clear_mean(frame: Frame) -> Values:
    if frame.solid is not None:
        yield frame.name, float(clear_beads(frame.solid).mean())


def _clear_worst(frame: Frame) -> Values:
    if frame.solid is not None:
        yield frame.name, float(np.quantile(clear_beads(frame.solid), _RARE, method="lower"))


def _symmetries(frame: Frame) -> Values:
    """Yield the number of symmetries, with one of them: a rotation where there is one."""
    if frame.solid is not None:
        found = symmetry_of(frame.solid.xyz_mm, frame.solid.diameter_mm, SYMMETRY_MM)
        named = f", {in_words(max(found, key=np.linalg.det))}" if found else ""
        yield frame.name + named, len(found)


def _solid_offset(frame: Frame) -> Values:
    """Yield the `offset_mm` in the largest field."""
    if frame.solid is not None:
        name, field = max(FIELDS_MM.items(), key=lambda entry: entry[1])
        yield name, offset_mm(frame.solid, field)


_BEADS = (
    Rule(
        "frame-views", _views, at_least=True, limit=2, unit="views",
        meaning="lines of sight of two views intersect in a point",
        advice="one view gives lines of sight but no point; add the plates of a second view",
    ),
    Rule(
        "frame-ids", _repeated_ids, at_least=False, limit=0, unit="ids",
        meaning="every ball has a unique id",
        advice="two balls have the same id; give every ball of the frame a unique id",
    ),
    Rule(
        "plate-beads", _beads, at_least=True, limit=16, unit="beads",  # 16-25 lines of sight for a focal point [paper]
        meaning="the plate with the fewest beads has enough of them",
        advice="there are too few beads for a reliable focal point; add beads",
    ),
    Rule(
        "plate-collinear", _breadth, at_least=True, limit=10.0, unit="mm",  # [ours] half a pitch
        meaning="the beads spread in two directions",
        advice="the beads lie on or near a line; add beads away from it, or correct their coordinates",
    ),
)  # fmt: skip
_PLATES = (
    Rule(
        "bead-overlap", _clearance, at_least=True, limit=2.0, unit="mm",  # [ours] 8 px between the edges of two discs
        meaning="no two beads touch",
        advice="two beads touch or nearly touch, so their images cannot be centred; move or remove one",
    ),
    Rule(
        "plate-flat", _height, at_least=False, limit=1.0, unit="mm",  # [ours] more is a typing error, not a bent plate
        meaning="the beads lie in a plane",
        advice="a bead lies off the plane of the others; correct its coordinates, or measure the plate again",
    ),
    Rule(
        "plate-spacing", _spacing, at_least=True, limit=50.0, unit="mm",  # the smallest that was tried [calc]
        meaning="the plates are far enough apart",
        advice="the plates are too close to determine the focal point; move them further apart along the beam",
    ),
)  # fmt: skip
_VIEWS = (
    Rule(
        "datum-count", _datums, at_least=True, limit=3, unit="datums",
        meaning="three datums that are not collinear determine where a plate lies",
        advice="mark more balls as datums: a plate needs three that are not on a line (5 or 6 in case some are hidden)",
    ),
    Rule(
        "datum-size", _datum_size, at_least=True, limit=1.3, unit="",  # [ours] 5 mm over 3 mm is 1.67
        meaning="datum balls are larger than the others",
        advice="datum balls cannot be distinguished from the others in an image; use larger ones, or washers",
    ),
    Rule(
        "datum-symmetry", _symmetry, at_least=False, limit=0.5, unit="",  # [ours] a symmetric pattern has 1.0
        meaning="no rotation or mirror image of the datums can be confused with the pattern",
        advice="move a datum so that no three repeat the shape of others: they look the same when rotated or mirrored",
    ),
    Rule(
        "plate-twin", _twins, at_least=False, limit=0.5, unit="",  # [ours] a copy, mirrored or not, has 1.0
        meaning="the datums distinguish the plates",
        advice="the datums of one plate are a copy or a mirror image of the other's; move the datums of one",
    ),
    Rule(
        "plate-tilt", _tilt, at_least=False, limit=20.0, unit="°",  # what the labelling tolerates [ours]
        meaning="the plates are perpendicular to the beam",
        advice="the plate is tilted too far; make it perpendicular to the line from plate to plate",
    ),
    Rule(
        "plate-field", _field, at_least=True, limit=0.6, unit="",  # the labelling tolerates 40 % hidden
        meaning=_NOMINAL + " sees the beads",
        advice=_NOMINAL + " sees too few beads of this plate; make it smaller or move it nearer to the intensifier",
    ),
    Rule(
        "wire-reach", _reach, at_least=True, limit=10.0, unit="mm",  # set-up error (physics.md, Frame)
        meaning="projected to the hip, the beads surround a 95 mm wire at 45° by this margin",
        advice="add rows or pitch, or move the plate: at the hip, its beads do not surround a 95 mm wire at 45°",
    ),
)  # fmt: skip
_SOLID_BEADS = (
    Rule(
        "solid-beads", _solid_beads, at_least=True, limit=9, unit="beads",  # [ours] labels with an error of 1e-6
        meaning="there are enough beads to label an image by their geometry",
        advice="there are too few beads to label an image reliably; add beads",
    ),
    Rule(
        "solid-extent", _solid_extent, at_least=True, limit=5.0, unit="mm",  # [ours] half of what a block of 30 mm has
        meaning="the beads spread in three directions (rms from their best-fitting plane)",
        advice="the beads lie in or near a plane, which leaves the focal length unknown; add beads away from it",
    ),
)  # fmt: skip
_SOLID_VIEWS = (
    Rule(
        "solid-clear", _clear_mean, at_least=True, limit=9.0, unit="beads",  # as solid-beads
        meaning="from a random direction this many beads are clear of each other on average",
        advice="from most directions too few beads are clear of each other; move beads apart or add some",
    ),
    Rule(
        "solid-worst", _clear_worst, at_least=True, limit=6.0, unit="beads",  # 12 equations, 11 unknowns
        meaning="from all but 2 % of the directions at least this many beads are clear of each other",
        advice="from over 2 % of the directions too few beads are clear of each other; move beads out of rows",
    ),
    Rule(
        "solid-symmetry", _symmetries, at_least=False, limit=0, unit="symmetries",
        meaning="no rotation or mirror image can be confused with the solid",
        advice="the solid looks the same, so its balls cannot be labelled; move balls, or give some another size",
    ),
    Rule(
        "solid-field", _solid_offset, at_least=True, limit=0.0, unit="mm",
        meaning="at the hip the solid's middle may stand this far from the beam's axis with all beads in the image",
        advice="at the hip beads are cut off from the image; make the solid smaller",
    ),
)  # fmt: skip
