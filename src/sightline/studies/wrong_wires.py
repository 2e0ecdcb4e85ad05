"""Right wires, and the kinds of wrong plan that are made of them.

How far a wrong plan is beyond its limit is stated in the 95 % error of the check that must catch it. Kinds and sizes
were fixed before any check was tuned on them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sightline.common.geometry.covariance import TWO_SIDED_95, response
from sightline.common.geometry.lines import across, unit
from sightline.errors import SetUpError
from sightline.planning import Anatomy, Plan
from sightline.planning.bone.metrics import metric
from sightline.planning.procedures.document import CHECKS, CheckRule
from sightline.planning.verdict.bone_checks import MEASURES, measures
from sightline.planning.verdict.view_directions import Located
from sightline.twin.anatomy.bone_model import MAX_LONGER_MM, BoneModel, smallest_amount
from sightline.twin.anatomy.femur import NARROWEST, Femur

HIP_SCREW, CANNULATED = "hip-screw", "cannulated-hip-screws:inferior"
PEDICLE, SACRAL, EPIPHYSIS = "pedicle-screw", "iliosacral-screw", "slipped-epiphysis-pin"
INTERLOCKING = "distal-interlocking:distal"
SOLID_ONLY = (SACRAL, INTERLOCKING)  # no plates show them; those of the others stand in their directions
# Sizes: uniform between the first two for NEAR_SHARE of the plans, else between the last two. Kinds without a size
# (exchanged points, the other side) are far beyond: with them half of all plans lie within NEAR_TIMES.
MIN_TIMES, NEAR_TIMES, MAX_TIMES, NEAR_SHARE = 3.1, 5.0, 15.0, 0.75
MAX_AMOUNT = MAX_LONGER_MM  # mm or degrees
# Right wires [ours]: angle to the shaft, °; direction, ° s.d.; beside the head's centre, mm s.d. per axis; short of the
# head's surface, mm; share of the way to the neck's limit at which a cannulated screw lies.
ANGLE_DEG, FREEHAND_DEG, ASIDE_MM, SHORT_MM, SPREAD = (130.0, 140.0), 2.0, 1.5, (5.0, 10.0), (0.3, 0.9)
SCREW_ROOM_MM = 6.65  # of a cannulated screw's axis to the neck's surface, its procedure's limit
NEAR_MM, NEAR_DEG = 0.5, 1.0  # a right wire of another bone off its standard one: s.d. per axis of place, direction
LATERAL, CAUDAL, ANTERIOR = np.eye(3)
# Makes of a bone, a right wire (2, 3) and an amount a wrong wire, anatomical coordinates.
Change = Callable[[Any, np.ndarray, float], np.ndarray]


def right_wire(rng: np.random.Generator, bone: Femur | BoneModel, procedure: str) -> np.ndarray:
    """Draw a wire (2, 3) as a surgeon would plan it, anatomical coordinates. Raises SetUpError."""
    if isinstance(bone, BoneModel):
        entry, end = bone.wires_mm[0] + NEAR_MM * rng.standard_normal(3)
        turned = unit(_along(np.stack([entry, end])) + np.deg2rad(NEAR_DEG) * rng.standard_normal(3))
        return np.stack([end - np.linalg.norm(end - entry) * turned, end])
    return _right_hip_wire(rng, bone, procedure)


def _right_hip_wire(rng: np.random.Generator, femur: Femur, procedure: str) -> np.ndarray:
    short = rng.uniform(*SHORT_MM)
    if procedure == CANNULATED:
        along = femur.towards_head
        aside = unit(across(rng.standard_normal(3), along))
        through = rng.uniform(*SPREAD) * (NARROWEST * femur.neck_radius_mm - SCREW_ROOM_MM) * aside
    else:
        along = _along(np.stack(femur.wire_mm(rng.uniform(*ANGLE_DEG))))
        through = ASIDE_MM * rng.standard_normal(3)
    along = unit(along + np.deg2rad(FREEHAND_DEG) * rng.standard_normal(3))
    return wire_through(femur, through, along, short)


def wire_through(femur: Femur, through_mm: np.ndarray, along: np.ndarray, short_mm: float) -> np.ndarray:
    """Return the wire (2, 3) through a point (3,) along a unit vector (3,), from the lateral surface to `short_mm`
    below the nearest surface of the head. Raises SetUpError."""
    middle = across(through_mm, along)
    reach2 = (femur.head_radius_mm - short_mm) ** 2 - middle @ middle
    if reach2 <= 0.0:
        raise SetUpError("the wire passes beside the head")
    return np.stack([femur.entry_mm(middle, along), middle + np.sqrt(reach2) * along])


@dataclass(frozen=True, eq=False)
class KnownBone:
    """What a plan knows of the bone and the wire.

    `marks_mm` (3L,): named landmarks, in the order of `names`; `covariance` (n + 3L, n + 3L), mm², of `anatomy.values`
    and these. The errors of a landmark and of an aid are taken as independent.
    """

    anatomy: Anatomy
    side: str
    names: tuple[str, ...]
    marks_mm: np.ndarray
    covariance: np.ndarray
    lying: Located

    @staticmethod
    def of(made: Plan) -> "KnownBone":
        """Return what a plan with a side, drawn aids and stated errors knows."""
        anatomy, joint = made.anatomy, made.seen.joint_covariance_mm2
        assert anatomy is not None and anatomy.covariance is not None and joint is not None and made.side is not None  # noqa: S101
        n, marks = len(anatomy.values), made.seen.xyz_mm[2:].ravel()
        covariance = np.zeros((n + len(marks),) * 2)
        covariance[:n, :n], covariance[n:, n:] = anatomy.covariance, joint[6:, 6:]
        covariance[anatomy.at["wire"], n:] = joint[:6, 6:]
        covariance[n:, anatomy.at["wire"]] = joint[6:, :6]
        lying = Located(made.kind, made.views, anatomy, made.landmark_names, made.side)
        return KnownBone(anatomy, made.side, made.landmark_names, marks, covariance, lying)

    def _by_bone(self, rule: CheckRule) -> tuple[float, float] | None:
        """Return how far the value of a check that `Located` makes lies beyond its limit, and its 95 % error."""
        lying = replace(self.lying, anatomy=self.anatomy)
        if rule.check == "view directions":
            if lying.unknown_directions:
                return -np.inf, np.nan
            worst = lying.worst_view()
            return worst.away_deg - worst.wanted.within_deg, worst.error_deg
        if rule.check == "side" and len(lying.procedure.document.directions) == 3:
            value, error = (np.inf, np.nan) if lying.unknown_side else lying.beside()
            return -value, error
        return None

    def with_wire(self, wire_mm: np.ndarray) -> "KnownBone":
        """Return the same bone with another wire (2, 3), CFCS."""
        values = self.anatomy.values.copy()
        values[self.anatomy.at["wire"]] = wire_mm.ravel()
        return replace(self, anatomy=replace(self.anatomy, values=values))

    def beyond(self, rule: CheckRule) -> float:
        """Return how far the value of a check lies beyond its limits: negative inside, -inf where it is not made."""
        if (by_bone := self._by_bone(rule)) is not None:
            return by_bone[0]
        if rule.check not in MEASURES:
            value = metric(self.anatomy, rule.check, self.side).value
            return -np.inf if value is None else _beyond(value, rule)
        marks = dict(zip(self.names, self.marks_mm.reshape(-1, 3), strict=True))
        entry, end = self.anatomy.part("wire").reshape(2, 1, 3)
        made = measures(self.anatomy, (rule,), self.side, marks)
        return max((_beyond(float(measure.value(entry, end)[0]), rule) for measure in made), default=-np.inf)

    def error_95(self, rule: CheckRule) -> float:
        """Return the 95 % error of the value of a check."""
        if (by_bone := self._by_bone(rule)) is not None:
            return by_bone[1]
        if rule.check not in MEASURES:
            sd = metric(self.anatomy, rule.check, self.side).sd
            return np.nan if sd is None else TWO_SIDED_95 * sd
        n = len(self.anatomy.values)
        at = np.concatenate([self.anatomy.values, self.marks_mm])
        unused = {k for part in ("neck", "outline") if part in self.anatomy.at for k in range(n)[self.anatomy.at[part]]}
        used = [k for k in range(len(at)) if k not in unused]

        def of(rows: np.ndarray) -> np.ndarray:
            whole = np.tile(at, (len(rows), 1))
            whole[:, used] = rows
            bones = [
                replace(self, anatomy=replace(self.anatomy, values=values[:n]), marks_mm=values[n:]) for values in whole
            ]
            return np.array([[bone.beyond(rule)] for bone in bones])

        _, own = response(of, at[used])
        return TWO_SIDED_95 * float(np.sqrt(own[0] @ self.covariance[np.ix_(used, used)] @ own[0]))

    def times_beyond(self, rule: CheckRule) -> float:
        """Return `beyond` in units of its 95 % error."""
        beyond = self.beyond(rule)
        return beyond / self.error_95(rule) if np.isfinite(beyond) else beyond


def _beyond(value: float, rule: CheckRule) -> float:
    """Return how far a value lies beyond the limits of a rule; those without limits are of values above zero."""
    low, high = rule.range if CHECKS[rule.check].limits else (0.0, np.inf)
    return max(low - value, value - high)


@dataclass(frozen=True)
class WrongKind:
    """A kind of wrong plan of a `procedure`.

    `check`: the check of the procedure's file whose limit it violates; `also`: others that the same wire violates.
    `wire`: makes the wrong wire; None for a kind without a size: `exchanged` points or the `other_side`.
    `undrawn`: aids that are left out. `turned`: the wire is right, and one image is taken from a wrong direction.
    """

    name: str
    procedure: str
    check: str
    wire: Change | None = None
    also: tuple[str, ...] = ()
    exchanged: bool = False
    other_side: bool = False
    undrawn: tuple[str, ...] = ()
    turned: bool = False

    def side(self, side: str) -> str:
        """Return the side that is stated for a hip of a side."""
        return {"right": "left", "left": "right"}[side] if self.other_side else side

    def wrong_wire(
        self, bone: Any, wire_mm: np.ndarray, times: float, rule: CheckRule, at: Callable[[np.ndarray], KnownBone]
    ) -> np.ndarray:
        """Return the wire (2, 3) that lies beyond the limit of `rule` by so many times the check's 95 % error.

        `at`: the bone as known with an anatomical wire. Raises SetUpError where no wire within MAX_AMOUNT does.
        """
        make = self.wire
        if make is None:
            return wire_mm[::-1] if self.exchanged else wire_mm
        made, error = wire_mm, at(wire_mm).error_95(rule)
        for _ in range(2):  # the error of the wrong wire differs a little
            wanted = times * error
            amount = smallest_amount(lambda s: at(make(bone, wire_mm, s)).beyond(rule), wanted, MAX_AMOUNT)
            if amount is None:
                raise SetUpError(f"this bone has no wrong wire of the kind {self.name!r}")
            made = make(bone, wire_mm, amount)
            error = at(made).error_95(rule)
        return made


def draw_times(rng: np.random.Generator) -> float:
    """Draw the size of a violation, in 95 % errors."""
    near = rng.random() < NEAR_SHARE
    return float(rng.uniform(MIN_TIMES, NEAR_TIMES) if near else rng.uniform(NEAR_TIMES, MAX_TIMES))


def along_itself(entry: float, end: float) -> Change:
    """Return the change that moves entry and end along the wire by these multiples of an amount, mm."""
    return lambda bone, wire_mm, amount: wire_mm + amount * np.outer([entry, end], _along(wire_mm))


def shifted(entry: float, end: float, towards: np.ndarray) -> Change:
    """Return the change that moves entry and end in a direction (3,) by these multiples of an amount, mm."""
    return lambda bone, wire_mm, amount: wire_mm + amount * np.outer([entry, end], towards)


def flatter(femur: Femur, wire_mm: np.ndarray, amount: float) -> np.ndarray:
    """Return the wire to the same end at an angle to the shaft that is smaller by an amount, °."""
    along = _along(wire_mm)
    turn = np.deg2rad(amount)
    along = np.cos(turn) * along + np.sin(turn) * unit(across(CAUDAL, along))
    return np.stack([femur.entry_mm(across(wire_mm[1], along), along), wire_mm[1]])


def beside_neck(femur: Femur, wire_mm: np.ndarray, amount: float) -> np.ndarray:
    """Return the wire farther from the neck's axis by an amount, mm, with its tip as deep below the head's surface."""
    along, short = _along(wire_mm), femur.head_radius_mm - float(np.linalg.norm(wire_mm[1]))
    middle = across(wire_mm[1], along)
    return wire_through(femur, middle + amount * unit(middle), along, short)


def aside(towards: np.ndarray) -> Change:
    """Return the change that moves a wire across itself, in a direction (3,), by an amount, mm."""
    return lambda bone, wire_mm, amount: wire_mm + amount * unit(across(towards, _along(wire_mm)))


def tilted(bone: Any, wire_mm: np.ndarray, amount: float) -> np.ndarray:
    """Return the wire with its entry moved towards the head's side so that it turns about its end by an amount, °."""
    entry, end = wire_mm
    by = np.tan(np.deg2rad(amount)) * np.linalg.norm(end - entry) * unit(across(-CAUDAL, _along(wire_mm)))
    return np.stack([entry + by, end])


deeper_end, shorter_end = along_itself(0.0, 1.0), along_itself(0.0, -1.0)
deeper_entry, entry_in_air = along_itself(1.0, 0.0), along_itself(-1.0, 0.0)
_IN_WINDOW = ("tip to bone nearest", "tip to bone along wire")
KINDS = (
    WrongKind("entry and end exchanged", HIP_SCREW, "entry and end", exchanged=True),
    WrongKind("the other side", HIP_SCREW, "side", also=("view directions",), other_side=True),
    WrongKind("tip through the joint's surface", HIP_SCREW, "tip in head", deeper_end, also=_IN_WINDOW),
    WrongKind("tip too near to the joint", CANNULATED, "tip to bone nearest", deeper_end, also=_IN_WINDOW[1:]),
    WrongKind("tip too far from the apex", HIP_SCREW, "tip-apex distance", shorter_end, also=_IN_WINDOW),
    WrongKind(
        "shorter than any implant",
        HIP_SCREW,
        "wire length",
        shorter_end,
        also=("tip-apex distance", "tip in head", *_IN_WINDOW),
    ),
    WrongKind(
        "entry inside the bone",
        HIP_SCREW,
        "entry below cortex",
        deeper_entry,
        also=("lateral of lesser trochanter",),
    ),
    WrongKind(
        "entry inside the bone, no cortex drawn",
        HIP_SCREW,
        "lateral of lesser trochanter",
        deeper_entry,
        also=("entry below cortex", "entry outside cortex"),
        undrawn=("cortex",),
    ),
    WrongKind("entry in air", HIP_SCREW, "entry outside cortex", entry_in_air),
    WrongKind(
        "entry behind the bone",
        HIP_SCREW,
        "anterior of lesser trochanter",
        shifted(1.0, 0.0, -ANTERIOR),
        also=("entry outside cortex", "wire off neck axis"),
    ),
    WrongKind(
        "flatter than any plate",
        HIP_SCREW,
        "wire to shaft",
        flatter,
        also=("entry outside cortex", "wire off neck axis"),
    ),
    WrongKind("screw leaves the neck", CANNULATED, "wire in neck", beside_neck),
    WrongKind("screw leaves the pedicle towards the canal", PEDICLE, "wire in pedicle", aside(-LATERAL)),
    WrongKind("screw leaves the pedicle downwards", PEDICLE, "wire in pedicle", aside(CAUDAL)),
    WrongKind("entry inside the pedicle", PEDICLE, "entry to pedicle", deeper_entry),
    WrongKind("entry off the vertebra", PEDICLE, "entry to pedicle", entry_in_air),
    WrongKind("tip in front of the vertebra", PEDICLE, "tip behind front", deeper_end),
    WrongKind("tip in the disc", PEDICLE, "tip to endplates", shifted(0.0, 1.0, -CAUDAL), also=("wire in pedicle",)),
    WrongKind("screw leaves the sacrum in front", SACRAL, "wire in sacral corridor", aside(ANTERIOR)),
    WrongKind("screw in the sacral foramen", SACRAL, "wire in sacral corridor", aside(CAUDAL)),
    WrongKind("tip beyond the drawn sacrum", SACRAL, "tip in sacral corridor", deeper_end),
    WrongKind("epiphysis: tip too near to the joint", EPIPHYSIS, "tip to bone nearest", deeper_end),
    WrongKind(
        "epiphysis: pin oblique to its plate",
        EPIPHYSIS,
        "wire to growth plate",
        tilted,
        also=("wire off middle of growth plate", "side"),
    ),
    WrongKind(
        "epiphysis: pin off its middle",
        EPIPHYSIS,
        "wire off middle of growth plate",
        aside(CAUDAL),
        also=("tip to bone nearest",),
    ),
    WrongKind("epiphysis: pin hardly across its plate", EPIPHYSIS, "tip beyond growth plate", shorter_end),
    WrongKind("vertebra: the other side", PEDICLE, "side", also=("view directions",), other_side=True),
    WrongKind("sacrum: the other side", SACRAL, "side", also=("view directions",), other_side=True),
    WrongKind("epiphysis: the other side", EPIPHYSIS, "side", also=("view directions",), other_side=True),
    WrongKind(
        "vertebra: view from a wrong direction",
        PEDICLE,
        "view directions",
        also=("angle between views", "wire in pedicle", "entry to pedicle", "tip behind front"),
        turned=True,
    ),
    WrongKind(
        "sacrum: view from a wrong direction",
        SACRAL,
        "view directions",
        also=("angle between views", "wire in sacral corridor", "tip in sacral corridor", "side"),
        turned=True,
    ),
    WrongKind(
        "epiphysis: view from a wrong direction",
        EPIPHYSIS,
        "view directions",
        also=("angle between views",),
        turned=True,
    ),
    WrongKind(
        "hip: view from a wrong direction", HIP_SCREW, "view directions", also=("angle between views",), turned=True
    ),
    WrongKind("vertebra: longer than any implant", PEDICLE, "wire length", entry_in_air, also=("entry to pedicle",)),
    WrongKind("hip screw: tip too near to the joint", HIP_SCREW, "tip to bone nearest", deeper_end, also=_IN_WINDOW),
    WrongKind("hip screw: tip too deep under the joint", HIP_SCREW, "tip to bone along wire", shorter_end),
    WrongKind(
        "hip screw: tip too deep under the joint, no neck drawn",
        HIP_SCREW,
        "tip to bone along wire",
        shorter_end,
        also=("tip-apex distance", "wire off neck axis", "view directions"),
        undrawn=("neck",),
    ),
    WrongKind(
        "hip screw leaves the neck in front",
        HIP_SCREW,
        "wire off neck axis",
        shifted(1.0, 0.0, ANTERIOR),
        also=("anterior of lesser trochanter", "entry below cortex", "entry outside cortex"),
    ),
    WrongKind("cannulated: tip too deep under the joint", CANNULATED, "tip to bone along wire", shorter_end),
    WrongKind(
        "cannulated: entry below the lesser trochanter",
        CANNULATED,
        "above lesser trochanter",
        shifted(1.0, 0.0, CAUDAL),
        also=("wire in neck", "wire to shaft", "entry below cortex", "entry outside cortex"),
    ),
    WrongKind("vertebra: tip hardly in the body", PEDICLE, "tip short of front", shorter_end, also=("wire length",)),
    WrongKind("sacrum: tip short of the body of S1", SACRAL, "tip past promontory", shorter_end),
    WrongKind("sacrum: entry inside the ilium", SACRAL, "entry to cortex", deeper_entry),
    WrongKind("sacrum: entry off the ilium", SACRAL, "entry to cortex", entry_in_air, also=("wire length",)),
    WrongKind("epiphysis: entry inside the bone", EPIPHYSIS, "entry to cortex", deeper_entry, also=("wire length",)),
    WrongKind("epiphysis: entry in air", EPIPHYSIS, "entry to cortex", entry_in_air, also=("wire length",)),
    WrongKind("interlocking: near and far hole exchanged", INTERLOCKING, "entry from lateral", exchanged=True),
    WrongKind("interlocking: end past the far hole", INTERLOCKING, "wire length", deeper_end),
)


def _along(wire_mm: np.ndarray) -> np.ndarray:
    return unit(wire_mm[1] - wire_mm[0])
