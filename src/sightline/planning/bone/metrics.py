"""Metrics of a planned hip implant's position, each with its standard deviation.

Each metric is a function of one vector (`Anatomy.values`), differentiated numerically, so that errors shared by the
bone's parts and the wire are propagated correctly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sightline.common.geometry.covariance import response
from sightline.common.geometry.lines import across, angle_rad, unit
from sightline.errors import ReconstructionRefusedError
from sightline.planning.bone.anatomy import Anatomy
from sightline.planning.bone.directions import ANTERIOR, MEDIAL, caudal, towards
from sightline.planning.bone.drawings import ENTRY_BORDERS, entry_to_oval, tip_in_tube, wire_in_oval, wire_in_tube

# Beyond this distance from the head's centre, as a share of its radius, a line only grazes the head [ours].
_MAX_OFFSET = 0.95
_CLEVELAND = "thirds of the head: Cleveland et al., J Bone Joint Surg Am 41-A:1399 (1959)"
_BAUMGAERTNER = "Baumgaertner et al., J Bone Joint Surg Am 77:1058 (1995)"
_KUZYK = "Kuzyk et al., J Orthop Trauma 26:414 (2012)"
_BY_DEFINITION = "by definition"
_IN_TUBE = "the ellipse nearest to a circle that touches the drawn borders"


@dataclass(frozen=True)
class Metric:
    """One metric: `value` and its standard deviation `sd`, in `unit`; `low`, `high`: its recommended range.

    `value` is None where it cannot be computed; `sentence` then says why. `sd` is None where a view's error is unknown.
    `zone`: the third of the head, for positions in the head. `source`: of the definition and the recommendation.
    `located`: whether all parts of the bone that it needs are located.
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
    located: bool = True

    @property
    def within(self) -> bool | None:
        """Whether the value lies in the recommended range; None without a value or without a range."""
        if self.value is None or (self.low is None and self.high is None):
            return None
        return (self.low is None or self.value >= self.low) and (self.high is None or self.value <= self.high)


@dataclass(frozen=True)
class _Definition:
    """The parts that a metric needs, its function of K sets of numbers, and its sentence.

    `asked`: few procedures ask for it, so that it is listed only where its parts are known. `either`: parts of which
    it needs one.
    """

    name: str
    needs: tuple[str, ...]
    value: Callable[["_Parts"], np.ndarray]
    unit: str
    sentence: str
    source: str
    low: float | None = None
    high: float | None = None
    asked: bool = False
    either: tuple[str, ...] = ()

    def missing(self, anatomy: Anatomy) -> list[str]:
        """Return the parts that it needs and that are not located."""
        alternative = self.either[:1] if anatomy.at.keys().isdisjoint(self.either) else ()
        return [part for part in (*self.needs, *alternative) if part not in anatomy.at]


def metrics(anatomy: Anatomy, side: str) -> tuple[Metric, ...]:
    """Return all metrics of an implant in a fixed order; `side` of the hip: "right" or "left".

    A metric that cannot be computed has no value and says why. Raises UnusableInputError for another side.
    """
    caudal(side)
    asked = [known for known in _DEFINITIONS if not (known.asked and known.missing(anatomy))]
    made = [_metric(anatomy, definition, side) for definition in asked]
    return (*made, *(_position(anatomy, name, side) for name in ("AP", "lateral")))


def metric(anatomy: Anatomy, name: str, side: str | None) -> Metric:
    """Return one metric of an implant by its name. Raises UnusableInputError for an unknown side.

    `side`: may be None for those of `CHECKS` that need no side.
    """
    if side is not None:
        caudal(side)
    return _metric(anatomy, _definition(name), side)


def metric_of_wires(anatomy: Anatomy, name: str, side: str | None, wires_mm: np.ndarray) -> np.ndarray:
    """Return a metric (K,) of other wires (K, 2, 3) in the same bone; NaN where a wire has none.

    The wire in `found` must have a value: its refusals and signs hold for all.
    """
    values = np.tile(anatomy.values, (len(wires_mm) + 1, 1))
    values[1:, anatomy.at["wire"]] = wires_mm.reshape(-1, 6)
    with np.errstate(invalid="ignore", divide="ignore"):
        made = _definition(name).value(_Parts(anatomy, values, side))[1:]
    return made if made.ndim == 1 else np.linalg.norm(made, axis=-1)


def _definition(name: str) -> _Definition:
    return next(definition for definition in _DEFINITIONS if definition.name == name)


def _metric(anatomy: Anatomy, definition: _Definition, side: str | None) -> Metric:
    unit, end = definition.unit, (definition.source, definition.low, definition.high)
    try:
        value, sd = _evaluated(anatomy, definition.missing(anatomy), definition.value, side)
    except ReconstructionRefusedError as refusal:
        located = not definition.missing(anatomy)
        return Metric(definition.name, None, None, unit, f"Not known: {refusal}.", *end, located=located)
    spread = "" if sd is None else f" ± {sd:.1f}"
    return Metric(definition.name, value, sd, unit, definition.sentence.format(f"{value:.1f}{spread} {unit}"), *end)


def _evaluated(
    anatomy: Anatomy, needs: Sequence[str], function: Callable[["_Parts"], np.ndarray], side: str | None
) -> tuple[float, float | None]:
    """Return a metric's value and its standard deviation; of a vector (K, 3) its length, and the largest one of its
    components, since a length does not change to first order where it is zero.

    Raises ReconstructionRefusedError, also where a part that it `needs` is absent.
    """
    if missing := [part for part in needs if part not in anatomy.at]:
        raise ReconstructionRefusedError(anatomy.why_absent(missing[0]))

    def numbers(values: np.ndarray) -> np.ndarray:
        return function(_Parts(anatomy, values, side)).reshape(len(values), -1)

    value, own = response(numbers, anatomy.values)
    if len(value) == 1:
        sd = None if anatomy.covariance is None else float(np.sqrt(own[0] @ anatomy.covariance @ own[0]))
        return float(value[0]), sd
    sd = (
        None if anatomy.covariance is None else float(np.sqrt(np.linalg.eigvalsh(own @ anatomy.covariance @ own.T)[-1]))
    )
    return float(np.linalg.norm(value)), sd


def tip_depth(anatomy: Anatomy) -> tuple[float, float | None]:
    """Return the tip's depth below the head's nearest surface, mm, and its standard deviation; needs wire and head."""
    return _evaluated(anatomy, ("wire", "head"), _nearest_bone, "right")  # the same for both sides


class _Parts:
    """Parts of the bone for K sets of `Anatomy.values`, (K, n); directions are unit vectors (K, 3)."""

    def __init__(self, anatomy: Anatomy, values: np.ndarray, side: str | None) -> None:
        self._anatomy, self._values, self.side = anatomy, values, side or ""

    def _of(self, name: str, first: int = 0, count: int = 3) -> np.ndarray:
        start = self._anatomy.at[name].start + first
        return self._values[:, start : start + count]

    @property
    def entry(self) -> np.ndarray:
        return self._of("wire")

    @property
    def tip(self) -> np.ndarray:
        return self._of("wire", 3)

    @property
    def wire(self) -> np.ndarray:
        return unit(self.tip - self.entry)

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
        self._anatomy.refuse_side(self.side)
        return self._axis("shaft", caudal(self.side))

    @property
    def middle_of_neck(self) -> np.ndarray:
        return (self._of("neck") + self._of("neck", 3)) / 2

    @property
    def to_surface(self) -> np.ndarray:
        """Vector (K, 3) along the wire from the entry to the drawn surface; of two to the deeper one, since the bone
        lies inside both."""
        planes = (self.plane(name) for name in ENTRY_BORDERS if name in self._anatomy.at)
        ways = [((on - self.entry) * n).sum(axis=-1) / (self.wire * n).sum(axis=-1) for on, n in planes]
        return max(ways, key=lambda way: way[0])[:, None] * self.wire

    def beam(self, view: int) -> np.ndarray:
        """Return the ray of a view (0: PA, 1: lateral) through the head's centre."""
        return unit(self.centre - self._of("focal", 3 * view))

    def tube(self, name: str) -> np.ndarray:
        """Return a tube of the bone (K, 2, 5, 3)."""
        return self._of(name, 0, 30).reshape(-1, 2, 5, 3)

    def plane(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return point and normal (K, 3) of a plane, the normal along the wire."""
        normal = self._of(name, 3)
        return self._of(name), normal * np.sign(normal[0] @ self.wire[0])

    def offset(self) -> np.ndarray:
        """Return the perpendicular from the head's centre to the wire."""
        return across(self.entry - self.centre, self.wire)

    def _axis(self, name: str, goal: np.ndarray) -> np.ndarray:
        along = unit(self._of(name, 3) - self._of(name))
        return along * np.sign(along[0] @ towards(along[0], goal, f"the {name} axis"))


def _version(parts: _Parts) -> np.ndarray:
    """Return the angle of the neck to the frame's frontal plane (X and the shaft), seen along the shaft."""
    forward = unit(across(ANTERIOR, parts.shaft))
    inward = np.cross(parts.shaft, forward)
    inward *= np.sign(inward[:, :1] * MEDIAL[0])
    return np.rad2deg(np.arctan2((parts.neck * forward).sum(axis=-1), (parts.neck * inward).sum(axis=-1)))


def _calcar_tip_apex(parts: _Parts) -> np.ndarray:
    """Return the tip-apex distance with the PA view's apex on the line along the calcar, parallel to the neck."""
    beam = parts.beam(0)
    along = unit(across(parts.neck, beam))
    from_centre = across(parts.calcar - parts.centre, beam)
    offset = across(from_centre, along)
    rest = parts.radius**2 - (offset**2).sum(axis=-1)
    if rest[0] <= (1 - _MAX_OFFSET**2) * parts.radius[0] ** 2:
        raise ReconstructionRefusedError("the line along the calcar misses the head; click on the calcar again")
    apex = parts.centre + offset + np.sqrt(rest)[:, None] * along
    return _seen(parts.tip - apex, beam) + _seen(parts.tip - _apex(parts), parts.beam(1))


def _nearest_bone(parts: _Parts) -> np.ndarray:
    return parts.radius - np.linalg.norm(parts.tip - parts.centre, axis=-1)


def _bone_ahead(parts: _Parts) -> np.ndarray:
    offset2 = (parts.offset() ** 2).sum(axis=-1)
    if offset2[0] >= (_MAX_OFFSET * parts.radius[0]) ** 2:
        raise ReconstructionRefusedError(
            f"the wire passes the head's centre at {np.sqrt(offset2[0]):.1f} mm, outside the head or at its rim"
        )
    reached = ((parts.tip - parts.centre) * parts.wire).sum(axis=-1)
    return np.sqrt(parts.radius**2 - offset2) - reached


_DEFINITIONS = (
    _Definition(
        "wire length",
        ("wire",),
        lambda parts: np.linalg.norm(parts.tip - parts.entry, axis=-1),
        "mm",
        "From entry to end the wire runs {}.",
        _BY_DEFINITION,
    ),
    _Definition(
        "wire to shaft",
        ("wire", "shaft"),
        lambda parts: np.rad2deg(angle_rad(parts.wire, parts.shaft)),
        "°",
        "The wire makes an angle of {} with the shaft (measured like the neck-shaft angle).",
        _BY_DEFINITION,
    ),
    _Definition(
        "neck-shaft angle",
        ("neck", "shaft"),
        lambda parts: np.rad2deg(angle_rad(parts.neck, parts.shaft)),
        "°",
        "Neck and shaft enclose {}.",
        _BY_DEFINITION,
    ),
    _Definition(
        "neck version",
        ("neck", "shaft"),
        _version,
        "°",
        "Seen along the shaft, the neck points {} forward of the frame's frontal plane; the knee is not seen.",
        _BY_DEFINITION,
    ),
    _Definition(
        "tip-apex distance",
        ("wire", "head", "neck"),
        lambda parts: _seen(parts.tip - _apex(parts), parts.beam(0)) + _seen(parts.tip - _apex(parts), parts.beam(1)),
        "mm",
        "The tip-apex distance, the sum of both views, is {}; cut-out is rare below 25 mm.",
        _BAUMGAERTNER,
        10.0,
        25.0,
    ),
    _Definition(
        "calcar tip-apex distance",
        ("wire", "head", "neck", "calcar"),
        _calcar_tip_apex,
        "mm",
        "With the calcar as reference in the PA view, the tip-apex distance is {}.",
        _KUZYK,
    ),
    _Definition(
        "tip to bone along wire",
        ("wire", "head"),
        _bone_ahead,
        "mm",
        "From the tip to the head's surface, along the wire, it is {}.",
        "5 to 10 mm under the subchondral bone (physics.md)",
        5.0,
        10.0,
    ),
    _Definition(
        "tip to bone nearest",
        ("wire", "head"),
        _nearest_bone,
        "mm",
        "The head's nearest surface is {} from the tip.",
        "5 to 10 mm under the subchondral bone (physics.md)",
        5.0,
        10.0,
    ),
    _Definition(
        "wire in neck",
        ("wire", "outline"),
        lambda parts: wire_in_tube(parts.entry, parts.tip, parts.tube("outline"), "neck"),
        "mm",
        "Between the drawn borders of the neck its surface is {} or more from the wire.",
        _IN_TUBE,
        asked=True,
    ),
    _Definition(
        "wire off neck axis",
        ("wire", "neck"),
        lambda parts: across(parts.middle_of_neck - parts.entry, parts.wire),
        "mm",
        "At the middle of the drawn neck axis the wire passes {} from it.",
        _BY_DEFINITION,
        asked=True,
    ),
    _Definition(
        "wire in sacral corridor",
        ("wire", "s1-corridor"),
        lambda parts: wire_in_tube(parts.entry, parts.tip, parts.tube("s1-corridor"), "corridor"),
        "mm",
        "Between the drawn borders of the corridor its surface is {} or more from the wire.",
        _IN_TUBE,
        asked=True,
    ),
    _Definition(
        "tip in sacral corridor",
        ("wire", "s1-corridor"),
        lambda parts: tip_in_tube(parts.entry, parts.tip, parts.tube("s1-corridor"), "corridor"),
        "mm",
        "The tip lies {} before the end of the drawn borders of the corridor.",
        _BY_DEFINITION,
        asked=True,
    ),
    _Definition(
        "wire in pedicle",
        ("wire", "pedicle"),
        lambda parts: wire_in_oval(parts.entry, parts.tip, parts.tube("pedicle"), "pedicle"),
        "mm",
        "At the pedicle's narrowest place its surface is {} or more from the wire.",
        "the drawn oval and borders",
        asked=True,
    ),
    _Definition(
        "entry to pedicle",
        ("wire", "pedicle"),
        lambda parts: entry_to_oval(parts.entry, parts.tip, parts.tube("pedicle"), "pedicle"),
        "mm",
        "From the entry to the pedicle's narrowest place it is {}.",
        _BY_DEFINITION,
        asked=True,
    ),
    _Definition(
        "tip behind front",
        ("wire", "front"),
        lambda parts: _behind(parts, "front"),
        "mm",
        "The tip lies {} behind the front of the vertebral body.",
        _BY_DEFINITION,
        asked=True,
    ),
    _Definition(
        "tip short of front",
        ("wire", "front"),
        lambda parts: _behind(parts, "front"),
        "mm",
        "To the front of the vertebral body the tip lacks {}.",
        _BY_DEFINITION,
        asked=True,
    ),
    _Definition(
        "entry to cortex",
        ("wire",),
        lambda parts: parts.to_surface,
        "mm",
        "Along the wire the entry lies {} from the drawn surface of the bone.",
        _BY_DEFINITION,
        asked=True,
        either=ENTRY_BORDERS,
    ),
    _Definition(
        "tip to endplates",
        ("wire", "upper-endplate", "lower-endplate"),
        lambda parts: _between(parts, "upper-endplate", "lower-endplate"),
        "mm",
        "The tip lies {} from the nearer end plate.",
        _BY_DEFINITION,
        asked=True,
    ),
    _Definition(
        "wire to growth plate",
        ("wire", "growth-plate"),
        lambda parts: _from_normal_deg(parts, "growth-plate"),
        "°",
        "The wire makes an angle of {} with the perpendicular of the growth plate.",
        _BY_DEFINITION,
        asked=True,
    ),
    _Definition(
        "wire off middle of growth plate",
        ("wire", "growth-plate"),
        lambda parts: _off_middle(parts, "growth-plate"),
        "mm",
        "The wire crosses the growth plate {} from its middle.",
        _BY_DEFINITION,
        asked=True,
    ),
    _Definition(
        "tip beyond growth plate",
        ("wire", "growth-plate"),
        lambda parts: -_behind(parts, "growth-plate"),
        "mm",
        "The tip lies {} beyond the growth plate.",
        _BY_DEFINITION,
        asked=True,
    ),
)


def _position(anatomy: Anatomy, view: str, side: str) -> Metric:
    """Return how far from the head's centre the wire passes in one view, and in which third of the head."""
    name, source = f"position {view}", _CLEVELAND
    number, goal, words = (
        (0, -caudal(side), ("superior", "inferior")) if view == "AP" else (1, ANTERIOR, ("anterior", "posterior"))
    )

    def offset(parts: _Parts) -> np.ndarray:
        anatomy.refuse_side(side)
        upward = unit(np.cross(parts.beam(number), parts.wire))
        upward = upward * np.sign(upward[0] @ towards(upward[0], goal, f"the wire's normal in the {view} view"))
        return (parts.offset() * upward).sum(axis=-1)

    try:
        value, sd = _evaluated(anatomy, ("wire", "head"), offset, side)
    except ReconstructionRefusedError as refusal:
        located = anatomy.at.keys() >= {"wire", "head"}
        return Metric(name, None, None, "mm", f"Not known: {refusal}.", source, located=located)
    third = float(anatomy.part("head")[3]) / 3
    zone = "centre" if abs(value) <= third else words[0] if value > 0 else words[1]
    spread = "" if sd is None else f" ± {sd:.1f}"
    sentence = f"The wire passes {abs(value):.1f}{spread} mm {words[0] if value > 0 else words[1]} of the head's centre"
    sentence += f" in the {view} view: {zone} third."
    return Metric(name, value, sd, "mm", sentence, source, -third, third, zone)


def _behind(parts: _Parts, name: str) -> np.ndarray:
    """Return how far the tip lies before a plane, seen along the wire."""
    point, normal = parts.plane(name)
    return ((point - parts.tip) * normal).sum(axis=-1)


def _between(parts: _Parts, *names: str) -> np.ndarray:
    """Return the tip's distance from the nearer of two planes; negative where it does not lie between them."""
    upper, lower = (parts.plane(name) for name in names)
    distances = []
    for (point, normal), (other, _) in ((upper, lower), (lower, upper)):
        inward = normal * np.sign((other - point)[0] @ normal[0])
        distances.append(((parts.tip - point) * inward).sum(axis=-1))
    return np.min(distances, axis=0)


def _from_normal_deg(parts: _Parts, name: str) -> np.ndarray:
    """Return a vector (K, 3) perpendicular to a plane's normal, as long as the wire's angle to it, °."""
    normal = parts.plane(name)[1]
    off = across(parts.wire, normal)
    sine = np.linalg.norm(off, axis=-1, keepdims=True)
    return off * np.rad2deg(angle_rad(parts.wire, normal))[:, None] / np.maximum(sine, 1e-12)


def _off_middle(parts: _Parts, name: str) -> np.ndarray:
    """Return the vector (K, 3) from the middle of a plane's drawing to where the wire crosses the plane."""
    point, normal = parts.plane(name)
    reached = ((point - parts.tip) * normal).sum(axis=-1) / (parts.wire * normal).sum(axis=-1)
    return parts.tip + reached[:, None] * parts.wire - point


def _apex(parts: _Parts) -> np.ndarray:
    """Return where the neck's direction through the head's centre meets its surface."""
    return parts.centre + parts.radius[:, None] * parts.neck


def _seen(vector: np.ndarray, beam: np.ndarray) -> np.ndarray:
    """Return the length of a vector as a view shows it, corrected for magnification."""
    return np.linalg.norm(across(vector, beam), axis=-1)
