"""Checks of a planned wire against the bone: side, order of entry and end, depth of the tip below the surface."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sightline.checks import Check
from sightline.geometry.covariance import TWO_SIDED_95
from sightline.planning.anatomy import NOT_PLACED, Anatomy
from sightline.planning.directions import ANTERIOR, MEDIAL, caudal
from sightline.planning.metrics import tip_depth
from sightline.planning.results import Verdict

HEAD_CENTRE, LESSER = "head-centre", "lesser-trochanter"
_LATERAL = -MEDIAL
# Range and step of the trial shifts of a point along a line of sight [ours].
MAX_SHIFT_MM, _STEP_MM = 60.0, 0.5


@dataclass(frozen=True)
class BoneRule:
    """Plausible ranges for the wire of a hip screw; a wire outside them does not belong to this procedure.

    `length_mm`: lengths of hip screws. `head_to_entry_mm`: minimum distance from the head's centre to the entry.
    `lateral_of_lesser_mm`, `before_lesser_mm`: how far the entry lies lateral and anterior of the tip of the lesser
    trochanter. `cortex_mm`: maximum depth of the entry below the lateral cortex. `to_shaft_deg`: angle between wire
    and shaft.
    """

    length_mm: tuple[float, float] = (50.0, 145.0)  # screws are made in 50 to 145 mm [mem]
    # 70 to 90 mm in adults, 55 mm in the smallest [mem]; an entry nearer to the centre lies in the neck [ours].
    head_to_entry_mm: float = 50.0
    # In the twin 35 mm; the femur is 40 mm wide there [mem]; 10 mm for the frame's tilt against the bone [ours].
    lateral_of_lesser_mm: tuple[float, float] = (25.0, 60.0)
    # In the twin 18 mm; a thigh rotated by 45° carries the trochanter to the front [ours].
    before_lesser_mm: tuple[float, float] = (-15.0, 50.0)
    cortex_mm: float = 8.0  # the cortex is 5 mm thick (physics.md, Femur), the bone flares by 3 [ours]
    to_shaft_deg: tuple[float, float] = (120.0, 155.0)  # plates have 130° to 150° [mem]; 5° to 10° freehand error


@dataclass(frozen=True)
class Measure:
    """A measure of the wire that must lie between `low` and `high`: `value` maps entry and end (K, 3) to (K,).

    `sentence` states the value; `otherwise` says what a value out of range means and what to do.
    """

    name: str
    value: Callable[[np.ndarray, np.ndarray], np.ndarray]
    low: float
    high: float
    unit: str
    sentence: str
    otherwise: str

    def passes(self, entry_mm: np.ndarray, end_mm: np.ndarray) -> np.ndarray:
        """Return (K,) bool for entries and ends (K, 3)."""
        values = self.value(entry_mm, end_mm)
        return (values >= self.low) & (values <= self.high)

    def check(self, entry_mm: np.ndarray, end_mm: np.ndarray) -> Check:
        """Return the check of one wire: entry and end (3,)."""
        value = float(self.value(entry_mm[None], end_mm[None])[0])
        limit = self.high if value > self.high or not np.isfinite(self.low) else self.low
        passed = self.low <= value <= self.high
        sentence = self.sentence.format(f"{value:.1f}{'' if self.unit == '°' else ' '}{self.unit}")
        sentence += "." if passed else f"; {self.otherwise}."
        return Check(self.name, passed, value, float(limit), self.unit, sentence)


def judge_in_bone(found: Anatomy, rule: BoneRule, side: str | None, landmarks_mm: Mapping[str, np.ndarray]) -> Verdict:
    """Return the checks of the wire in `found` against the bone, and those that lack an input.

    `landmarks_mm`: (3,) by their keys in the kind of trajectory. Raises UnusableInputError for an unknown side.
    """
    missing = _missing(found, side, landmarks_mm)
    checks = list(missing)
    if found.head_agreement is not None:
        checks.append(found.head_agreement)
    if "wire" in found.at:
        entry, end = found.part("wire").reshape(2, 3)
        checks += [measure.check(entry, end) for measure in measures(found, rule, side, landmarks_mm)]
    if "head" not in found.at and found.absent["head"] != NOT_PLACED["head"]:
        checks.append(Check("head", False, None, None, "", f"The head is not known: {found.absent['head']}."))
    return Verdict(tuple(checks), missing)


def measures(
    found: Anatomy, rule: BoneRule, side: str | None, landmarks_mm: Mapping[str, np.ndarray]
) -> tuple[Measure, ...]:
    """Return all measures of the wire for which the bone is known well enough."""
    entry, end = found.part("wire").reshape(1, 2, 3).swapaxes(0, 1)
    out: list[Measure] = []
    centre = landmarks_mm.get(HEAD_CENTRE) if found.head is None else found.head.centre_mm
    if centre is not None:
        order = _order(centre)
        out.append(order)
        if not order.passes(entry, end)[0]:  # with the ends exchanged no other measure is meaningful
            return (*out, *_sides(found, side, landmarks_mm, centre, by_wire=False))
        out += _sides(found, side, landmarks_mm, centre, by_wire=True)
        out.append(_from_head(centre, rule))
    if found.head is not None:
        out.append(_tip(found))
    if LESSER in landmarks_mm:
        out += _from_lesser(landmarks_mm[LESSER], rule)
    if found.shaft is not None:
        out.append(_to_shaft(found.shaft.direction, rule))
        if centre is not None and "cortex" in found.at:
            out.append(_from_cortex(found, centre, rule))
    out.append(_length(rule))
    return tuple(out)


def noticed_beyond_mm(checked: Sequence[Measure], found: Anatomy) -> tuple[float | None, float | None]:
    """Return how far entry and end can be wrong along a line of sight before a measure fails; None where none does
    within MAX_SHIFT_MM.

    A pick that is wrong along its image-matching curve moves its point along the other view's line of sight, which no
    gap shows.
    """
    wire, focal = found.part("wire").reshape(2, 3), found.part("focal").reshape(2, 3)
    steps = np.arange(_STEP_MM, MAX_SHIFT_MM + _STEP_MM, _STEP_MM)
    out: list[float | None] = []
    for point in range(2):
        reach: float | None = 0.0
        for away in (wire[point] - focal) / _distance(wire[point], focal)[:, None]:
            for along in (away, -away):
                ends = np.repeat(wire[:, None], len(steps), axis=1)
                ends[point] += steps[:, None] * along
                passes = [m.passes(*ends) for m in checked if m.passes(*wire[:, None])[0]]
                fails = np.flatnonzero(~np.all(passes, axis=0)) if passes else np.zeros(0, dtype=int)
                reach = None if reach is None or not len(fails) else max(reach, float(steps[fails[0]]))
        out.append(reach)
    return out[0], out[1]


def _missing(found: Anatomy, side: str | None, landmarks_mm: Mapping[str, np.ndarray]) -> tuple[Check, ...]:
    """Return the checks that lack an input, with what they need."""
    wanted = {}
    if side is None:
        wanted["side"] = "The side is not given: look at both images and state whether it is the right or the left hip."
    if found.absent.get("head") == NOT_PLACED["head"]:
        wanted["head"] = (
            "The head is not drawn: draw its outline in both images. Without it neither the order of the wire's ends "
            "nor the tip's depth in the bone can be checked."
        )
    if LESSER not in landmarks_mm and not {"shaft", "cortex"} <= found.at.keys():
        wanted["entry at cortex"] = (
            "The entry cannot be checked: it may lie at the lateral cortex or inside the neck. Pick the tip of the "
            "lesser trochanter in both images, or draw the shaft axis and click on the lateral cortex."
        )
    return tuple(Check(name, False, None, None, "", sentence) for name, sentence in wanted.items())


def _order(centre: np.ndarray) -> Measure:
    def value(entry: np.ndarray, end: np.ndarray) -> np.ndarray:
        return _distance(entry, centre) - _distance(end, centre)

    return Measure(
        "entry and end",
        value,
        0.0,
        np.inf,
        "mm",
        "The end point lies nearer to the head's centre than the entry point, by {}",
        "entry and end are exchanged, or the head is drawn in the wrong place: exchange them, or draw the head again",
    )


def _sides(
    found: Anatomy, side: str | None, landmarks_mm: Mapping[str, np.ndarray], centre: np.ndarray, *, by_wire: bool
) -> list[Measure]:
    """Return the measures of what must lie below the head of a hip of this side."""
    if side is None:
        return []
    down = caudal(side)
    still = {}
    if LESSER in landmarks_mm:
        still["lesser trochanter"] = landmarks_mm[LESSER]
    if found.shaft is not None:
        still["shaft"] = found.shaft.ends_mm.mean(axis=0)
    otherwise = (
        f"with the frame placed like this it is not a {side} hip, or two points are exchanged: look at both images, "
        "then give the other side or pick again"
    )
    sentence = f"For a {side} hip {{}} must lie below the centre of the head: it lies {{}} below"
    out = [
        Measure(
            "side",
            lambda entry, end, at=at: np.full(len(entry), float((at - centre) @ down)),
            0.0,
            np.inf,
            "mm",
            sentence.format(f"the {name}", "{}"),
            otherwise,
        )
        for name, at in still.items()
    ]
    if by_wire:
        below = sentence.format("the entry", "{}")
        out.append(Measure("side", lambda entry, end: (entry - centre) @ down, 0.0, np.inf, "mm", below, otherwise))
    return out


def _tip(found: Anatomy) -> Measure:
    """Return the measure of the tip's depth below the head's surface, which must exceed its own error."""
    assert found.head is not None  # noqa: S101 - checked by the caller
    depth_sd = tip_depth(found)[1]
    error = 0.0 if depth_sd is None else TWO_SIDED_95 * depth_sd
    head = found.head
    return Measure(
        "tip in head",
        lambda entry, end: head.radius_mm - _distance(end, head.centre_mm),
        error,
        np.inf,
        "mm",
        f"The tip lies {{}} under the nearest surface of the head (95 % error {error:.1f} mm)",
        f"the depth must exceed its error of {error:.1f} mm, since the joint lies beyond the surface: move the end "
        "point, or draw the head again",
    )


def _from_head(centre: np.ndarray, rule: BoneRule) -> Measure:
    return Measure(
        "entry at cortex",
        lambda entry, end: _distance(entry, centre),
        rule.head_to_entry_mm,
        np.inf,
        "mm",
        "The entry lies {} from the head's centre",
        f"below {rule.head_to_entry_mm:.0f} mm it lies in the neck, not at the lateral cortex: pick it again",
    )


def _from_lesser(lesser: np.ndarray, rule: BoneRule) -> list[Measure]:
    ways = (
        ("lateral", _LATERAL, rule.lateral_of_lesser_mm, "inside the bone"),
        ("anterior", ANTERIOR, rule.before_lesser_mm, "behind the bone"),
    )
    return [
        Measure(
            "entry at cortex",
            lambda entry, end, way=way: (entry - lesser) @ way,
            low,
            high,
            "mm",
            f"The entry lies {{}} {name} of the lesser trochanter's tip",
            f"below {low:.0f} mm it lies {where}, above {high:.0f} mm off the bone: pick the entry or the trochanter "
            "again; one may be wrong along its line of sight",
        )
        for name, way, (low, high), where in ways
    ]


def _from_cortex(found: Anatomy, centre: np.ndarray, rule: BoneRule) -> Measure:
    assert found.shaft is not None  # noqa: S101 - checked by the caller
    on, along = found.shaft.ends_mm[0], found.shaft.direction

    def across(xyz: np.ndarray) -> np.ndarray:
        off = xyz - on
        return off - (off @ along)[..., None] * along

    outward = -across(centre)
    outward = outward / np.linalg.norm(outward)
    cortex = float(np.linalg.norm(across(found.part("cortex"))))
    return Measure(
        "entry at cortex",
        lambda entry, end: cortex - across(entry) @ outward,
        -np.inf,
        rule.cortex_mm,
        "mm",
        "The entry lies {} inside the lateral cortex that was clicked",
        f"more than {rule.cortex_mm:.0f} mm inside, it lies in the bone: pick it at the cortex, or click on the cortex "
        "again",
    )


def _to_shaft(shaft: np.ndarray, rule: BoneRule) -> Measure:
    low, high = rule.to_shaft_deg

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


def _length(rule: BoneRule) -> Measure:
    low, high = rule.length_mm
    return Measure(
        "wire length",
        _distance,
        low,
        high,
        "mm",
        "From entry to end the wire runs {}",
        f"hip screws have {low:.0f} to {high:.0f} mm: entry or end is wrong, perhaps along its line of sight: pick "
        "it again",
    )


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a - b, axis=-1)
