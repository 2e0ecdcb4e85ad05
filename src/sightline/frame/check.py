"""Checks of a frame's design, before any image of it is acquired: rules for plates and for solids."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist

from sightline.common.checks import Check, failed
from sightline.errors import FrameError
from sightline.frame.model import MIN_COMMON, Frame, common_ids, fits_mirrored, misfits_mm
from sightline.frame.patterns import HIDDEN, Triples, in_steps, nearest_likeness
from sightline.frame.plate import SOURCE_TO_HIP_MM, FrameView, Plate, RigidBody
from sightline.frame.solid_shape import FIELDS_MM, clear_beads, in_words, offset_mm, symmetry_of

MAX_CHANGE_MM = 1.0  # [ours] more is a typing error or another frame, not a bent plate
MAX_ALIKE = 0.5  # [ours] share of the triples of datums: a symmetric pattern, or a copy of another plate, has 1.0
WIRE_END_MM = 95 / np.sqrt(8)  # half a 95 mm wire at 45° (physics.md, Frame), along each axis of the view

_NOMINAL = f"a C-arm with the hip {SOURCE_TO_HIP_MM:g} mm from its source"
SYMMETRY_MM = 1.0  # [ours] five times the error of a printed ball: nearer to a symmetry, labels may be exchanged
_RARE = 0.02  # [ours] share of the directions in which an image may be refused: a person then turns the C-arm a little

Items = Iterator[tuple[str, Any]]  # (place, what is measured there)


@dataclass(frozen=True)
class Rule:
    """The rule of a check: `value` of each of the `items` of a frame, None where there is none.

    `limit` applies to the worst; an item without a value is the worst. A rule without items does not apply.
    """

    name: str
    items: Callable[[Frame], Items]
    value: Callable[[Any], float | None]
    at_least: bool
    limit: float
    unit: str
    meaning: str
    advice: str

    def judge(self, frame: Frame) -> Iterator[Check]:
        """Yield the check of the worst place, where the rule applies."""
        values = [(where, self.value(item)) for where, item in self.items(frame)]
        if values:
            sign = 1 if self.at_least else -1
            where, value = min(values, key=lambda entry: -np.inf if entry[1] is None else sign * entry[1])
            passed = value is not None and bool(sign * value >= sign * self.limit)
            sentence = f"{where}: {self.meaning if passed else self.advice}"
            yield Check(self.name, passed, None if value is None else float(value), self.limit, self.unit, sentence)


def check_frame(frame: Frame) -> tuple[Check, ...]:
    """Return the checks that a frame can be labelled and calibrated with; the names are keys of docs/refusals.md.

    A rule of plates does not apply to a solid, nor a solid's to plates; a plate on the detector has those of plates
    that need no focal point. Later stages rely on earlier ones (that plates have planes, that a beam runs through
    them), so the stages after a failed one are left out.
    """
    checks: tuple[Check, ...] = ()
    for stage in ((*_BEADS, *_SOLID_BEADS), _PLATES, (*_VIEWS, *_SOLID_VIEWS)):
        checks += tuple(check for rule in stage for check in rule.judge(frame))
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


def _whole(frame: Frame) -> Items:
    yield frame.name, frame


def _plated(frame: Frame) -> Items:
    if frame.solid is None:
        yield frame.name, frame


def _solid(frame: Frame) -> Items:
    if frame.solid is not None:
        yield frame.name, frame.solid


def _plates(frame: Frame) -> Items:
    """Yield the view and the plate of each plate that has a focal point."""
    for name, role, plate in frame.named_plates:
        yield f"{name}, {'XRII' if role == 'xrii' else 'source'} plate", (frame.views[name], plate)


def _flat(frame: Frame) -> Items:
    yield from ((where, plate) for where, (_, plate) in _plates(frame))
    if frame.detector is not None:
        yield "plate on the detector", frame.detector


def _bodies(frame: Frame) -> Items:
    yield from (*_flat(frame), *_solid(frame))


def _pairs(frame: Frame) -> Items:
    """Yield the datums of each two plates, in steps."""
    plates = [(where, _datum_steps(plate)) for where, (_, plate) in _plates(frame)]
    for index, (where, points) in enumerate(plates):
        yield from ((f"{where} and {other}", (points, theirs)) for other, theirs in plates[:index])


def _sizes(frame: Frame) -> Items:
    """Yield the diameters of datum balls and of ordinary balls; washers are known by their shape."""
    for where, plate in _flat(frame):
        datums = [f.diameter_mm for f in plate.fiducials if f.datum and f.shape == "ball"]
        ordinary = [f.diameter_mm for f in plate.fiducials if not f.datum]
        if datums and ordinary:
            yield where, (datums, ordinary)


def _symmetries(frame: Frame) -> Items:
    """Yield the symmetries of a solid, with one of them in words: a rotation where there is one."""
    for where, solid in _solid(frame):
        symmetries = symmetry_of(solid.xyz_mm, solid.diameter_mm, SYMMETRY_MM)
        yield where + (f", {in_words(max(symmetries, key=np.linalg.det))}" if symmetries else ""), symmetries


def _in_largest_field(frame: Frame) -> Items:
    name, field_mm = max(FIELDS_MM.items(), key=lambda entry: entry[1])
    yield from ((name, offset_mm(solid, field_mm)) for _, solid in _solid(frame))


def _spread_mm(body: RigidBody, smaller: int) -> float:
    """Return the rms distance of the beads from their best-fitting line (`smaller` = 1) or plane (2)."""
    centred = body.xyz_mm - body.xyz_mm.mean(axis=0)
    return float(np.linalg.svd(centred, compute_uv=False)[smaller] / np.sqrt(len(centred)))


def _clearance_mm(body: RigidBody) -> float:
    """Return the smallest distance between the surfaces of two fiducials."""
    radius = body.diameter_mm / 2
    first, second = np.triu_indices(len(radius), 1)
    return float((pdist(body.xyz_mm) - radius[first] - radius[second]).min())


def _datums(plate: Plate) -> int:
    """Return the number of datums of a plate; 0 where they are collinear."""
    points = _datum_steps(plate)
    return len(points) if len(points) < 3 or len(Triples.of(points).broad().area) > 0 else 0


def _datum_steps(plate: Plate) -> np.ndarray:
    return in_steps(plate.plane.to_plane(plate.xyz_mm))[plate.is_datum]


def _alike(points: np.ndarray, others: Sequence[np.ndarray] = ()) -> float:
    """Return the share of datum triples that resemble those of other plates, or others of their own plate."""
    likeness = nearest_likeness(points, others)
    return float((likeness < 1).mean()) if len(likeness) else 0.0


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


_BEADS = (
    Rule(
        "frame-views", _plated, lambda frame: len(frame.views),
        at_least=True, limit=2, unit="views",
        meaning="lines of sight of two views intersect in a point",
        advice="one view gives lines of sight but no point; add the plates of a second view",
    ),
    Rule(
        "frame-ids", _whole, lambda frame: len(frame.fiducials) - len(frame.xyz_mm_by_id),
        at_least=False, limit=0, unit="ids",
        meaning="every ball has a unique id",
        advice="two balls have the same id; give every ball of the frame a unique id",
    ),
    Rule(
        "plate-beads", _flat, lambda plate: len(plate.ids),
        at_least=True, limit=16, unit="beads",  # 16-25 lines of sight for a focal point [paper]
        meaning="the plate with the fewest beads has enough of them",
        advice="there are too few beads for a reliable focal point; add beads",
    ),
    Rule(
        "plate-collinear", _flat, lambda plate: _spread_mm(plate, 1),
        at_least=True, limit=10.0, unit="mm",  # [ours] half a pitch
        meaning="the beads spread in two directions",
        advice="the beads lie on or near a line; add beads away from it, or correct their coordinates",
    ),
)  # fmt: skip
_PLATES = (
    Rule(
        "bead-overlap", _bodies, _clearance_mm,
        at_least=True, limit=2.0, unit="mm",  # [ours] 8 px between the edges of two discs
        meaning="no two beads touch",
        advice="two beads touch or nearly touch, so their images cannot be centred; move or remove one",
    ),
    Rule(
        "plate-flat", _flat, lambda plate: np.abs(plate.plane.height_mm(plate.xyz_mm)).max(),
        at_least=False, limit=MAX_CHANGE_MM, unit="mm",
        meaning="the beads lie in a plane",
        advice="a bead lies off the plane of the others; correct its coordinates, or measure the plate again",
    ),
    Rule(
        "plate-spacing", lambda frame: iter(frame.views.items()),
        lambda view: np.abs(view.xrii.plane.height_mm(view.source.xyz_mm)).min(),
        at_least=True, limit=50.0, unit="mm",  # the smallest that was tried [calc]
        meaning="the plates are far enough apart",
        advice="the plates are too close to determine the focal point; move them further apart along the beam",
    ),
)  # fmt: skip
_VIEWS = (
    Rule(
        "datum-count", _flat, _datums,
        at_least=True, limit=3, unit="datums",
        meaning="three datums that are not collinear determine where a plate lies",
        advice="mark more balls as datums: a plate needs three that are not on a line (5 or 6 in case some are hidden)",
    ),
    Rule(
        "datum-size", _sizes, lambda sizes: min(sizes[0]) / max(sizes[1]),
        at_least=True, limit=1.3, unit="",  # [ours] 5 mm over 3 mm is 1.67
        meaning="datum balls are larger than the others",
        advice="datum balls cannot be distinguished from the others in an image; use larger ones, or washers",
    ),
    Rule(
        "datum-symmetry", _flat, lambda plate: _alike(_datum_steps(plate)),
        at_least=False, limit=MAX_ALIKE, unit="",
        meaning="no rotation or mirror image of the datums can be confused with the pattern",
        advice="move a datum so that no three repeat the shape of others: they look the same when rotated or mirrored",
    ),
    Rule(
        "plate-twin", _pairs, lambda pair: max(_alike(pair[0], pair[1:]), _alike(pair[1], pair[:1])),
        at_least=False, limit=MAX_ALIKE, unit="",
        meaning="the datums distinguish the plates",
        advice="the datums of one plate are a copy or a mirror image of the other's; move the datums of one",
    ),
    Rule(
        "plate-tilt", _plates, lambda pair: np.degrees(np.arccos(min(1.0, abs(pair[1].plane.normal @ pair[0].axis)))),
        at_least=False, limit=20.0, unit="°",  # as the labelling (labelling/solve.py)
        meaning="the plates are perpendicular to the beam",
        advice="the plate is tilted too far; make it perpendicular to the line from plate to plate",
    ),
    Rule(
        "plate-field", _plates, lambda pair: pair[0].in_field(pair[1].xyz_mm).mean(),
        at_least=True, limit=1 - HIDDEN, unit="",
        meaning=_NOMINAL + " sees the beads",
        advice=_NOMINAL + " sees too few beads of this plate; make it smaller or move it nearer to the intensifier",
    ),
    Rule(
        "wire-reach", _plates, lambda pair: reach_mm(*pair),
        at_least=True, limit=10.0, unit="mm",  # set-up error (physics.md, Frame)
        meaning="projected to the hip, the beads surround a 95 mm wire at 45° by this margin",
        advice="add rows or pitch, or move the plate: at the hip, its beads do not surround a 95 mm wire at 45°",
    ),
)  # fmt: skip
_SOLID_BEADS = (
    Rule(
        "solid-beads", _solid, lambda solid: len(solid.ids),
        at_least=True, limit=9, unit="beads",  # [ours] labels with an error of 1e-6
        meaning="there are enough beads to label an image by their geometry",
        advice="there are too few beads to label an image reliably; add beads",
    ),
    Rule(
        "solid-extent", _solid, lambda solid: _spread_mm(solid, 2),
        at_least=True, limit=5.0, unit="mm",  # [ours] half of what a block of 30 mm has
        meaning="the beads spread in three directions (rms from their best-fitting plane)",
        advice="the beads lie in or near a plane, which leaves the focal length unknown; add beads away from it",
    ),
)  # fmt: skip
_SOLID_VIEWS = (
    Rule(
        "solid-clear", _solid, lambda solid: clear_beads(solid).mean(),
        at_least=True, limit=9.0, unit="beads",  # as solid-beads
        meaning="from a random direction this many beads are clear of each other on average",
        advice="from most directions too few beads are clear of each other; move beads apart or add some",
    ),
    Rule(
        "solid-worst", _solid, lambda solid: np.quantile(clear_beads(solid), _RARE, method="lower"),
        at_least=True, limit=6.0, unit="beads",  # 12 equations, 11 unknowns
        meaning="from all but 2 % of the directions at least this many beads are clear of each other",
        advice="from over 2 % of the directions too few beads are clear of each other; move beads out of rows",
    ),
    Rule(
        "solid-symmetry", _symmetries, len,
        at_least=False, limit=0, unit="symmetries",
        meaning="no rotation or mirror image can be confused with the solid",
        advice="the solid looks the same, so its balls cannot be labelled; move balls, or give some another size",
    ),
    Rule(
        "solid-field", _in_largest_field, float,
        at_least=True, limit=0.0, unit="mm",
        meaning="at the hip the solid's middle may stand this far from the beam's axis with all beads in the image",
        advice="at the hip beads are cut off from the image; make the solid smaller",
    ),
)  # fmt: skip
