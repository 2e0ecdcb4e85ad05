"""Attempts and exposures of a wire placed by hand: on two plain views, with image-matching curves, with a guide.

The operator is a model; all its parameters are [ours], and the results hold only for it.

- In each image the operator marks entry and end of the ideal wire by careful clicks. On plain views, lateral marks also
  have an error of `match_mm` along the patient, because the operator matches points by eye (in the paper: the problem
  of depth perception). With curves, lateral marks lie on the curve of the PA mark.
- In each attempt the operator inserts the wire, takes one PA and one lateral exposure, and reads the wire's two ends.
- On plain views the operator assumes that the views are exactly 90° apart, along the patient's axes, rotated upright by
  eye, and free of distortion. With curves, marks and wire are reconstructed from the calibrated views.
- If entry and direction seem within the limits, the operator stops. Otherwise the wire is withdrawn and inserted again,
  corrected by its apparent error, with a new random error of the hand. After MAX_ATTEMPTS the operator gives up.
- A guide (the paper's robot) holds the wire on the plan made with curves, so the first attempt is the plan itself.

Not modelled: a wire that follows its former hole, bends or skives on the cortex; fluoroscopy while drilling; movement
of the patient; learning; a surgeon's own, wider limits. Only errors across the wire count.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import radians
from typing import Any

import numpy as np

import sightline as sl
from sightline.calibration import BeadView
from sightline.errors import SightlineError
from sightline.frame import Frame, nominal
from sightline.planning import kind, plan
from sightline.studies.intervals import quantile, rms, share
from sightline.studies.scenes import VIEWS, draw_showing, measure
from sightline.studies.study import Estimate, EstimateGroup, Summary, Table, Values
from sightline.studies.study_robustness import WIRE_ENDS_MM
from sightline.twin import SetUp

LIMIT_MM, LIMIT_RAD = 1.0, radians(0.6)  # achieved in the paper
PICK_PX = 0.5  # a careful click (physics.md, Picks)
BEAD_PX = 0.1  # physics.md, Centroid limit
UPRIGHT = radians(3.0)  # s.d. of rotating an image upright by eye [ours]
FIRST_MM, FIRST_RAD = 5.0, radians(5.0)  # s.d. per axis of the first attempt, by an angle guide [ours]
GUIDE_MM, GUIDE_RAD = 0.2, radians(0.1)  # s.d. per axis of a guide on a plan [ours]
MAX_ATTEMPTS = 30  # attempts [ours]
# s.d. per axis of entry, mm, and direction, degrees, of a wire that is inserted again by hand [ours].
HANDS = {"steady hand": (0.5, 0.3), "ordinary hand": (1.0, 1.0)}
MATCHES_MM = (0.0, 1.0, 2.0, 4.0)  # s.d. of a lateral mark matched by eye [ours]
ALONG_PATIENT = np.array([0.0, 1.0, 0.0])
CURVES, GUIDE = "curves", "curves and guide"


@dataclass(frozen=True)
class Freehand:
    """The study; its fields can be varied."""

    name = "freehand"
    about = "Attempts and exposures until a wire lies within 1 mm and 0.6°: plain views, curves, a guide"

    hands: tuple[str, ...] = tuple(HANDS)
    matches_mm: tuple[float, ...] = MATCHES_MM

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants of the operator."""
        noise = {"pick_px": PICK_PX, "bead_px": BEAD_PX, "upright": UPRIGHT, "hands": HANDS}
        sizes = {"first": [FIRST_MM, FIRST_RAD], "guide": [GUIDE_MM, GUIDE_RAD], "limits": [LIMIT_MM, LIMIT_RAD]}
        return {**asdict(self), **noise, **sizes, "most": MAX_ATTEMPTS, "wire_mm": WIRE_ENDS_MM.tolist()}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return for each operator the attempts, whether it stopped, and the true error then; {} if refused."""
        setup = draw_showing(rng, Frame.load("gamma"), WIRE_ENDS_MM)
        seen, seed = measure(rng, setup, BEAD_PX), int(rng.integers(2**32))
        try:
            views = [sl.calibrate(seen[name], setup.frame) for name in VIEWS]
            out: Values = {GUIDE: _guided(setup, views, np.random.default_rng(seed))}
            for hand in self.hands:
                for match in self.matches_mm:
                    eyes = PlainEyes(setup, match, np.random.default_rng(seed))
                    out[key(f"plain, match {match:g} mm", hand)] = insert(eyes, HANDS[hand], seed)
                eyes = CalibratedEyes(setup, views, np.random.default_rng(seed))
                out[key(CURVES, hand)] = insert(eyes, HANDS[hand], seed)
        except SightlineError:
            return {}
        return out

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return attempts, exposures, and how often the wire is truly within the limits."""
        kept = [trial for trial in trials if trial]
        refused = share("set-ups refused", np.array([not trial for trial in trials]))
        if not kept:
            return Summary(("Every set-up was refused.",), (refused,), ())
        ended = {name: OperatorResult.of(name, [trial[name] for trial in kept]) for name in kept[0]}
        columns = (
            "operator",
            "attempts, median / 95 %",
            "exposures, median",
            "right first time",
            "stopped",
            "stopped and truly within",
            "true entry error, mm rms",
            "direction, ° rms",
        )
        note = "Exposures: two for each attempt, two for marks or plan. Errors: of those who stopped, across the wire."
        rows = tuple(one.row for one in ended.values())
        table = Table(f"Until the wire seems within {LIMIT_MM:g} mm and 0.6°", columns, rows, note)
        return Summary(
            findings=tuple(one.words for one in ended.values()),
            estimates=(refused, *(estimate for one in ended.values() for estimate in one.estimates)),
            tables=(table,),
        )


class PlainEyes:
    """An operator's readings on two plain views."""

    def __init__(self, setup: SetUp, match_mm: float, rng: np.random.Generator) -> None:
        self.setup, self.rng = setup, rng
        matched = WIRE_ENDS_MM + match_mm * rng.standard_normal((2, 1)) * ALONG_PATIENT
        self.marks_px = [self.read(name, there) for name, there in zip(VIEWS, (WIRE_ENDS_MM, matched), strict=True)]
        angles = UPRIGHT * rng.standard_normal(len(VIEWS))
        self.px_per_mm = np.vstack([assumed_scale(setup, name, a) for name, a in zip(VIEWS, angles, strict=True)])

    def read(self, view: str, xyz_mm: np.ndarray) -> np.ndarray:
        """Draw the clicks (N, 2) on points (N, 3)."""
        return self.setup.views[view].project(xyz_mm) + PICK_PX * self.rng.standard_normal((len(xyz_mm), 2))

    def error_mm(self, wire_mm: np.ndarray) -> np.ndarray:
        """Return the apparent errors (2, 3) of the wire's ends against their marks."""
        seen = [self.read(name, wire_mm) - marks for name, marks in zip(VIEWS, self.marks_px, strict=True)]
        return np.linalg.lstsq(self.px_per_mm, np.hstack(seen).T, rcond=None)[0].T


class CalibratedEyes(PlainEyes):
    """An operator's readings on calibrated views: lateral marks on the curves of PA marks, all points reconstructed."""

    def __init__(self, setup: SetUp, views: list[BeadView], rng: np.random.Generator) -> None:
        super().__init__(setup, 0.0, rng)
        self.views = views
        entry, end = np.array(self.marks_px).swapaxes(0, 1)
        self.plan_mm = plan(
            views, entry, end, pick_sd_px=PICK_PX, snapped=True, kind=kind("free-wire")
        ).trajectory.points.xyz_mm

    def error_mm(self, wire_mm: np.ndarray) -> np.ndarray:
        """Return the apparent errors (2, 3) of the wire's ends against the plan."""
        seen = np.array([self.read(name, wire_mm) for name in VIEWS])
        stated = np.broadcast_to(PICK_PX**2 * np.eye(2), (*seen.shape, 2))
        return sl.reconstruct(self.views, seen, stated).xyz_mm - self.plan_mm


def assumed_scale(setup: SetUp, view: str, angle: float) -> np.ndarray:
    """Return px per mm (2, 3) at the hip as assumed without calibration: nominal beam and magnification, with the image
    rotated by `angle` from upright."""
    truth = setup.views[view]
    steps = np.eye(3)
    true = (truth.project(steps) - truth.project(-steps)).T / 2
    beam = nominal.axis(setup.frame.view(view))
    across = np.array([ALONG_PATIENT, np.cross(beam, ALONG_PATIENT)])
    left, _, right = np.linalg.svd(true @ across.T)
    upright = left @ right  # the rotation or reflection nearest to the true orientation of the image
    c, s = np.cos(angle), np.sin(angle)
    scale = nominal.SOURCE_TO_DETECTOR_MM / nominal.SOURCE_TO_HIP_MM / truth.chain.pitch_mm
    return scale * np.array([[c, -s], [s, c]]) @ upright @ across


def insert(eyes: PlainEyes, hand: tuple[float, float], seed: int) -> Values:
    """Repeat attempts until the wire seems within the limits, at most MAX_ATTEMPTS times.

    `hand`: s.d. of entry, mm, and direction, degrees.
    """
    rng = np.random.default_rng([seed, 1])  # the same hand for all operators
    off = _placed(rng, FIRST_MM, FIRST_RAD)
    entry_mm, direction_rad = hand[0], radians(hand[1])
    for attempt in range(1, MAX_ATTEMPTS + 1):
        seems = eyes.error_mm(WIRE_ENDS_MM + off)
        if within(seems):
            return {"attempts": attempt, "stopped": True, **_measured(off)}
        off = off - across_wire(seems) + _placed(rng, entry_mm, direction_rad)
    return {"attempts": MAX_ATTEMPTS, "stopped": False, **_measured(off)}


def _guided(setup: SetUp, views: list[BeadView], rng: np.random.Generator) -> Values:
    """Return the result of a wire held on the plan: a single attempt."""
    eyes = CalibratedEyes(setup, views, rng)
    off = across_wire(eyes.plan_mm - WIRE_ENDS_MM) + _placed(
        np.random.default_rng(rng.integers(2**32)), GUIDE_MM, GUIDE_RAD
    )
    return {"attempts": 1, "stopped": True, **_measured(off)}


def _placed(rng: np.random.Generator, entry_mm: float, direction_rad: float) -> np.ndarray:
    """Draw the errors (2, 3) of both ends across a wire: from its entry and its direction."""
    entry, direction = entry_mm * rng.standard_normal(3), direction_rad * rng.standard_normal(3)
    length = np.linalg.norm(WIRE_ENDS_MM[1] - WIRE_ENDS_MM[0])
    return across_wire(np.array([entry, entry + length * direction]))


def across_wire(off_mm: np.ndarray) -> np.ndarray:
    """Return the components of errors (2, 3) perpendicular to the wire."""
    along = (WIRE_ENDS_MM[1] - WIRE_ENDS_MM[0]) / np.linalg.norm(WIRE_ENDS_MM[1] - WIRE_ENDS_MM[0])
    return off_mm - np.outer(off_mm @ along, along)


def within(off_mm: np.ndarray) -> bool:
    """Whether errors (2, 3) of the ends are within the limits."""
    return _kept(_measured(across_wire(off_mm)))


def _measured(off_mm: np.ndarray) -> Values:
    entry, end = off_mm
    length = np.linalg.norm(WIRE_ENDS_MM[1] - WIRE_ENDS_MM[0])
    angle = float(np.rad2deg(np.arctan2(np.linalg.norm(end - entry), length)))
    return {"entry_mm": float(np.linalg.norm(entry)), "direction_deg": angle}


def key(eyes: str, hand: str) -> str:
    """Return the name of one operator."""
    return f"{eyes}, {hand}"


@dataclass(frozen=True)
class OperatorResult(EstimateGroup):
    """The result of one operator."""

    name: str
    median: Estimate
    high: Estimate
    first: Estimate
    stopped: Estimate
    right: Estimate
    entry: Estimate
    direction: Estimate

    @staticmethod
    def of(name: str, outcomes: Sequence[Values]) -> "OperatorResult":
        """Return the result over all trials."""
        attempts = np.array([one["attempts"] for one in outcomes])
        stopped = np.array([one["stopped"] for one in outcomes])
        right = np.array([_kept(one) for one in outcomes])
        done = [one for one in outcomes if one["stopped"]]
        return OperatorResult(
            name,
            quantile(f"{name}: attempts, median", attempts, 0.5, ""),
            quantile(f"{name}: attempts, 95 %", attempts, 0.95, ""),
            share(f"{name}: right first time", stopped & right & (attempts == 1)),
            share(f"{name}: stopped", stopped),
            share(f"{name}: stopped and truly within the limits", stopped & right),
            rms(f"{name}: entry", [np.array([one["entry_mm"]]) for one in done], "mm"),
            rms(f"{name}: direction", [np.array([one["direction_deg"]]) for one in done], "°"),
        )

    @property
    def exposures(self) -> float:
        """The median number of exposures."""
        return 2 * (self.median.value or 0.0) + 2

    @property
    def words(self) -> str:
        """The result as a sentence."""
        return (
            f"{self.name}: {self.median.value:g} attempts (median), {self.exposures:g} exposures; right first time "
            f"{self.first.value:.0%}, in the end {self.right.value:.0%}."
        )

    @property
    def row(self) -> tuple[str, ...]:
        """The row of the table."""
        return (
            self.name,
            f"{self.median.value:g} / {self.high.value:g}",
            f"{self.exposures:g}",
            *(f"{estimate.value:.0%}" for estimate in (self.first, self.stopped, self.right)),
            "none" if self.entry.value is None else f"{self.entry.value:.2f}",
            "none" if self.direction.value is None else f"{self.direction.value:.2f}",
        )


def _kept(one: Values) -> bool:
    return one["entry_mm"] <= LIMIT_MM and one["direction_deg"] <= np.rad2deg(LIMIT_RAD)
