"""The figures of a plan that a surgeon judges an implant's place by, each with its standard deviation.

All are functions of one vector (`Anatomy.values`), differentiated numerically, so that errors which its parts and the
wire share count as they should.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sightline.errors import ReconstructionRefusedError
from sightline.geometry.covariance import response
from sightline.planning.anatomy import Anatomy
from sightline.planning.directions import ANTERIOR, MEDIAL, caudal, towards

# A wire that passes the head's centre by more of the radius leaves it at a glance [ours].
_GRAZES = 0.95
_CLEVELAND = "thirds of the head: Cleveland et al., J Bone Joint Surg Am 41-A:1399 (1959)"
_BAUMGAERTNER = "Baumgaertner et al., J Bone Joint Surg Am 77:1058 (1995)"
_KUZYK = "Kuzyk et al., J Orthop Trauma 26:414 (2012)"
_BY_DEFINITION = "by definition"


@dataclass(frozen=True)
class Metric:
    """One figure: `value` and its standard deviation `sd`, in `unit`; `low`, `high`: where it is recommended to lie.

    `value` is None where it cannot be known; `sentence` then says why. `sd` is None where a view's error is unknown.
    `zone`: which third of the head, where the figure tells that. `source`: of definition and recommendation.
    """

    name: str
    value: float | None
    sd: float | None
    unit: str
    sentence: str
    source: str
    low: float | None = None
    high: float | None = None
    zone: str | None = None

    @property
    def within(self) -> bool | None:
        """Does it lie where it is recommended? None where that is not known, or nothing is recommended."""
        if self.value is None or (self.low is None and self.high is None):
            return None
        return (self.low is None or self.value >= self.low) and (self.high is None or self.value <= self.high)


@dataclass(frozen=True)
class _Kind:
    """What a figure needs, how it is computed from all numbers (K, n), and what is said of it."""

    name: str
    needs: tuple[str, ...]
    value: Callable[["_Parts"], np.ndarray]
    unit: str
    sentence: str
    source: str
    low: float | None = None
    high: float | None = None


def figures(found: Anatomy, side: str) -> tuple[Metric, ...]:
    """All figures, in a fixed order, for a hip of one side, "right" or "left"; what is not known is absent with the
    reason. Raises UnusableInputError."""
    caudal(side)
    made = [_figure(found, kind, side) for kind in _KINDS]
    return (*made, *(_position(found, name, side) for name in ("AP", "lateral")))


def _figure(found: Anatomy, kind: _Kind, side: str) -> Metric:
    missing = next((part for part in kind.needs if part not in found.at), None)
    if missing is not None:
        why = f"Not known: {found.absent[missing]}."
        return Metric(kind.name, None, None, kind.unit, why, kind.source, kind.low, kind.high)
    try:
        value, sd = _valued(found, kind.value, side)
    except ReconstructionRefusedError as refusal:
        return Metric(kind.name, None, None, kind.unit, f"Not known: {refusal}.", kind.source, kind.low, kind.high)
    spread = "" if sd is None else f" ± {sd:.1f}"
    sentence = kind.sentence.format(f"{value:.1f}{spread} {kind.unit}")
    return Metric(kind.name, value, sd, kind.unit, sentence, kind.source, kind.low, kind.high)


def _valued(found: Anatomy, function: Callable[["_Parts"], np.ndarray], side: str) -> tuple[float, float | None]:
    """A figure and its standard deviation."""
    value, own = response(lambda values: function(_Parts(found, values, side))[:, None], found.values)
    sd = None if found.covariance is None else float(np.sqrt(own[0] @ found.covariance @ own[0]))
    return float(value[0]), sd


def tip_depth(found: Anatomy) -> tuple[float, float | None]:
    """How far the tip lies under the head's surface, mm, at its nearest; and its standard deviation.

    Wire and head are known."""
    return _valued(found, _nearest_bone, "right")  # of either side alike


class _Parts:
    """The parts of the bone for K sets of all numbers, (K, n)."""

    def __init__(self, found: Anatomy, values: np.ndarray, side: str) -> None:
        self._found, self._values, self.side = found, values, side

    def _of(self, name: str, first: int = 0, count: int = 3) -> np.ndarray:
        start = self._found.at[name].start + first
        return self._values[:, start : start + count]

    @property
    def entry(self) -> np.ndarray:
        return self._of("wire")

    @property
    def tip(self) -> np.ndarray:
        return self._of("wire", 3)

    @property
    def wire(self) -> np.ndarray:
        return _unit(self.tip - self.entry)

    @property
    def centre(self) -> np.ndarray:
        return self._of("head")

    @property
    def radius(self) -> np.ndarray:
        return self._of("head", 3, 1)[:, 0]

    @property
    def calcar(self) -> np.ndarray:
        return self._of("calcar")

    @property
    def neck(self) -> np.ndarray:
        """Towards the head."""
        return self._axis("neck", MEDIAL)

    @property
    def shaft(self) -> np.ndarray:
        """Towards the knee."""
        self._found.refuse_side(self.side)
        return self._axis("shaft", caudal(self.side))

    def beam(self, view: int) -> np.ndarray:
        """The ray of a view (0: PA, 1: lateral) through the head's centre."""
        return _unit(self.centre - self._of("focal", 3 * view))

    def beside(self) -> np.ndarray:
        """From the head's centre straight to the wire."""
        return _across(self.entry - self.centre, self.wire)

    def _axis(self, name: str, goal: np.ndarray) -> np.ndarray:
        along = _unit(self._of(name, 3) - self._of(name))
        return along * np.sign(along[0] @ towards(along[0], goal, f"the {name} axis"))


def _length(parts: _Parts) -> np.ndarray:
    return np.linalg.norm(parts.tip - parts.entry, axis=-1)


def _to_shaft(parts: _Parts) -> np.ndarray:
    return _angle_deg(parts.wire, parts.shaft)


def _neck_shaft(parts: _Parts) -> np.ndarray:
    return _angle_deg(parts.neck, parts.shaft)


def _version(parts: _Parts) -> np.ndarray:
    """Seen along the shaft, from the frame's frontal plane (X and the shaft)."""
    forward = _unit(_across(ANTERIOR, parts.shaft))
    inward = np.cross(parts.shaft, forward)
    inward *= np.sign(inward[:, :1] * MEDIAL[0])
    return np.rad2deg(np.arctan2((parts.neck * forward).sum(axis=-1), (parts.neck * inward).sum(axis=-1)))


def _tip_apex(parts: _Parts) -> np.ndarray:
    return _seen(parts.tip - _apex(parts), parts.beam(0)) + _seen(parts.tip - _apex(parts), parts.beam(1))


def _calcar_tip_apex(parts: _Parts) -> np.ndarray:
    """In the PA view to where the line along the calcar, parallel to the neck's axis, leaves the head."""
    beam = parts.beam(0)
    along = _unit(_across(parts.neck, beam))
    from_centre = _across(parts.calcar - parts.centre, beam)
    beside = _across(from_centre, along)
    rest = parts.radius**2 - (beside**2).sum(axis=-1)
    if rest[0] <= (1 - _GRAZES**2) * parts.radius[0] ** 2:
        raise ReconstructionRefusedError("the line along the calcar passes beside the head; click on the calcar again")
    apex = parts.centre + beside + np.sqrt(rest)[:, None] * along
    return _seen(parts.tip - apex, beam) + _seen(parts.tip - _apex(parts), parts.beam(1))


def _nearest_bone(parts: _Parts) -> np.ndarray:
    return parts.radius - np.linalg.norm(parts.tip - parts.centre, axis=-1)


def _bone_ahead(parts: _Parts) -> np.ndarray:
    beside2 = (parts.beside() ** 2).sum(axis=-1)
    if beside2[0] >= (_GRAZES * parts.radius[0]) ** 2:
        raise ReconstructionRefusedError(
            f"the wire passes the head's centre at {np.sqrt(beside2[0]):.1f} mm, beside the head or at its rim"
        )
    reached = ((parts.tip - parts.centre) * parts.wire).sum(axis=-1)
    return np.sqrt(parts.radius**2 - beside2) - reached


_KINDS = (
    _Kind("wire length", ("wire",), _length, "mm", "From entry to end the wire runs {}.", _BY_DEFINITION),
    _Kind(
        "wire to shaft",
        ("wire", "shaft"),
        _to_shaft,
        "°",
        "The wire stands at {} to the shaft (as the neck-shaft angle is counted).",
        _BY_DEFINITION,
    ),
    _Kind("neck-shaft angle", ("neck", "shaft"), _neck_shaft, "°", "Neck and shaft enclose {}.", _BY_DEFINITION),
    _Kind(
        "neck version",
        ("neck", "shaft"),
        _version,
        "°",
        "Seen along the shaft the neck points {} forward of the frame's frontal plane; how the knee lies is not known.",
        _BY_DEFINITION,
    ),
    _Kind(
        "tip-apex distance",
        ("wire", "head", "neck"),
        _tip_apex,
        "mm",
        "Tip to apex of the head, both views together, is {}; cut-out is rare below 25 mm.",
        _BAUMGAERTNER,
        10.0,
        25.0,
    ),
    _Kind(
        "calcar tip-apex distance",
        ("wire", "head", "neck", "calcar"),
        _calcar_tip_apex,
        "mm",
        "With the PA view referred to the calcar it is {}.",
        _KUZYK,
    ),
    _Kind(
        "tip to bone along wire",
        ("wire", "head"),
        _bone_ahead,
        "mm",
        "Ahead of the tip lie {} to the head's surface.",
        "5 to 10 mm under the subchondral bone (physics.md)",
        5.0,
        10.0,
    ),
    _Kind(
        "tip to bone nearest",
        ("wire", "head"),
        _nearest_bone,
        "mm",
        "The head's surface is nearest to the tip at {}.",
        "5 to 10 mm under the subchondral bone (physics.md)",
        5.0,
        10.0,
    ),
)


def _position(found: Anatomy, view: str, side: str) -> Metric:
    """How far beside the head's centre the wire passes, as one view shows it, and in which third of the head."""
    name, source = f"position {view}", _CLEVELAND
    missing = next((part for part in ("wire", "head") if part not in found.at), None)
    if missing is not None:
        return Metric(name, None, None, "mm", f"Not known: {found.absent[missing]}.", source)
    number, goal, words = (
        (0, -caudal(side), ("superior", "inferior")) if view == "AP" else (1, ANTERIOR, ("anterior", "posterior"))
    )

    def offset(parts: _Parts) -> np.ndarray:
        found.refuse_side(side)
        upward = _unit(np.cross(parts.beam(number), parts.wire))
        upward = upward * np.sign(upward[0] @ towards(upward[0], goal, f"the wire's normal in the {view} view"))
        return (parts.beside() * upward).sum(axis=-1)

    try:
        value, sd = _valued(found, offset, side)
    except ReconstructionRefusedError as refusal:
        return Metric(name, None, None, "mm", f"Not known: {refusal}.", source)
    third = float(found.part("head")[3]) / 3
    zone = "centre" if abs(value) <= third else words[0] if value > 0 else words[1]
    spread = "" if sd is None else f" ± {sd:.1f}"
    sentence = f"The wire passes {abs(value):.1f}{spread} mm {words[0] if value > 0 else words[1]} of the head's centre"
    sentence += f" in the {view} view: {zone} third."
    return Metric(name, value, sd, "mm", sentence, source, -third, third, zone)


def _apex(parts: _Parts) -> np.ndarray:
    """Where the line through the head's centre along the neck leaves it."""
    return parts.centre + parts.radius[:, None] * parts.neck


def _seen(way: np.ndarray, beam: np.ndarray) -> np.ndarray:
    """Length of a way as a view shows it, magnification corrected."""
    return np.linalg.norm(_across(way, beam), axis=-1)


def _across(vector: np.ndarray, along: np.ndarray) -> np.ndarray:
    """What of vectors is across unit vectors."""
    return vector - (vector * along).sum(axis=-1, keepdims=True) * along


def _angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1)))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
