"""Checks: a value against its limit, with a sentence for the user."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import radians
from typing import Any, Self

# Probability with which something that is right is refused: once in 10,000 views, frames or fits a correct bead is left
# out or a check fails [ours]. More often it would be a nuisance; more rarely, larger errors would pass.
FALSE_ALARM = 1e-4
# An entry point within the bone, such as a nail's wall, lies at least so far in it: four standard deviations of a
# planned entry along the wire. At most: half of a large femur above the knee [ours].
CLEAR_MM, MAX_BEFORE_MM = 2.0, 40.0


class CheckCode(StrEnum):
    """What a check is about. Programs decide by it; names and sentences are for people. A code is never reused."""

    BEAD_COUNT = "bead-count"
    BEAD_COVERAGE = "bead-coverage"
    LEAVE_ONE_OUT_ERROR = "leave-one-out-error"
    WRONG_BEADS = "wrong-beads"
    FRAME_TOLERANCES = "frame-tolerances"
    CHI_SQUARE = "chi-square"
    IMAGE_ROWS = "image-rows"
    BALL_SIZE = "ball-size"
    SOURCE_DISTANCE = "source-distance"
    FOCAL_LENGTH = "focal-length"
    PANEL_DISTORTION = "panel-distortion"
    INTENSIFIER_DISTORTION = "intensifier-distortion"
    BALL_ERROR = "ball-error"
    PRINCIPAL_POINT = "principal-point"
    FOCAL_LENGTH_BEFORE = "focal-length-before"
    MEASUREMENT_NOISE = "measurement-noise"
    FRAME_HANDEDNESS = "frame-handedness"
    MAP_MISFIT = "map-misfit"
    CLIPPED_PIXELS = "clipped-pixels"
    COMPRESSION = "compression"
    INVERSION = "inversion"
    DOUBLE_IMAGE = "double-image"
    MOVEMENT_BLUR = "movement-blur"
    ERROR_KNOWN = "error-known"
    ENTRY_ERROR = "entry-error"
    END_ERROR = "end-error"
    DIRECTION_ERROR = "direction-error"
    GAP = "gap"
    BEADS_NEAR = "beads-near"
    PICK_SPREAD = "pick-spread"
    MOVEMENT = "movement"
    PLAN_INSIDE_HULL = "plan-inside-hull"
    HEAD_AGREEMENT = "head-agreement"
    HOLE_AGREEMENT = "hole-agreement"
    HOLE_RIMS_USED = "hole-rims-used"
    HOLE_ACROSS_THE_NAIL = "hole-across-the-nail"
    SIDE = "side"
    HEAD = "head"
    ENTRY_AND_END = "entry-and-end"
    ENTRY_FROM_LATERAL = "entry-from-lateral"
    TIP_IN_HEAD = "tip-in-head"
    ENTRY_AT_CORTEX = "entry-at-cortex"
    WIRE_LENGTH = "wire-length"
    ANGLE_BETWEEN_VIEWS = "angle-between-views"
    TIP_APEX_DISTANCE = "tip-apex-distance"
    CALCAR_TIP_APEX_DISTANCE = "calcar-tip-apex-distance"
    TIP_TO_BONE_ALONG_WIRE = "tip-to-bone-along-wire"
    TIP_TO_BONE_NEAREST = "tip-to-bone-nearest"
    WIRE_IN_NECK = "wire-in-neck"
    WIRE_OFF_NECK_AXIS = "wire-off-neck-axis"
    WIRE_IN_SACRAL_CORRIDOR = "wire-in-sacral-corridor"
    TIP_IN_SACRAL_CORRIDOR = "tip-in-sacral-corridor"
    TIP_PAST_PROMONTORY = "tip-past-promontory"
    WIRE_IN_PEDICLE = "wire-in-pedicle"
    ENTRY_TO_PEDICLE = "entry-to-pedicle"
    ENTRY_TO_CORTEX = "entry-to-cortex"
    TIP_BEHIND_FRONT = "tip-behind-front"
    TIP_SHORT_OF_FRONT = "tip-short-of-front"
    TIP_TO_ENDPLATES = "tip-to-endplates"
    WIRE_TO_GROWTH_PLATE = "wire-to-growth-plate"
    WIRE_OFF_MIDDLE_OF_GROWTH_PLATE = "wire-off-middle-of-growth-plate"
    TIP_BEYOND_GROWTH_PLATE = "tip-beyond-growth-plate"
    VIEW_DIRECTIONS = "view-directions"
    WIRE_TO_SHAFT = "wire-to-shaft"
    ALL_WIRES = "all-wires"
    PARALLEL = "parallel"
    SPACING = "spacing"
    INVERTED_TRIANGLE = "inverted-triangle"
    SIDE_CONFIRMED = "side-confirmed"
    FRAME_CONFIRMED = "frame-confirmed"
    PLAN_AGE = "plan-age"
    WIRE_ENTRY = "wire-entry"
    WIRE_TIP = "wire-tip"
    WIRE_AT_FAR_HOLE = "wire-at-far-hole"
    WIRE_DIRECTION = "wire-direction"
    CHECK_SHOT_ERROR = "check-shot-error"
    BONE_LANDMARKS = "bone-landmarks"
    CHECK_SHOT_RESIDUALS = "check-shot-residuals"
    CHECK_SHOT_OUTLIER = "check-shot-outlier"
    WIRE_BOW = "wire-bow"
    WIRE_AHEAD = "wire-ahead"
    WIRE_DEPTH = "wire-depth"
    PLAN_GO = "plan-go"
    WIRE_ENTRY_ERROR = "wire-entry-error"
    WIRE_END_ERROR = "wire-end-error"
    WIRE_DIRECTION_ERROR = "wire-direction-error"
    WIRE_THROUGH_BOTH_WALLS = "wire-through-both-walls"
    POSE_AGE = "pose-age"
    ERRORS_AS_PREDICTED = "errors-as-predicted"
    FRAME_VIEWS = "frame-views"
    FRAME_IDS = "frame-ids"
    PLATE_BEADS = "plate-beads"
    PLATE_COLLINEAR = "plate-collinear"
    BEAD_OVERLAP = "bead-overlap"
    PLATE_FLAT = "plate-flat"
    PLATE_SPACING = "plate-spacing"
    DATUM_COUNT = "datum-count"
    DATUM_SIZE = "datum-size"
    DATUM_SYMMETRY = "datum-symmetry"
    PLATE_TWIN = "plate-twin"
    PLATE_TILT = "plate-tilt"
    PLATE_FIELD = "plate-field"
    WIRE_REACH = "wire-reach"
    SOLID_BEADS = "solid-beads"
    SOLID_EXTENT = "solid-extent"
    SOLID_CLEAR = "solid-clear"
    SOLID_WORST = "solid-worst"
    SOLID_SYMMETRY = "solid-symmetry"
    SOLID_FIELD = "solid-field"
    FRAME_BEFORE = "frame-before"
    MEASURED_IDS = "measured-ids"
    MEASURED_DIAMETERS = "measured-diameters"
    MEASURED_SERIES = "measured-series"
    MEASUREMENTS_LEFT_OUT = "measurements-left-out"
    MEASURED_TOLERANCE = "measured-tolerance"
    MEASURED_DEVIATION = "measured-deviation"
    IMAGE_MOVEMENT = "image-movement"
    SELF_CHECK_CHI_SQUARE = "self-check-chi-square"
    MISPLACED_BALLS = "misplaced-balls"
    JOINT_LIMITS = "joint-limits"
    PATIENT_CLEARANCE = "patient-clearance"
    TABLE_CLEARANCE = "table-clearance"
    C_ARM_CLEARANCE = "c-arm-clearance"
    FRAME_REMOUNT = "frame-remount"
    BONE_FIT = "bone-fit"
    BONE_SHAPE = "bone-shape"
    BONE_ELSEWHERE = "bone-elsewhere"
    BONE_IN_FIELD = "bone-in-field"
    BONE_MOVEMENT = "bone-movement"
    CASE_DATABASE = "case-database"
    CASE_CHAIN = "case-chain"
    CASE_ORIGINALS = "case-originals"
    CASE_REPLAY = "case-replay"


def code_key(name: str) -> str:
    """Return the value of the code of a check, by its heading in docs/refusals.md."""
    return name.lower().replace(" ", "-")


@dataclass(frozen=True)
class Check:
    """One named check.

    `name` is a key of docs/refusals.md; `figure` (the value) and `limit` are in `unit`. `figure` is None where the
    check is not a measurement, or the value could not be measured; in the latter case the check fails. `missing`: the
    check failed because an input is missing that a person can give. `view`: of the image that the check is about, ""
    for others. `error_95`: the 95 % error of the value, where the check judges the value with it; `is_minimum`: whether
    the limit is then a lower one, which value and verdict do not tell. `code`: what the check is about, for programs.
    """

    name: str
    passed: bool
    figure: float | None
    limit: float | None
    unit: str
    sentence: str
    missing: bool = False
    view: str = ""
    error_95: float | None = None
    is_minimum: bool | None = None
    code: CheckCode = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "code", CheckCode(code_key(self.name)))

    @property
    def value_text(self) -> str:
        """The value with its unit; empty where the check is not a measurement, "not measured" where it could not be."""
        if self.figure is None:
            return "" if self.passed else "not measured"
        return _with_unit(self.figure, self.unit)

    @property
    def informs(self) -> bool:
        """Whether a value without a limit is stated for information, such as what was left out or assumed."""
        return self.passed and self.limit is None and self.figure is not None

    @property
    def limit_text(self) -> str:
        """The limit with its unit and its direction, "at most" or "at least"; empty without one."""
        if self.limit is None:
            return ""
        limit = _with_unit(self.limit, self.unit)
        if self.is_minimum is None and (self.figure is None or (self.figure == self.limit and self.limit)):
            return limit  # either direction may be meant
        return f"{'at least' if self.bounds_below else 'at most'} {limit}"

    @property
    def bounds_below(self) -> bool:
        """Whether the limit is a lower one; without `is_minimum` value and verdict tell."""
        if self.is_minimum is not None or self.figure is None or self.limit is None:
            return bool(self.is_minimum)
        return self.passed != (self.figure <= self.limit)

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Self:
        """Return the check of a JSON document; those of version 0.1.0 lack `code`, `missing` and `view`."""
        return cls(**{key: document[key] for key in cls.__dataclass_fields__ if key in document and key != "code"})

    def of_view(self, view: str) -> Self:
        """Return the check as that of a view, which its sentence then names."""
        return replace(self, view=view, sentence=f"{view}: {self.sentence}")


def _with_unit(value: float, unit: str) -> str:
    return f"{value:.{3 if abs(value) < 1000 else 6}g}{'' if unit in {'', '°'} else ' '}{unit}"


@dataclass(frozen=True)
class Limits:
    """Limits of a procedure: of the predicted 95 % errors of position and direction.

    `beyond_mm`: how far the drill goes past the end point. `before_mm`: bone begins up to this far before the entry
    point, which then lies in the bone; 0: the entry lies on the bone. The defaults are what the paper reached with its
    robot [paper].
    """

    position_mm: float = 1.0
    direction_rad: float = radians(0.6)
    beyond_mm: float = 0.0
    before_mm: float = 0.0

    @property
    def through_walls(self) -> bool:
        """Whether the drill passes both of its points within the bone, as through a nail's walls."""
        return self.before_mm > 0 and self.beyond_mm > 0


def failed(checks: Iterable[Check]) -> tuple[Check, ...]:
    """Return the failed checks, in order."""
    return tuple(check for check in checks if not check.passed)


# Checks of where the wire lies in the bone [ours]: what a surgeon corrects first.
OF_BONE = frozenset(
    {
        CheckCode.SIDE,
        CheckCode.HEAD,
        CheckCode.HEAD_AGREEMENT,
        CheckCode.ENTRY_AND_END,
        CheckCode.ENTRY_FROM_LATERAL,
        CheckCode.TIP_IN_HEAD,
        CheckCode.ENTRY_AT_CORTEX,
        CheckCode.ENTRY_TO_CORTEX,
        CheckCode.WIRE_LENGTH,
        CheckCode.TIP_APEX_DISTANCE,
        CheckCode.CALCAR_TIP_APEX_DISTANCE,
        CheckCode.TIP_TO_BONE_ALONG_WIRE,
        CheckCode.TIP_TO_BONE_NEAREST,
        CheckCode.WIRE_IN_NECK,
        CheckCode.WIRE_OFF_NECK_AXIS,
        CheckCode.WIRE_TO_SHAFT,
        CheckCode.WIRE_IN_SACRAL_CORRIDOR,
        CheckCode.TIP_IN_SACRAL_CORRIDOR,
        CheckCode.TIP_PAST_PROMONTORY,
        CheckCode.WIRE_IN_PEDICLE,
        CheckCode.ENTRY_TO_PEDICLE,
        CheckCode.TIP_BEHIND_FRONT,
        CheckCode.TIP_SHORT_OF_FRONT,
        CheckCode.TIP_TO_ENDPLATES,
        CheckCode.WIRE_TO_GROWTH_PLATE,
        CheckCode.WIRE_OFF_MIDDLE_OF_GROWTH_PLATE,
        CheckCode.TIP_BEYOND_GROWTH_PLATE,
    }
)


def advised(checks: Iterable[Check]) -> tuple[Check, ...]:
    """Return the failed checks in the order in which a person acts on them: what is wrong before what is missing, and
    of either the wire in the bone before beads and errors."""
    return tuple(sorted(failed(checks), key=lambda check: (check.missing, check.code not in OF_BONE)))


def at_most(name: str, value: float, limit: float, unit: str, states: str, *, otherwise: str) -> Check:
    """Return the check that a value is at most its limit. Its sentence `states` the value; where the check fails it
    goes on with `otherwise`, which says what to do."""
    passed = bool(value <= limit)
    return Check(name, passed, value, limit, unit, states + ("." if passed else otherwise))


def at_least(name: str, value: float, limit: float, unit: str, states: str, *, otherwise: str) -> Check:
    """Return the check that a value is at least its limit, as `at_most`."""
    passed = bool(value >= limit)
    return Check(name, passed, value, limit, unit, states + ("." if passed else otherwise))


def error_check(name: str, what: str, error_95: float, limit: float, unit: str, *, advice: str) -> Check:
    """Return the check of a 95 % error against its limit; a failure's sentence ends with `advice`."""
    passed = error_95 <= limit
    if passed:
        sentence = (
            f"With 95 % probability the error of the {what} is less than {error_95:.2f} {unit} (limit {limit:.2f} "
            f"{unit})."
        )
    else:
        shown = max(error_95, limit + 0.01)  # never rounded down to the limit that it exceeds
        sentence = (
            f"The 95 % error of the {what}, {shown:.2f} {unit}, is above its limit of {limit:.2f} {unit}; {advice}."
        )
    return Check(name, passed, error_95, limit, unit, sentence)
