"""A wire proposed from the drawn aids by its procedure's rule, with the drawings' error, for a person to adjust."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.common.geometry.covariance import length_quantile, response
from sightline.common.geometry.lines import across, unit
from sightline.errors import ReconstructionRefusedError
from sightline.planning.bone.anatomy import Anatomy
from sightline.planning.bone.directions import MEDIAL, caudal, towards
from sightline.planning.bone.drawings import ENTRY, ENTRY_BORDERS, ENTRY_LATERAL, axis_of_oval, axis_of_tube

# What is accepted of drawn bone, beyond all adults: elsewhere a drawing is wrong [ours]. Distances of the lateral
# cortex from the shaft's axis: the shaft's outer diameter is 30 mm (physics.md, Femur), the trochanter is wider; of the
# head's centre from the shaft's axis, 30 to 50 mm in adults; of the middle of the vertebral body from the pedicle, seen
# from behind, 15 to 25 mm.
CORTEX_RADII_MM, MIN_OFFSET_MM, MIN_BESIDE_MM = (5.0, 40.0), 15.0, 5.0
# Sine of the angle at which a line crosses a drawn surface or border [ours]: below it, the border's error counts more
# than threefold along the line.
MIN_ACROSS = 0.3
_MAX_ROTATION_RAD = np.deg2rad(45.0)  # [ours] about the shaft, from neck's axis to head's centre: more is an error


@dataclass(frozen=True)
class ProposalRule:
    """A procedure's rule for one of its wires.

    `angle_rad`: of "through-head" between wire and shaft, measured like the neck-shaft angle; of "through-pedicle"
    towards the middle of the body. `under_surface_mm`: depth of the tip below the head's surface, behind the front of
    the body, or before the end of the drawn corridor. `name`: one of RULES. `wire`: key of the wire.
    """

    angle_rad: float = float(np.deg2rad(135.0))  # of the usual plate (physics.md, Planning values)
    under_surface_mm: float = 8.0  # 5 to 10 mm under the subchondral bone (physics.md)
    name: str = "through-head"
    wire: str = ""

    @property
    def needs(self) -> tuple[str, ...]:
        """The aids that the rule needs, by their keys."""
        return RULES[self.name].of_wire(self.wire)

    def lacking(self, anatomy: Anatomy) -> list[str]:
        """Return the aids that the rule needs and that are not located; of the surface at the entry one is enough."""
        entry = {ENTRY} if ENTRY_LATERAL in anatomy.at else set()
        return [name for name in self.needs if name not in anatomy.at and name not in entry]

    @property
    def side(self) -> bool:
        """Whether the rule needs the side."""
        return self.name == "through-head"


# Maps the bone, the side and the rule to entry and end (2, 3), CFCS.
Ends = Callable[[Anatomy, str, ProposalRule], np.ndarray]


@dataclass(frozen=True)
class KnownRule:
    """A rule that a procedure's file may name.

    `lengths_mm`: least and greatest length of a wire. `takes`: the numbers of the file. `needs`: keys of aids, with
    "{wire}" for that of the wire. `words`: how the wire runs.
    """

    ends: Ends
    lengths_mm: tuple[float, float]
    takes: tuple[str, ...]
    needs: tuple[str, ...]
    words: str

    def of_wire(self, wire: str) -> tuple[str, ...]:
        """Return the keys of the aids that the rule needs for a wire."""
        return tuple(key.format(wire=wire) for key in self.needs)


def _through_head(anatomy: Anatomy, side: str, rule: ProposalRule) -> np.ndarray:
    """Return the wire through the head's centre at the rule's angle to the shaft, in the plane of both.

    Where the neck's axis is drawn, the wire is rotated about the shaft to lie along it. It enters at the lateral
    cortex, modelled as a cylinder about the shaft's axis through the click.
    """
    head, shaft = anatomy.head, anatomy.shaft
    assert head is not None and shaft is not None  # noqa: S101 - among the needs of the rule
    anatomy.refuse_side(side)
    along = towards(shaft.direction, caudal(side), "the shaft axis")
    to_head = across(head.centre_mm - shaft.ends_mm[0], along)
    if np.linalg.norm(to_head) < MIN_OFFSET_MM:
        raise ReconstructionRefusedError(
            f"the head's centre lies {np.linalg.norm(to_head):.0f} mm from the shaft's axis (at least "
            f"{MIN_OFFSET_MM:.0f} mm expected); draw head and shaft again"
        )
    inward = _inward(anatomy, to_head, along)
    wire = np.cos(rule.angle_rad) * along + np.sin(rule.angle_rad) * inward
    end = head.centre_mm + _beyond_centre(head.radius_mm, rule) * wire
    cortex = across(anatomy.part("cortex") - shaft.ends_mm[0], along)
    entry = head.centre_mm + _to_cortex(cortex, to_head, inward, np.sin(rule.angle_rad)) * wire
    return np.stack([entry, end])


def _through_corridor(anatomy: Anatomy, side: str, rule: ProposalRule) -> np.ndarray:
    """Return the wire along the axis of the drawn corridor, to so far before the end of its borders."""
    tube = anatomy.part("s1-corridor").reshape(1, 2, 5, 3)
    on, along, ends = axis_of_tube(tube, "corridor")
    entry, wire = _entered(anatomy, on, along)
    # In each image the farther border counts, of both images the nearer end, as in "tip in sacral corridor".
    reach = min(float((places * (along @ wire)).max()) for places in ends) + (on - entry) @ wire
    return np.stack([entry, entry + max(reach - rule.under_surface_mm, 0.0) * wire])


def _through_pedicle(anatomy: Anatomy, side: str, rule: ProposalRule) -> np.ndarray:
    """Return the wire through the middle of the pedicle, between its borders in the second image, rotated from the beam
    of the first towards the middle of the body."""
    middle, beam, upwards = axis_of_oval(anatomy.part("pedicle").reshape(1, 2, 5, 3), "pedicle")
    plates = [anatomy.part(name)[:3] for name in ("upper-endplate", "lower-endplate")]
    to_body = np.mean(plates, axis=0) - middle
    forward = unit(across(beam, upwards))
    forward = forward * np.sign(forward @ to_body)
    medial = np.cross(upwards, forward)
    beside = float(medial @ to_body)
    if abs(beside) < MIN_BESIDE_MM:
        raise ReconstructionRefusedError(
            f"seen from behind, the middle of the end plates lies {abs(beside):.0f} mm beside the pedicle (at least "
            f"{MIN_BESIDE_MM:.0f} mm expected), so it does not show which way is medial; draw pedicle and end plates "
            "again"
        )
    medial = medial * np.sign(beside)
    entry, wire = _entered(anatomy, middle, np.cos(rule.angle_rad) * forward + np.sin(rule.angle_rad) * medial)
    point, normal = anatomy.part("front")[:3], anatomy.part("front")[3:]
    normal = normal * np.sign(normal @ wire)
    reach = ((point - entry) @ normal - rule.under_surface_mm) / _steep(
        float(normal @ wire), "front of the vertebral body"
    )
    return np.stack([entry, entry + max(reach, 0.0) * wire])


def _across_growth_plate(anatomy: Anatomy, side: str, rule: ProposalRule) -> np.ndarray:
    """Return the wire through the centre of the epiphysis, perpendicular to the growth plate."""
    head = anatomy.head
    assert head is not None  # noqa: S101 - among the needs of the rule
    entry, wire = _entered(anatomy, head.centre_mm, anatomy.part("growth-plate")[3:])
    return np.stack([entry, head.centre_mm + _beyond_centre(head.radius_mm, rule) * wire])


# Accepted lengths: hip screws have 70 to 120 mm, pedicle screws 40 to 50 mm [ours].
RULES: Mapping[str, KnownRule] = MappingProxyType(
    {
        "through-head": KnownRule(
            _through_head,
            (40.0, 150.0),
            ("angle_deg", "under_surface_mm"),
            ("head", "shaft", "cortex"),
            "through the head's centre at {angle:.0f}° to the shaft, the tip {depth:.0f} mm below the head's surface",
        ),
        "through-corridor": KnownRule(
            _through_corridor,
            (40.0, 200.0),
            ("under_surface_mm",),
            ("s1-corridor", ENTRY),
            "along the middle of the drawn corridor, the tip {depth:.0f} mm before its end",
        ),
        "through-pedicle": KnownRule(
            _through_pedicle,
            (25.0, 80.0),
            ("angle_deg", "under_surface_mm"),
            ("pedicle", "upper-endplate", "lower-endplate", "front", ENTRY),
            "through the middle of the pedicle, {angle:.0f}° towards the middle of the body, the tip {depth:.0f} mm "
            "behind its front",
        ),
        "across-growth-plate": KnownRule(
            _across_growth_plate,
            (30.0, 120.0),
            ("under_surface_mm",),
            ("head", "growth-plate", ENTRY),
            "through the centre of the epiphysis, perpendicular to the growth plate, the tip {depth:.0f} mm below the "
            "surface",
        ),
        "through-rims": KnownRule(
            lambda anatomy, side, rule: anatomy.part(rule.needs[0]).reshape(2, 3),
            (5.0, 30.0),
            (),
            ("{wire}-rims",),
            "through the middles of both rims of the hole, the first one first",
        ),
    }
)


def _entered(anatomy: Anatomy, on_mm: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where a line through a point (3,) along a unit vector (3,) crosses the bone's drawn surface, and its
    direction from there to the point.

    Of the surfaces of two images the bone lies inside both, so the crossing that is nearer to the point counts.
    """
    crossings = []
    for name in ENTRY_BORDERS:
        if name in anatomy.at:
            point, normal = anatomy.part(name)[:3], anatomy.part(name)[3:]
            crossings.append(float((point - on_mm) @ normal) / _steep(float(normal @ along), "surface at the entry"))
    to_entry = min(crossings, key=abs)
    return on_mm + to_entry * along, -np.sign(to_entry) * along


def _steep(cosine: float, what: str) -> float:
    """Return the cosine between a wire and the normal of a drawn plane. Raises ReconstructionRefusedError where the
    wire runs nearly along the plane."""
    if abs(cosine) < MIN_ACROSS:
        raise ReconstructionRefusedError(
            f"the wire would run nearly along the drawn {what}; draw that line again, where the wire crosses it"
        )
    return float(cosine)


def _inward(anatomy: Anatomy, to_head: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return the unit vector perpendicular to the shaft in the wire's plane: to the head's centre or along the neck."""
    if anatomy.neck is None:
        return unit(to_head)
    inward = unit(across(towards(anatomy.neck.direction, MEDIAL, "the neck axis"), along))
    angle = np.arccos(np.clip(inward @ unit(to_head), -1.0, 1.0))
    if angle > _MAX_ROTATION_RAD:
        raise ReconstructionRefusedError(
            f"seen along the shaft, the neck's axis points {np.rad2deg(angle):.0f}° away from the head's centre (at "
            f"most {np.rad2deg(_MAX_ROTATION_RAD):.0f}°); draw neck and head again"
        )
    return inward


def _beyond_centre(radius_mm: float, rule: ProposalRule) -> float:
    beyond = radius_mm - rule.under_surface_mm
    if beyond <= 0.0:
        raise ReconstructionRefusedError(
            f"a head of {radius_mm:.0f} mm radius is too small for a tip {rule.under_surface_mm:.0f} mm below its "
            "surface; draw the head again"
        )
    return beyond


def _to_cortex(cortex: np.ndarray, to_head: np.ndarray, inward: np.ndarray, sine: float) -> float:
    """Return where the wire leaves the cortex's cylinder about the shaft, mm along it from the head's centre (< 0).

    `cortex`, `to_head` (3,): perpendicular to the shaft, from its axis to the click's line of sight and to the head's
    centre.
    """
    radius = float(np.linalg.norm(cortex))
    if not CORTEX_RADII_MM[0] <= radius <= CORTEX_RADII_MM[1] or cortex @ to_head > 0:
        where = f"{radius:.0f} mm on the head's side" if cortex @ to_head > 0 else f"{radius:.0f} mm"
        raise ReconstructionRefusedError(
            f"the click on the lateral cortex lies {where} from the shaft's axis ({CORTEX_RADII_MM[0]:.0f} to "
            f"{CORTEX_RADII_MM[1]:.0f} mm expected, away from the head); click on the shaft's lateral edge"
        )
    middle = float(to_head @ inward)
    rest = radius**2 - float(to_head @ to_head) + middle**2
    if rest <= 0.0:
        raise ReconstructionRefusedError(
            f"the wire would pass the shaft's axis at {np.sqrt(to_head @ to_head - middle**2):.0f} mm, outside the "
            "bone; draw the neck again"
        )
    return float(-(middle + np.sqrt(rest)) / sine)


@dataclass(frozen=True, eq=False)
class Proposal:
    """`entry_mm`, `end_mm` (3,), CFCS; `entry_uv_px`, `end_uv_px` (V, 2), a row for each view, as `plan` takes them.

    `covariance_mm2` (6, 6): of entry and end, by the errors of clicks and views; None where one is unknown, and for
    wires beside a planned one.
    """

    entry_mm: np.ndarray
    end_mm: np.ndarray
    entry_uv_px: np.ndarray
    end_uv_px: np.ndarray
    sentence: str
    covariance_mm2: np.ndarray | None = None


def propose(
    views: Sequence[CalibratedView], anatomy: Anatomy, side: str | None, rule: ProposalRule | None = None
) -> Proposal:
    """Return the wire that the rule of a procedure puts into the located parts of a bone.

    `side`: needed by "through-head" only. The proposal is not a judgement: plan it, and look at the verdict.

    Raises ReconstructionRefusedError with the reason where no wire can be proposed, OutsideRegionError where it lies
    outside a view's calibrated region, UnusableInputError for an unknown side.
    """
    rule = rule or ProposalRule()
    if lacking := rule.lacking(anatomy):
        raise ReconstructionRefusedError(f"no wire can be proposed: {anatomy.why_absent(lacking[0])}")
    if rule.side and side is None:
        raise ReconstructionRefusedError("no wire can be proposed: the side is not given; look at the images, give it")
    known = RULES[rule.name]

    def of(values: np.ndarray) -> np.ndarray:
        return np.stack([known.ends(replace(anatomy, values=numbers), side or "", rule).ravel() for numbers in values])

    wire, own = response(of, anatomy.values)
    entry, end = wire.reshape(2, 3)
    length, (low, high) = float(np.linalg.norm(end - entry)), known.lengths_mm
    if not low <= length <= high:
        drawn = "head, shaft and lateral cortex" if rule.name == "through-head" else "what is drawn"
        raise ReconstructionRefusedError(
            f"the wire would be {length:.0f} mm long ({low:.0f} to {high:.0f} mm expected); check {drawn}"
        )
    covariance = None if anatomy.covariance is None else own @ anatomy.covariance @ own.T
    pixels = np.array([view.project(np.stack([entry, end])) for view in views])
    words = known.words.format(angle=np.rad2deg(rule.angle_rad), depth=rule.under_surface_mm)
    sentence = f"Proposed: {words}, {length:.0f} mm long.{_errors(covariance)} Adjust it to the images."
    return Proposal(entry, end, pixels[:, 0], pixels[:, 1], sentence, covariance)


def _errors(covariance: np.ndarray | None) -> str:
    if covariance is None:
        return ""
    entry, end = (float(length_quantile(covariance[at, at])) for at in (slice(0, 3), slice(3, 6)))
    return (
        f" By the errors of clicks and views its entry is known to {entry:.1f} mm and its end to {end:.1f} mm (95 %)."
    )
