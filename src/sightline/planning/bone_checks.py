"""Checks of a planned wire against the bone it is for: side, which end is which, the tip under the head's surface."""

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
# Along a line of sight a point is tried so far, in such steps [ours].
FARTHEST_MM, _STEP_MM = 60.0, 0.5


@dataclass(frozen=True)
class BoneRule:
    """Where the wire of a hip screw usually lies. A wire outside of these ranges is not this procedure's.

    `length_mm`: in which hip screws are made. `head_to_entry_mm`: at least from the head's centre to the entry.
    `lateral_of_lesser_mm`, `before_lesser_mm`: how far the entry lies lateral and anterior of the tip of the lesser
    trochanter. `cortex_mm`: at most
    from the entry to the lateral cortex, inward from it. `to_shaft_deg`: between wire and shaft.
    """

    length_mm: tuple[float, float] = (50.0, 145.0)  # screws are made in 50 to 145 mm [mem]
    # In adults 70 to 90 mm; the smallest necks have 55 [mem], so an entry nearer lies in the neck [ours].
    head_to_entry_mm: float = 50.0
    # In the twin 35 mm; the femur is 40 mm wide there [mem]; 10 mm for the frame's tilt against the bone [ours].
    lateral_of_lesser_mm: tuple[float, float] = (25.0, 60.0)
    # In the twin 18 mm; a thigh that is turned by 45° carries the trochanter to the front [ours].
    before_lesser_mm: tuple[float, float] = (-15.0, 50.0)
    cortex_mm: float = 8.0  # the cortex is 5 mm thick (physics.md, Femur), the bone flares by 3 [ours]
    to_shaft_deg: tuple[float, float] = (120.0, 155.0)  # plates have 130° to 150° [mem], and 5° to 10° for the hand


@dataclass(frozen=True)
class Measure:
    """A value of the wire that must lie between `low` and `high`: `value` takes entry and end (K, 3) to (K,).

    `sentence` says the value, `otherwise` what a wrong one means and what to do."""

    name: str
    value: Callable[[np.ndarray, np.ndarray], np.ndarray]
    low: float
    high: float
    unit: str
    sentence: str
    otherwise: str

    def passes(self, entry_mm: np.ndarray, end_mm: np.ndarray) -> np.ndarray:
        """(K,) bool, of entries and ends (K, 3)."""
        values = self.value(entry_mm, end_mm)
        return (values >= self.low) & (values <= self.high)

    def check(self, entry_mm: np.ndarray, end_mm: np.ndarray) -> Check:
        """Of one wire: entry and end (3,)."""
        value = float(self.value(entry_mm[None], end_mm[None])[0])
        limit = self.high if value > self.high or not np.isfinite(self.low) else self.low
        passed = self.low <= value <= self.high
        said = self.sentence.format(f"{value:.1f}{'' if self.unit == '°' else ' '}{self.unit}")
        said += "." if passed else f"; {self.otherwise}."
        return Check(self.name, passed, value, float(limit), self.unit, said)


def judge_in_bone(found: Anatomy, rule: BoneRule, side: str | None, landmarks_mm: Mapping[str, np.ndarray]) -> Verdict:
    """What the bone says of the wire in `found`: the checks, and those that something is missing for.

    `landmarks_mm`: (3,) by their keys in the kind of trajectory. Raises UnusableInputError for a side that is none."""
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
    """Everything that can be measured of the wire with what is known of the bone."""
    entry, end = found.part("wire").reshape(1, 2, 3).swapaxes(0, 1)
    out: list[Measure] = []
    centre = landmarks_mm.get(HEAD_CENTRE) if found.head is None else found.head.centre_mm
    if centre is not None:
        order = _order(centre)
        out.append(order)
        if not order.passes(entry, end)[0]:  # then nothing else of the wire means anything
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
    """How far entry and end could be wrong along a line of sight before one of the measures fails; None where none does
    within FARTHEST_MM.

    A pick that is wrong along its image-matching curve moves its point along the other view's line of sight, and no gap
    shows it."""
    wire, focal = found.part("wire").reshape(2, 3), found.part("focal").reshape(2, 3)
    steps = np.arange(_STEP_MM, FARTHEST_MM + _STEP_MM, _STEP_MM)
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
    """Checks that cannot be made, with what they need."""
    wanted = {}
    if side is None:
        wanted["side"] = (
            "The side is not given: say whether it is the right or the left hip, after a look at both images."
        )
    if found.absent.get("head") == NOT_PLACED["head"]:
        wanted["head"] = (
            "The head is not drawn: draw its outline in both images; nothing tells which end of the wire lies in it, "
            "nor whether the tip stays in the bone."
        )
    if LESSER not in landmarks_mm and not {"shaft", "cortex"} <= found.at.keys():
        wanted["entry at cortex"] = (
            "Nothing tells whether the entry lies at the lateral cortex or inside the neck: pick the tip of the lesser "
            "trochanter in both images, or draw the shaft axis and click on the lateral cortex."
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
        "entry and end are exchanged, or the head is drawn at the wrong place: exchange them, or draw it again",
    )


def _sides(
    found: Anatomy, side: str | None, landmarks_mm: Mapping[str, np.ndarray], centre: np.ndarray, *, by_wire: bool
) -> list[Measure]:
    """What must lie below the head of a hip of this side."""
    if side is None:
        return []
    down = caudal(side)
    still = {}
    if LESSER in landmarks_mm:
        still["lesser trochanter"] = landmarks_mm[LESSER]
    if found.shaft is not None:
        still["shaft"] = found.shaft.ends_mm.mean(axis=0)
    otherwise = (
        f"this is no {side} hip as the frame stands, or two points are exchanged: look at both images, and give the "
        "other side or pick again"
    )
    said = f"For a {side} hip {{}} must lie below the centre of the head: it lies {{}} below"
    out = [
        Measure(
            "side",
            lambda entry, end, at=at: np.full(len(entry), float((at - centre) @ down)),
            0.0,
            np.inf,
            "mm",
            said.format(f"the {name}", "{}"),
            otherwise,
        )
        for name, at in still.items()
    ]
    if by_wire:
        below = said.format("the entry", "{}")
        out.append(Measure("side", lambda entry, end: (entry - centre) @ down, 0.0, np.inf, "mm", below, otherwise))
    return out


def _tip(found: Anatomy) -> Measure:
    """The tip stays under the head's surface, by more than its own error."""
    assert found.head is not None  # noqa: S101 - asked for by measures
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
        f"it must be more than its error, {error:.1f} mm: through the surface lies the joint, or the tip is not in the "
        "head: move the end point, or draw the head again",
    )


def _from_head(centre: np.ndarray, rule: BoneRule) -> Measure:
    return Measure(
        "entry at cortex",
        lambda entry, end: _distance(entry, centre),
        rule.head_to_entry_mm,
        np.inf,
        "mm",
        "The entry lies {} from the head's centre",
        f"at less than {rule.head_to_entry_mm:.0f} mm it lies in the neck, not at the lateral cortex: pick it again",
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
            f"at less than {low:.0f} mm it lies {where}, at more than {high:.0f} mm beside it: pick one of them "
            "again; it may be wrong along its line of sight",
        )
        for name, way, (low, high), where in ways
    ]


def _from_cortex(found: Anatomy, centre: np.ndarray, rule: BoneRule) -> Measure:
    assert found.shaft is not None  # noqa: S101 - asked for by measures
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
        f"more than {rule.cortex_mm:.0f} mm inside it lies in the bone: pick it at the cortex, or click on that again",
    )


def _to_shaft(shaft: np.ndarray, rule: BoneRule) -> Measure:
    low, high = rule.to_shaft_deg

    def value(entry: np.ndarray, end: np.ndarray) -> np.ndarray:
        """An axis drawn either way: the obtuse angle is that of the neck with the shaft."""
        cosine = np.abs((end - entry) @ shaft) / _distance(entry, end)
        return np.rad2deg(np.pi - np.arccos(np.clip(cosine, 0.0, 1.0)))

    return Measure(
        "wire to shaft",
        value,
        low,
        high,
        "°",
        "The wire stands at {} to the shaft",
        f"plates need {low:.0f}° to {high:.0f}°: a point is wrong along its line of sight, or the shaft: pick again",
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
        f"hip screws have {low:.0f} to {high:.0f} mm: an end is wrong, perhaps along its line of sight: pick again",
    )


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a - b, axis=-1)
