"""The schema of a procedure's file (docs/procedures.md), and the checks that it may name."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from types import MappingProxyType
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from sightline.common.checks import CLEAR_MM, MAX_BEFORE_MM, CheckCode, code_key
from sightline.planning.bone.aids import CLICKS
from sightline.planning.bone.directions import anatomical
from sightline.planning.bone.drawings import ENTRY_BORDERS
from sightline.planning.procedures.proposal import RULES

# Landmarks that checks need.
LANDMARKS = HEAD_CENTRE, LESSER, PROMONTORY, EPICONDYLE = (
    "head-centre",
    "lesser-trochanter",
    "promontory",
    "lateral-epicondyle",
)

# [ours] beyond any length (mm) or angle (°) of a wire in a bone
Limit = Annotated[float, Field(allow_inf_nan=False, ge=-1e3, le=1e3)]
Text = Annotated[str, Field(min_length=1, max_length=400)]
Key = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,39}$")]
Name = Annotated[str, Field(min_length=1, max_length=80)]
Millimetres = Annotated[float, Field(allow_inf_nan=False, gt=0, le=1e3)]
Degrees = Annotated[float, Field(allow_inf_nan=False, gt=0, le=90)]
AidType = Literal["point", "sphere", "line", "plane", "cylinder", "rim pair", "outline tube", "oval tube"]
# Clicks that define an aid in each of its images, at least and at most.
_CLICKS = {"point": (1, 1), "sphere": (3, 12), "line": (2, 2), **{kind: (n, n) for kind, n in CLICKS.items()}}
# The aids with a place of their own in `Aids`; of the types in CLICKS there may be any others.
LOCATED: dict[str, AidType] = {
    "head": "sphere",
    "neck": "line",
    "shaft": "line",
    "calcar": "point",
    "cortex": "point",
    "outline": "outline tube",
}
# Smallest singular value of the bone's directions: two unit vectors at 25° to each other have 0.3 [ours].
# Of a smaller one, errors of the directions count threefold.
_MIN_SINGULAR = 0.3


class Strict(BaseModel):
    """A part of a procedure's file: unknown keys are refused."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class AsGiven(Strict):
    """A part that is written without what is not given, so that files without it keep their fingerprints."""

    @model_serializer(mode="wrap")
    def _as_given(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in write(self).items() if value is not None}


@dataclass(frozen=True)
class KnownCheck:
    """A check that a file may name: the limits that it takes, their unit, the aids or landmarks that it needs.

    `needs`: alternatives, each a set of keys. `side`: whether a metric is judged only where the side is given.
    """

    limits: tuple[str, ...]
    unit: str
    needs: tuple[frozenset[str], ...]
    side: bool = True


def _known(limits: str, unit: str, *needs: str, side: bool = True) -> KnownCheck:
    return KnownCheck(tuple(limits.split()), unit, tuple(frozenset(keys.split()) for keys in needs), side)


CHECKS: Mapping[str, KnownCheck] = MappingProxyType(
    {
        "entry and end": _known("", "mm", "head", HEAD_CENTRE),
        "entry from lateral": _known("", "mm", EPICONDYLE, side=False),
        "side": _known("", "mm", "head", HEAD_CENTRE),
        "head to entry": _known("low", "mm", "head", HEAD_CENTRE),
        "tip in head": _known("", "mm", "head"),
        "lateral of lesser trochanter": _known("low high", "mm", LESSER),
        "anterior of lesser trochanter": _known("low high", "mm", LESSER),
        "above lesser trochanter": _known("low", "mm", LESSER),
        "wire to shaft": _known("low high", "°", "shaft"),
        "entry below cortex": _known("high", "mm", "head shaft cortex", f"{HEAD_CENTRE} shaft cortex"),
        "entry outside cortex": _known("high", "mm", "head shaft cortex", f"{HEAD_CENTRE} shaft cortex"),
        "wire length": _known("low high", "mm"),
        "angle between views": _known("low", "°"),
        "tip-apex distance": _known("low high", "mm", "head neck"),
        "calcar tip-apex distance": _known("high", "mm", "head neck calcar"),
        "tip to bone along wire": _known("low high", "mm", "head"),
        "tip to bone nearest": _known("low", "mm", "head"),
        "wire in neck": _known("low", "mm", "outline"),
        "wire off neck axis": _known("high", "mm", "neck"),
        "wire in sacral corridor": _known("low", "mm", "s1-corridor", side=False),
        "tip in sacral corridor": _known("low", "mm", "s1-corridor", side=False),
        "tip past promontory": _known("low", "mm", PROMONTORY, side=False),
        "entry to cortex": _known("high", "mm", *ENTRY_BORDERS, side=False),
        "wire in pedicle": _known("low", "mm", "pedicle", side=False),
        "entry to pedicle": _known("low high", "mm", "pedicle", side=False),
        "tip behind front": _known("low", "mm", "front", side=False),
        "tip short of front": _known("high", "mm", "front", side=False),
        "tip to endplates": _known("low", "mm", "upper-endplate lower-endplate", side=False),
        "wire to growth plate": _known("high", "°", "growth-plate", side=False),
        "wire off middle of growth plate": _known("high", "mm", "growth-plate", side=False),
        "tip beyond growth plate": _known("low", "mm", "growth-plate", side=False),
        "view directions": _known("", "°"),
    }
)
# The limit of these is the 95 % error of their own value: no clearance.
ABOVE_ERROR = (CheckCode.TIP_IN_HEAD,)
# They show whether an end of the wire lies in the bone, where the corridor says that it must.
END_CHECKS = {
    "entry": {"entry below cortex", "lateral of lesser trochanter", "entry to pedicle"},
    "end": {"tip in head", "tip to bone nearest", "tip behind front", "tip in sacral corridor"},
}
# Their lower limit is at least the room that the implant needs.
IN_CORRIDOR = ("wire in neck", "wire in sacral corridor", "wire in pedicle")


def _refuse_others(part: Strict, what: str, names: Sequence[str], takes: Sequence[str]) -> None:
    """Raise ValueError where a part of a file lacks a number that it takes, or has another of these names."""
    for name in names:
        if (getattr(part, name) is None) == (name in takes):
            raise ValueError(
                f"is the {what}, which takes {' and '.join(takes) or 'no numbers'}; "
                f"{'give' if name in takes else 'remove'} {name!r}"
            )


class CheckRule(AsGiven):
    """One check of the wire against the bone: its name in CHECKS, its limits, and their source.

    The checks named like a metric of the implant judge the metric's 95 % interval, which must lie within the limits.

    `optional`: why a plan may be GO where the check lacks what it needs; of the others such a plan is incomplete.
    `required`: of earlier versions, where it said the same of a check. `of`: what the limits are those of, in the
    sentence of a wire's length.
    """

    check: str
    low: Limit | None = None
    high: Limit | None = None
    required: bool | None = None
    optional: Text | None = None
    of: Annotated[str, Field(min_length=1, max_length=80)] = "the implants"
    source: Text

    @model_validator(mode="after")
    def _known(self) -> Self:
        if self.check not in CHECKS:
            raise ValueError(f"names the check {self.check!r}, which is not known; choose from {', '.join(CHECKS)}")
        _refuse_others(self, f"check {self.check!r}", ("low", "high"), CHECKS[self.check].limits)
        if not self.range[0] < self.range[1]:
            raise ValueError(f"has the limits {self.low:g} to {self.high:g}; give a lower limit below the upper one")
        if self.required is not None and self.required == (self.optional is not None):
            raise ValueError("is not required; say in 'optional' why a plan may do without it, and remove 'required'")
        return self

    @property
    def code(self) -> CheckCode | None:
        """The code of the check that the rule names; None where the check is "entry at cortex"."""
        return next((code for code in CheckCode if code == code_key(self.check)), None)

    @property
    def range(self) -> tuple[float, float]:
        """The accepted values, infinite where there is no limit."""
        return -inf if self.low is None else self.low, inf if self.high is None else self.high


class WantedView(Strict):
    """A view to acquire, in the order of the images, and its wanted direction.

    The beam's direction from the X-ray source to the detector: `orbit_deg` is 0 towards anterior and 90 towards the
    operated side; `tilt_deg` is positive with the detector tilted towards the head.
    """

    name: Key
    purpose: Text
    orbit_deg: Annotated[float, Field(ge=-180, le=180)]
    tilt_deg: Annotated[float, Field(ge=-90, le=90)]
    within_deg: Degrees
    source: Text


class PointAsked(Strict):
    """A point that a person picks."""

    name: Name
    sentence: Text


class BoneDirection(Strict):
    """A direction of the bone: from the mean of some points to that of others, and where it points in the patient.

    Points, by their keys: "entry" and "end" of the wire, landmarks, and the middles of aids. `along`: an aid whose axis
    (of a plane its perpendicular) is the direction instead, pointing the way from the first points to the others.
    `orbit_deg`, `tilt_deg`: of a beam that runs along it, as of a `WantedView`. `sd_deg`: by how much bones differ from
    that, standard deviation in each direction.
    """

    from_: Annotated[tuple[Key, ...], Field(alias="from", min_length=1, max_length=4)]
    to: Annotated[tuple[Key, ...], Field(min_length=1, max_length=4)]
    along: Key | None = None
    orbit_deg: Annotated[float, Field(ge=-180, le=180)]
    tilt_deg: Annotated[float, Field(ge=-90, le=90)]
    sd_deg: Annotated[float, Field(allow_inf_nan=False, ge=0, le=45)]
    source: Text

    @property
    def label(self) -> str:
        """Its points as text."""
        return f"{', '.join(self.from_)} to {', '.join(self.to)}"

    @property
    def nominal(self) -> np.ndarray:
        """(3,) unit vector: lateral, caudal, anterior."""
        return anatomical(self.orbit_deg, self.tilt_deg)


class WireAsked(Strict):
    """A wire, drill or screw's guide: its diameter, entry and end."""

    key: Key
    name: Name
    diameter_mm: Millimetres
    entry: PointAsked
    end: PointAsked


class Relation(Strict):
    """What holds between wires, by their keys.

    "parallel": the angle between any two is at most `high`, °. "spacing": the distance of any two at their entries lies
    between `low` and `high`, mm. "order": they are drilled in this order. "inverted triangle": three wires, the first
    one the most caudal, the second in front of it, the third behind it.
    """

    relation: Literal["parallel", "spacing", "order", "inverted triangle"]
    wires: Annotated[tuple[Key, ...], Field(min_length=2, max_length=6)]
    low: Annotated[float, Field(ge=0, le=1e3)] | None = None
    high: Annotated[float, Field(gt=0, le=1e3)] | None = None
    source: Text

    @model_validator(mode="after")
    def _limits(self) -> Self:
        takes = {"parallel": ("high",), "spacing": ("low", "high")}.get(self.relation, ())
        _refuse_others(self, f"relation {self.relation!r}", ("low", "high"), takes)
        if self.relation == "inverted triangle" and len(self.wires) != 3:
            raise ValueError("is an inverted triangle; name three wires: the lowest, the anterior, the posterior one")
        return self


class LandmarkAsked(PointAsked):
    """A point of the bone that is picked freely in all views."""

    key: Key


class AidAsked(PointAsked):
    """A drawn aid: its type, the views that it is drawn in, and the clicks in each."""

    key: Key
    type: AidType
    views: Annotated[tuple[Key, ...], Field(min_length=1, max_length=4)]
    clicks: Annotated[int, Field(ge=1, le=40)]

    @model_validator(mode="after")
    def _drawable(self) -> Self:
        low, high = _CLICKS[self.type]
        if not low <= self.clicks <= high:
            raise ValueError(f"is a {self.type} drawn by {self.clicks} clicks; give {low} to {high}")
        if LOCATED.get(self.key, self.type if self.type in CLICKS else None) != self.type:
            known = ", ".join(f"{key} ({kind})" for key, kind in LOCATED.items())
            raise ValueError(f"is the {self.type} {self.key!r}; the aids that are located are {known}")
        return self


class CorridorAsked(Strict):
    """The space that the implant needs: its diameter, the bone kept around it, and where it may leave the bone."""

    implant_mm: Millimetres
    margin_mm: Annotated[float, Field(allow_inf_nan=False, ge=0, le=50)]
    may_leave_bone: Annotated[tuple[Literal["entry", "end"], ...], Field(max_length=2)]
    source: Text


class Catalogue(Strict):
    """Implants: lengths and diameters, mm, length of the thread, and angles of plates, ° (empty without plates).

    `along_wire`: whether an implant reaches from the entry to the end point, so that its length follows from the wire.
    """

    implants: Name
    along_wire: bool
    lengths_mm: Annotated[tuple[Millimetres, ...], Field(min_length=1, max_length=100)]
    diameters_mm: Annotated[tuple[Millimetres, ...], Field(min_length=1, max_length=20)]
    thread_mm: Millimetres | None = None
    plate_angles_deg: Annotated[tuple[Annotated[float, Field(ge=90, le=180)], ...], Field(max_length=20)] = ()
    source: Text

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        for name in ("lengths_mm", "diameters_mm", "plate_angles_deg"):
            values = getattr(self, name)
            if list(values) != sorted(set(values)):
                raise ValueError(f"{name} must ascend, each value once; sort them")
        return self


class ProposalAsked(Strict):
    """The rule of a proposed wire.

    `angle_deg`: of "through-head" between wire and shaft, measured like the neck-shaft angle; of "through-pedicle" from
    the first view's beam towards the middle of the body. `under_surface_mm`: of the tip below the head's surface,
    behind the front of the body, or before the end of the drawn corridor.
    """

    rule: Literal["through-head", "through-corridor", "through-pedicle", "across-growth-plate", "through-rims"]
    angle_deg: Annotated[float, Field(ge=0, le=170)] | None = None
    under_surface_mm: Annotated[float, Field(gt=0, le=30)] | None = None
    source: Text

    @model_validator(mode="after")
    def _numbers(self) -> Self:
        _refuse_others(self, f"proposal {self.rule!r}", ("angle_deg", "under_surface_mm"), RULES[self.rule].takes)
        low, high = (90.0, 170.0) if self.rule == "through-head" else (0.0, 45.0)
        if self.angle_deg is not None and not low <= self.angle_deg <= high:
            raise ValueError(f"is the proposal {self.rule!r} at {self.angle_deg:g}°; give {low:g}° to {high:g}°")
        return self


class LimitAsked(Strict):
    """A limit and its source."""

    limit: Annotated[float, Field(allow_inf_nan=False, ge=0, le=1e3)]
    source: Text


class LimitsAsked(AsGiven):
    """Limits of the 95 % errors of position and direction, and how far past the end point the wire is drilled.

    `before_mm`: how far before an entry point within the bone the bone may begin.
    """

    position_mm: LimitAsked
    direction_deg: LimitAsked
    beyond_mm: LimitAsked
    before_mm: LimitAsked | None = None

    @model_validator(mode="after")
    def _above_zero(self) -> Self:
        if self.position_mm.limit <= 0 or not 0 < self.direction_deg.limit <= 90:
            raise ValueError("position_mm must be above zero, direction_deg above zero and at most 90")
        if self.before_mm is not None and not CLEAR_MM < self.before_mm.limit <= MAX_BEFORE_MM:
            raise ValueError(
                f"before_mm must be above {CLEAR_MM:g} and at most {MAX_BEFORE_MM:g}; leave it out where the entry "
                "point lies on the bone"
            )
        return self


class ProcedureDocument(Strict):
    """A procedure's file."""

    schema_: Annotated[Literal["sightline-procedure/1"], Field(alias="schema")]
    key: Key
    name: Name
    purpose: Text
    views: Annotated[tuple[WantedView, ...], Field(min_length=2, max_length=4)]
    wires: Annotated[tuple[WireAsked, ...], Field(min_length=1, max_length=6)]
    relations: Annotated[tuple[Relation, ...], Field(max_length=20)] = ()
    landmarks: Annotated[tuple[LandmarkAsked, ...], Field(min_length=2, max_length=10)]
    aids: Annotated[tuple[AidAsked, ...], Field(max_length=10)] = ()
    directions: Annotated[tuple[BoneDirection, ...], Field(max_length=3)] = ()
    corridor: CorridorAsked | None = None
    catalogue: Catalogue | None = None
    proposal: ProposalAsked | None = None
    limits: LimitsAsked
    checks: Annotated[tuple[CheckRule, ...], Field(max_length=30)] = ()

    @model_serializer(mode="wrap")
    def _as_given(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out directions that are not given, so that files without them keep their fingerprints."""
        return {key: value for key, value in write(self).items() if key != "directions" or value}

    @property
    def given(self) -> tuple[str, ...]:
        """Keys of the landmarks, then of the aids."""
        return tuple(asked.key for asked in (*self.landmarks, *self.aids))

    @property
    def drilling_order(self) -> tuple[str, ...]:
        """Keys of all wires: those of the relation "order" first, then the others as the file lists them."""
        first = [key for relation in self.relations if relation.relation == "order" for key in relation.wires]
        return tuple(dict.fromkeys([*first, *(wire.key for wire in self.wires)]))

    @property
    def through_holes(self) -> bool:
        """Whether the wires run through the holes of a nail: the file proposes them through rims."""
        return self.proposal is not None and self.proposal.rule == "through-rims"

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        views, wires = ([view.name for view in self.views], [wire.key for wire in self.wires])
        for what, keys in (
            ("views", views),
            ("wires", wires),
            ("landmarks and aids", self.given),
            ("checks", [rule.check for rule in self.checks]),
        ):
            if twice := sorted({key for key in keys if keys.count(key) > 1}):
                raise ValueError(f"{twice[0]!r} occurs twice in the {what}; give each a key of its own")
        for relation in self.relations:
            if unknown := [key for key in relation.wires if key not in wires]:
                raise ValueError(f"a relation names the wire {unknown[0]!r}; the wires are {', '.join(wires)}")
        for aid in self.aids:
            first = tuple(views[: len(aid.views)])
            alone = aid.type == "plane" and len(aid.views) == 1 and set(aid.views) <= set(views)
            if aid.views != first and not alone:
                raise ValueError(
                    f"the aid {aid.key!r} is drawn in {', '.join(aid.views)}; name views from the first on"
                )
            if len(aid.views) < 2 and aid.type in CLICKS and aid.type != "plane":
                raise ValueError(f"the aid {aid.key!r} is a {aid.type} drawn in one view; name two")
        for rule in self.checks:
            needs = CHECKS[rule.check].needs
            by_bone = rule.check == "side" and len(self.directions) == 3
            if rule.optional is None and needs and not by_bone and not any(keys <= set(self.given) for keys in needs):
                wanted = ", or ".join(" and ".join(sorted(keys)) for keys in needs)
                raise ValueError(
                    f"requires the check {rule.check!r}, which needs {wanted}: add it to aids or landmarks, or say in "
                    "'optional' why a plan may do without the check"
                )
        needed = -inf if self.corridor is None else self.corridor.implant_mm / 2 + self.corridor.margin_mm
        for rule in self.checks:
            if rule.check in IN_CORRIDOR and rule.range[0] < needed:
                raise ValueError(
                    f"has the check {rule.check!r} from {rule.low:g} mm, less than half of implant_mm and margin_mm of "
                    f"its corridor, {needed:g} mm; raise it"
                )
        return self

    @model_validator(mode="after")
    def _directed(self) -> Self:
        """Refuse directions of unknown parts, and those that do not determine how the bone lies."""
        points = {"entry", "end", *(landmark.key for landmark in self.landmarks)}
        drawn = [aid for aid in self.aids if len(aid.views) > 1 or aid.key in LOCATED]
        aids = {aid.key: aid.type for aid in drawn if aid.type != "oval tube"}
        for direction in self.directions:
            if unknown := [key for key in (*direction.from_, *direction.to) if key not in points | aids.keys()]:
                raise ValueError(
                    f"a direction names {unknown[0]!r}; name 'entry', 'end', a landmark, or an aid drawn in two "
                    "images that is not an oval tube"
                )
            if direction.along is not None and aids.get(direction.along, "point") in ("point", "sphere"):
                raise ValueError(
                    f"a direction runs along {direction.along!r}; name a line, plane, cylinder, tube or rim pair"
                )
        nominal = np.array([direction.nominal for direction in self.directions])
        if len(nominal) == 1 or (len(nominal) and np.linalg.svd(nominal)[1][-1] < _MIN_SINGULAR):
            raise ValueError(
                "the directions must be two or three, at large angles to each other: the first two tell how the bone "
                "lies, the third its side"
            )
        return self

    @model_validator(mode="after")
    def _proposable(self) -> Self:
        rule = None if self.proposal is None else self.proposal.rule
        needed = {key for wire in self.wires for key in (() if rule is None else RULES[rule].of_wire(wire.key))}
        if lacking := sorted(needed - {aid.key for aid in self.aids}):
            raise ValueError(f"the proposal {rule!r} needs the aids {', '.join(lacking)}; add them")
        return self


def open_ends(document: ProcedureDocument) -> list[str]:
    """Return "entry", "end" where the corridor says that it lies in the bone, but no check of the file shows it."""
    asked, corridor = {rule.check for rule in document.checks}, document.corridor
    inside = (
        {} if corridor is None else {e: shown for e, shown in END_CHECKS.items() if e not in corridor.may_leave_bone}
    )
    return [end for end, shown in inside.items() if not asked & shown]
