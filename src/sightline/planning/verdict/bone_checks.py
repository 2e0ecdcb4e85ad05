"""Checks of a planned wire against the bone: side, order of entry and end, depth of the tip below the surface."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.common.checks import Check
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.planning.bone.anatomy import Anatomy
from sightline.planning.bone.directions import ANTERIOR, MEDIAL, caudal, lies
from sightline.planning.bone.metrics import Metric, metric, metric_of_wires, tip_depth
from sightline.planning.points.results import Verdict
from sightline.planning.procedures.document import (
    CHECKS,
    EPICONDYLE,
    HEAD_CENTRE,
    LANDMARKS,
    LESSER,
    PROMONTORY,
    CheckRule,
)

_LATERAL = -MEDIAL
_OF_HEAD = {"entry and end", "tip in head"}  # checks that ask for the head, for all that need it
# Names in a verdict of the checks that have another one in a procedure's file.
AT_CORTEX = (
    "head to entry",
    "lateral of lesser trochanter",
    "anterior of lesser trochanter",
    "above lesser trochanter",
    "entry below cortex",
    "entry outside cortex",
)
_NAMES: dict[str, str] = dict.fromkeys(AT_CORTEX, "entry at cortex")
# Range and step of the trial shifts of a point along a line of sight [ours]: farther, a point is outside the bone;
# the step is that of a plan's error.
MAX_SHIFT_MM, _STEP_MM = 60.0, 0.5


@dataclass(frozen=True)
class Measure:
    """A measure of the wire that must lie between `low` and `high`: `value` maps entry and end (K, 3) to (K,).

    `sentence` states the value; `otherwise` says what a value out of range means and what to do. `ways`: words of the
    sentence after a value in mm that is positive, and after one that is negative; else no value is negative.
    """

    name: str
    value: Callable[[np.ndarray, np.ndarray], np.ndarray]
    low: float
    high: float
    unit: str
    sentence: str
    otherwise: str
    ways: tuple[str, str] | None = None

    def passes(self, entry_mm: np.ndarray, end_mm: np.ndarray) -> np.ndarray:
        """Return (K,) bool for entries and ends (K, 3)."""
        values = self.value(entry_mm, end_mm)
        return (values >= self.low) & (values <= self.high)

    def check(self, entry_mm: np.ndarray, end_mm: np.ndarray) -> Check:
        """Return the check of one wire: entry and end (3,)."""
        value = float(self.value(entry_mm[None], end_mm[None])[0])
        limit = self.high if value > self.high or not np.isfinite(self.low) else self.low
        passed = self.low <= value <= self.high
        figure = f"{value:.1f}{'' if self.unit == '°' else ' '}{self.unit}"
        sentence = self.sentence.format(figure if self.ways is None else lies(value, self.ways))
        sentence += "." if passed else f"; {self.otherwise}."
        return Check(self.name, passed, value, float(limit), self.unit, sentence)


@dataclass(frozen=True, eq=False)
class _Bone:
    """What is known of the bone: the located parts, the side, and the landmarks (3,) by their keys."""

    anatomy: Anatomy
    side: str | None
    landmarks_mm: Mapping[str, np.ndarray]

    @property
    def centre_mm(self) -> np.ndarray | None:
        """The head's centre: of its outline, or else the landmark."""
        return self.landmarks_mm.get(HEAD_CENTRE) if self.anatomy.head is None else self.anatomy.head.centre_mm

    @cached_property
    def exchanged(self) -> bool:
        """True where the wire's ends are exchanged; then no measure of an end is meaningful."""
        entry, end = self.anatomy.part("wire").reshape(2, 3)
        return self.centre_mm is not None and not bool(_order(self.centre_mm).passes(entry[None], end[None])[0])

    def lacking(self, rule: CheckRule, known_missing: Collection[str] = ()) -> tuple[list[str], list[str]]:
        """Return what a check lacks, each with what to do: what was not drawn, picked or stated, and what was drawn
        but cannot be located. Of alternatives those of the first count. `known_missing`: not named again."""
        known, check = {*self.anatomy.at, *self.landmarks_mm}, CHECKS[rule.check]
        if any(needs <= known for needs in check.needs):
            parts = []
        else:
            parts = sorted(set(*check.needs[:1]) - known - set(known_missing))
        unpicked = [
            f"the landmark '{part}' is not picked: pick it in both images" for part in parts if part in LANDMARKS
        ]
        parts = [part for part in parts if part not in LANDMARKS]
        why = {part: self.anatomy.why_absent(part) for part in parts}
        waits = {part for part in parts if self.anatomy.undrawn(part) or part in self.anatomy.waiting}
        undrawn = unpicked + [why[part] for part in parts if part in waits]  # itself, or what it is located by
        refused = [why[part] for part in parts if part not in waits]
        with_side = check.side and (rule.check not in MEASURES or rule.check == "above lesser trochanter")
        if self.side is None and with_side and "side" not in known_missing:
            undrawn.append("the side is not given")
        return undrawn, refused


def judge_in_bone(
    anatomy: Anatomy, rules: Sequence[CheckRule], side: str | None, landmarks_mm: Mapping[str, np.ndarray]
) -> Verdict:
    """Return the checks of the wire in `found` against the bone that `rules` ask for.

    `landmarks_mm`: (3,) by their keys in the procedure. Raises UnusableInputError for an unknown side.
    """
    bone = _Bone(anatomy, side, landmarks_mm)
    checks = _unmade(bone, rules)
    if anatomy.head_agreement is not None:
        checks.append(anatomy.head_agreement)
    if "wire" in anatomy.at:
        entry, end = anatomy.part("wire").reshape(2, 3)
        checks += [measure.check(entry, end) for measure in measures(anatomy, rules, side, landmarks_mm)]
        checks += _of_metrics(bone, rules)
    return Verdict(tuple(checks))


def measures(
    anatomy: Anatomy, rules: Sequence[CheckRule], side: str | None, landmarks_mm: Mapping[str, np.ndarray]
) -> tuple[Measure, ...]:
    """Return all measures of the wire that the rules ask for and for which the bone is known well enough."""
    bone = _Bone(anatomy, side, landmarks_mm)
    asked = [rule for rule in rules if not bone.exchanged or rule.check in ("entry and end", "side")]
    return tuple(measure for rule in asked if rule.check in MEASURES for measure in MEASURES[rule.check](bone, rule))


def _of_metrics(bone: _Bone, rules: Sequence[CheckRule]) -> list[Check]:
    """Return the checks of metrics of the implant: the 95 % interval must lie within the limits."""
    checks = []
    for rule, known in _known_metrics(bone, rules):
        name, unit, (low, high) = rule.check, CHECKS[rule.check].unit, rule.range
        if known.value is None or known.sd is None:
            why = known.sentence if known.value is None else "Not known: the error of a view is not stated."
            checks.append(Check(name, False, None, rule.high, unit, f"The {name} cannot be judged. {why}"))
            continue
        error = TWO_SIDED_95 * known.sd
        passed = low <= known.value - error and known.value + error <= high
        nearer_high = high - known.value < known.value - low
        unbounded = passed and low == 0.0 and np.isfinite(high)  # zero bounds no distance
        limit = high if nearer_high or unbounded else low
        sentence = f"The {name} is {known.value:.1f} {unit}, with 95 % probability within {error:.1f} {unit}"
        move = _MOVE.get(name, "move the end point, or draw the aids more accurately")
        advice = f"with its error it must lie {_within(low, high, unit)}: {move}"
        sentence += "." if passed else f"; {advice}."
        checks.append(
            Check(name, passed, known.value, float(limit), unit, sentence, error_95=error, is_minimum=limit == low)
        )
    return checks


def _known_metrics(bone: _Bone, rules: Sequence[CheckRule]) -> list[tuple[CheckRule, Metric]]:
    """Return the rules of metrics whose aids are drawn, and whose side is known where they need it."""
    return [
        (rule, metric(bone.anatomy, rule.check, bone.side))
        for rule in rules
        if rule.check not in MEASURES and not bone.exchanged and not bone.lacking(rule)[0]
    ]


def metric_measures(
    anatomy: Anatomy, rules: Sequence[CheckRule], side: str | None, landmarks_mm: Mapping[str, np.ndarray]
) -> tuple[Measure, ...]:
    """Return the checks of metrics that can be made, as measures whose limits keep the 95 % error of this wire."""
    bone, made = _Bone(anatomy, side, landmarks_mm), []
    for rule, known in _known_metrics(bone, rules):
        if known.value is not None and known.sd is not None:
            name, (low, high), error = rule.check, rule.range, TWO_SIDED_95 * known.sd

            def value(entry: np.ndarray, end: np.ndarray, name: str = name) -> np.ndarray:
                return metric_of_wires(anatomy, name, side, np.stack([entry, end], axis=1))

            made.append(Measure(name, value, low + error, high - error, known.unit, "", ""))
    return tuple(made)


# What to do where a metric fails that depends on more than the end point.
_ENDS = "move entry or end, or draw the aids more accurately"
_EXCHANGED = "pick both again, for they may be exchanged, or one may be wrong along its line of sight"
_MOVE = {
    "entry to pedicle": _EXCHANGED,
    "tip in sacral corridor": f"move the end point, or draw the borders as far as the bone reaches; or {_EXCHANGED}",
    **dict.fromkeys(
        (
            "wire in pedicle",
            "wire in sacral corridor",
            "wire to growth plate",
            "wire off middle of growth plate",
        ),
        _ENDS,
    ),
}


def _within(low: float, high: float, unit: str) -> str:
    if not np.isfinite(low):
        return f"below {high:g} {unit}"
    return f"above {low:g} {unit}" if not np.isfinite(high) else f"between {low:g} and {high:g} {unit}"


def noticed_beyond_mm(checked: Sequence[Measure], anatomy: Anatomy) -> tuple[float | None, float | None]:
    """Return how far entry and end can be wrong along a line of sight before a measure fails; None where none does
    within MAX_SHIFT_MM.

    A pick that is wrong along its image-matching curve moves its point along the other view's line of sight, which no
    gap shows.
    """
    wire, focal = anatomy.part("wire").reshape(2, 3), anatomy.part("focal").reshape(2, 3)
    steps = np.arange(_STEP_MM, MAX_SHIFT_MM + _STEP_MM, _STEP_MM)
    passed = [measure for measure in checked if measure.passes(*wire[:, None])[0]]
    if not passed:
        return None, None
    ends = np.tile(wire[:, None, None, None], (1, 2, 4, len(steps), 1))  # end, moved end, line and sign, step
    for point in range(2):
        away = (wire[point] - focal) / _distance(wire[point], focal)[:, None]
        ends[point, point] += steps[:, None] * np.concatenate([away, -away])[:, None]
    fails = ~np.all([measure.passes(*ends.reshape(2, -1, 3)) for measure in passed], axis=0).reshape(ends.shape[1:4])
    reach = np.where(fails.any(axis=2), steps[fails.argmax(axis=2)], np.inf).max(axis=1)
    entry, end = (float(shift) if np.isfinite(shift) else None for shift in reach)
    return entry, end


def left_out(
    anatomy: Anatomy, rules: Sequence[CheckRule], side: str | None, landmarks_mm: Mapping[str, np.ndarray]
) -> list[str]:
    """Return for each check that is not made, and that the file says a plan may do without, a sentence that says so."""
    bone = _Bone(anatomy, side, landmarks_mm)
    without = [(rule, bone.lacking(rule)) for rule in rules if rule.optional is not None]
    return [
        f"Not checked: {rule.check} ({'; '.join(undrawn)}). A plan may do without it: {rule.optional}."
        for rule, (undrawn, _) in without
        if undrawn
    ]


def _unmade(bone: _Bone, rules: Sequence[CheckRule]) -> list[Check]:
    """Return a failed check for each of the rules that cannot be made: missing where a person can give what it needs.

    The head and the side are asked for once, whichever checks need them.
    """
    anatomy, asked, unmade = bone.anatomy, {rule.check for rule in rules}, list[Check]()

    def wanting(name: str, sentence: str, *, missing: bool = True) -> None:
        unmade.append(Check(name, False, None, None, "", sentence, missing=missing))

    if "side" in asked and bone.side is None:
        wanting("side", "The side is not given: look at both images and state whether it is the right or the left one.")
    if _OF_HEAD & asked and anatomy.undrawn("head"):
        wanting(
            "head",
            "The head is not drawn: draw its outline in both images. Without it neither the order of the wire's ends "
            "nor the tip's depth in the bone can be checked.",
        )
    elif "head" in anatomy.absent:
        wanting("head", f"The head is not known: {anatomy.absent['head']}.", missing=False)
    known_missing = ({"head"} if any(check.name == "head" for check in unmade) else set()) | ({"side"} & asked)
    of_name: dict[str, tuple[list[str], list[str]]] = {}
    for rule in rules:
        undrawn, refused = bone.lacking(rule, known_missing)
        if rule.check not in MEASURES:
            refused = []  # which the metric's own check says
        if refused or (undrawn and rule.optional is None):
            of_name.setdefault(rule.check, (undrawn, refused))
    for check, (undrawn, refused) in of_name.items():
        why = "; ".join(dict.fromkeys([*refused, *undrawn]))
        wanting(_NAMES.get(check, check), f"The check '{check}' cannot be made: {why}.", missing=not refused)
    return unmade


def not_made(rules: Sequence[CheckRule], why: str) -> tuple[Check, ...]:
    """Return the checks of `rules` as missing, for a wire that is planned without drawings of the bone."""
    names = dict.fromkeys(_NAMES.get(rule.check, rule.check) for rule in rules if rule.optional is None)
    return tuple(
        Check(name, False, None, None, "", f"The check '{name}' is not made: {why}.", missing=True) for name in names
    )


def _order(centre: np.ndarray) -> Measure:
    def value(entry: np.ndarray, end: np.ndarray) -> np.ndarray:
        return _distance(entry, centre) - _distance(end, centre)

    return Measure(
        "entry and end",
        value,
        0.0,
        np.inf,
        "mm",
        "The end point lies {} the head's centre than the entry point",
        "entry and end are exchanged, or the head is drawn in the wrong place: exchange them, or draw the head again",
        ("nearer to", "farther from"),
    )


def _sides(
    anatomy: Anatomy, side: str | None, landmarks_mm: Mapping[str, np.ndarray], centre: np.ndarray, *, by_wire: bool
) -> list[Measure]:
    """Return the measures of what must lie below the head of a hip of this side."""
    if side is None:
        return []
    down = caudal(side)
    still = {}
    if LESSER in landmarks_mm:
        still["lesser trochanter"] = landmarks_mm[LESSER]
    if anatomy.shaft is not None:
        still["shaft"] = anatomy.shaft.ends_mm.mean(axis=0)
    otherwise = (
        f"it is not a {side} hip, or two points are exchanged: look at both images, then give the other side or pick "
        "again"
    )
    sentence = f"For a {side} hip {{}} must lie below the centre of the head: it lies {{}} it"
    ways = ("below", "above")
    made = [
        Measure(
            "side",
            lambda entry, end, at=at: np.full(len(entry), float((at - centre) @ down)),
            0.0,
            np.inf,
            "mm",
            sentence.format(f"the {name}", "{}"),
            otherwise,
            ways,
        )
        for name, at in still.items()
    ]
    if by_wire:
        below = sentence.format("the entry", "{}")
        made.append(
            Measure("side", lambda entry, end: (entry - centre) @ down, 0.0, np.inf, "mm", below, otherwise, ways)
        )
    return made


def _tip(anatomy: Anatomy) -> Measure:
    """Return the measure of the tip's depth below the head's surface, which must exceed its own error."""
    assert anatomy.head is not None  # noqa: S101 - checked by the caller
    depth_sd = tip_depth(anatomy)[1]
    error = 0.0 if depth_sd is None else TWO_SIDED_95 * depth_sd
    head = anatomy.head
    return Measure(
        "tip in head",
        lambda entry, end: head.radius_mm - _distance(end, head.centre_mm),
        error,
        np.inf,
        "mm",
        f"The tip lies {{}} the nearest surface of the head (95 % error {error:.1f} mm)",
        f"the depth must exceed its error of {error:.1f} mm, since the joint lies beyond the surface: move the end "
        "point, or draw the head again",
        ("under", "beyond"),
    )


def _from_head(centre: np.ndarray, low: float) -> Measure:
    return Measure(
        "entry at cortex",
        lambda entry, end: _distance(entry, centre),
        low,
        np.inf,
        "mm",
        "The entry lies {} from the head's centre",
        f"below {low:.0f} mm it lies in the neck, not at the lateral cortex: pick it again",
    )


def _from_lesser(lesser: np.ndarray, rule: CheckRule) -> Measure:
    low, high = rule.range
    lateral = rule.check == "lateral of lesser trochanter"
    way, where = (_LATERAL, "inside") if lateral else (ANTERIOR, "behind")
    return Measure(
        "entry at cortex",
        lambda entry, end: (entry - lesser) @ way,
        low,
        high,
        "mm",
        "The entry lies {} the lesser trochanter's tip",
        f"below {low:.0f} mm it lies {where} the bone, above {high:.0f} mm off the bone: pick the entry or the "
        "trochanter again; one may be wrong along its line of sight",
        ("lateral of", "medial of") if lateral else ("anterior of", "posterior of"),
    )


def _above_lesser(lesser: np.ndarray, side: str, low: float) -> Measure:
    return Measure(
        "entry at cortex",
        lambda entry, end: (lesser - entry) @ caudal(side),
        low,
        np.inf,
        "mm",
        "The entry lies {} the lesser trochanter's tip",
        f"more than {-low:.0f} mm below it, the femur may break below the trochanters: enter higher",
        ("above", "below"),
    )


def _from_lateral(epicondyle: np.ndarray) -> Measure:
    return Measure(
        "entry from lateral",
        lambda entry, end: _distance(end, epicondyle) - _distance(entry, epicondyle),
        0.0,
        np.inf,
        "mm",
        "The entry point lies {} the lateral epicondyle than the end point",
        "entry and end are exchanged, or the epicondyle is another point: exchange them, or pick it again",
        ("nearer to", "farther from"),
    )


def _past_promontory(promontory: np.ndarray, low: float) -> Measure:
    def value(entry: np.ndarray, end: np.ndarray) -> np.ndarray:
        return ((end - promontory) * (end - entry)).sum(axis=-1) / _distance(entry, end)

    return Measure(
        "tip past promontory",
        value,
        low,
        np.inf,
        "mm",
        "Along the wire the tip lies {} the promontory, the middle of S1",
        f"it must lie {low:.0f} mm or more past it, where the screw holds in the body of S1: move the end point, or "
        "pick the promontory again",
        ("past", "short of"),
    )


def _from_cortex(anatomy: Anatomy, centre: np.ndarray, rule: CheckRule) -> Measure:
    assert anatomy.shaft is not None  # noqa: S101 - checked by the caller
    on, along = anatomy.shaft.ends_mm[0], anatomy.shaft.direction
    outside = rule.check == "entry outside cortex"
    where, there, way = ("outside", "in air", -1.0) if outside else ("inside", "in the bone", 1.0)
    high = rule.range[1]

    def across(xyz: np.ndarray) -> np.ndarray:
        off = xyz - on
        return off - (off @ along)[..., None] * along

    outward = -across(centre)
    outward = outward / np.linalg.norm(outward)
    cortex = float(np.linalg.norm(across(anatomy.part("cortex"))))
    return Measure(
        "entry at cortex",
        lambda entry, end: way * (cortex - across(entry) @ outward),
        -np.inf,
        high,
        "mm",
        "The entry lies {} the lateral cortex that was clicked",
        f"more than {high:.0f} mm {where}, it lies {there}: pick it at the cortex, or click on the cortex again",
        ("outside", "inside") if outside else ("inside", "outside"),
    )


def _to_shaft(shaft: np.ndarray, low: float, high: float) -> Measure:
    def value(entry: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return the obtuse angle: the shaft axis may be drawn in either direction."""
        cosine = np.abs((end - entry) @ shaft) / _distance(entry, end)
        return np.rad2deg(np.pi - np.arccos(np.clip(cosine, 0.0, 1.0)))

    return Measure(
        "wire to shaft",
        value,
        low,
        high,
        "°",
        "The wire makes an angle of {} with the shaft",
        f"plates need {low:.0f}° to {high:.0f}°: a point is wrong along its line of sight, or the shaft is drawn "
        "wrongly: pick again",
    )


def _length(rule: CheckRule) -> Measure:
    low, high = rule.range
    return Measure(
        "wire length",
        _distance,
        low,
        high,
        "mm",
        "From entry to end the wire runs {}",
        f"{rule.of} have {low:.0f} to {high:.0f} mm: entry or end is wrong, perhaps along its line of sight: pick "
        "it again",
    )


def _between_views(anatomy: Anatomy, low: float) -> Measure:
    """Return the measure of the angle between the beams of the first two views at the wire's middle, at most 90°."""
    focal = anatomy.part("focal").reshape(2, 3)

    def value(entry: np.ndarray, end: np.ndarray) -> np.ndarray:
        first, second = ((entry + end) / 2 - source for source in focal)
        cosine = np.abs((first * second).sum(axis=-1)) / (
            np.linalg.norm(first, axis=-1) * np.linalg.norm(second, axis=-1)
        )
        return np.rad2deg(np.arccos(np.clip(cosine, 0.0, 1.0)))

    return Measure(
        "angle between views",
        value,
        low,
        np.inf,
        "°",
        "The beams of the two views meet at {}",
        f"the procedure wants views at {low:.0f}° or more: acquire one of them again from the direction it states",
    )


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    off = a - b
    return np.sqrt(np.einsum("...i,...i->...", off, off))


_Make = Callable[[_Bone, CheckRule], list[Measure]]


def _of_bone(make: Callable[[_Bone, np.ndarray, CheckRule], list[Measure]]) -> _Make:
    """Return the function of a rule that needs the head's centre; without it there is no measure."""
    return lambda bone, rule: [] if bone.centre_mm is None else make(bone, bone.centre_mm, rule)


def _lesser(bone: _Bone, rule: CheckRule) -> list[Measure]:
    return [_from_lesser(bone.landmarks_mm[LESSER], rule)] if LESSER in bone.landmarks_mm else []


def _cortex(bone: _Bone, centre: np.ndarray, rule: CheckRule) -> list[Measure]:
    return [_from_cortex(bone.anatomy, centre, rule)] if {"shaft", "cortex"} <= bone.anatomy.at.keys() else []


# The measures of each check that a procedure's file may name (`CheckRule`).
MEASURES: dict[str, _Make] = {
    "entry and end": _of_bone(lambda bone, centre, rule: [_order(centre)]),
    "side": _of_bone(
        lambda bone, centre, rule: _sides(
            bone.anatomy, bone.side, bone.landmarks_mm, centre, by_wire=not bone.exchanged
        )
    ),
    "head to entry": _of_bone(lambda bone, centre, rule: [_from_head(centre, rule.range[0])]),
    "tip in head": lambda bone, rule: [] if bone.anatomy.head is None else [_tip(bone.anatomy)],
    "lateral of lesser trochanter": _lesser,
    "anterior of lesser trochanter": _lesser,
    "above lesser trochanter": lambda bone, rule: (
        [_above_lesser(bone.landmarks_mm[LESSER], bone.side, rule.range[0])]
        if bone.side is not None and LESSER in bone.landmarks_mm
        else []
    ),
    "entry from lateral": lambda bone, rule: (
        [_from_lateral(bone.landmarks_mm[EPICONDYLE])] if EPICONDYLE in bone.landmarks_mm else []
    ),
    "tip past promontory": lambda bone, rule: (
        [_past_promontory(bone.landmarks_mm[PROMONTORY], rule.range[0])] if PROMONTORY in bone.landmarks_mm else []
    ),
    "wire to shaft": lambda bone, rule: (
        [] if bone.anatomy.shaft is None else [_to_shaft(bone.anatomy.shaft.direction, *rule.range)]
    ),
    "entry below cortex": _of_bone(_cortex),
    "entry outside cortex": _of_bone(_cortex),
    "wire length": lambda bone, rule: [_length(rule)],
    "angle between views": lambda bone, rule: [_between_views(bone.anatomy, rule.range[0])],
    "view directions": lambda bone, rule: [],  # `judge_directions` has the views
}
