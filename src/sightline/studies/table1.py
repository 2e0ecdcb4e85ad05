"""The paper's Table 1: four test points in the biplane and the Γ frame, localized and global compensation.

The paper gives one table of one machine. Here it is a distribution over set-ups: test points are the four balls of the
twin; beads and frame errors are as in physics.md. Parameters that the paper does not state (plate distances, accuracy
of picks, the degree of the "global" function) are varied, and none is chosen by its result.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from sightline.frame import Frame
from sightline.frame.designs import builtin_design
from sightline.studies.methods import errors
from sightline.studies.runs.plots import Span, spans
from sightline.studies.runs.study import Estimate, EstimateGroup, Plot, Summary, Table, Values, quantile, share
from sightline.studies.scenes import BEAD_PX, CAREFUL_PX, CENTRED_PX, ORDINARY_PX, WHOLE, TargetScene, measure
from sightline.twin import draw_setup
from sightline.twin.scenes.hip_scene import TEST_BALLS_MM

BIPLANE = "biplane ±150"
GAMMA = "gamma 150/300"
# (frame, source plate, XRII plate), mm from the hip: the built-in frames, and two other distances for the Γ frame.
PLATES = {
    BIPLANE: ("biplane", -150.0, 150.0),
    GAMMA: ("gamma", 150.0, 300.0),
    "gamma 120/220": ("gamma", 120.0, 220.0),
    "gamma 200/250": ("gamma", 200.0, 250.0),
}
METHODS = (
    "smooth",
    "localized",
    "polynomial 1",
    "polynomial 2",
    "polynomial 3",
    "OpenCV 5",
    "OpenCV 14",
    "local weighted mean",
    "thin-plate spline",
)
GLOBAL = tuple(method for method in METHODS if method.startswith("polynomial"))
# The paper's Table 1: errors of test points 1 to 4, mm.
PAPER_MM = {
    ("biplane", "localized"): (0.48, 0.30, 0.33, 0.30),
    ("gamma", "localized"): (0.78, 0.42, 0.88, 0.84),
    ("gamma", "global"): (2.98, 2.60, 2.99, 3.40),
}


@dataclass(frozen=True)
class Table1:
    """The study; its fields can be varied."""

    name = "table1"
    about = "The paper's Table 1: error of four test points, by frame, method and pick"

    plates: tuple[str, ...] = tuple(PLATES)
    methods: tuple[str, ...] = METHODS
    picks_px: tuple[float, ...] = (CENTRED_PX, CAREFUL_PX, ORDINARY_PX)
    bead_px: float = BEAD_PX

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants that they depend on."""
        return {**asdict(self), "tolerances": asdict(WHOLE), "points_mm": TEST_BALLS_MM.tolist()}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return the four errors, mm, or None, for each "plates, method, pick", from one set-up of each frame."""
        values: Values = {}
        for plates in self.plates:
            setup = draw_setup(rng, frame_with(plates))
            scene = TargetScene.of(setup, measure(rng, setup, self.bead_px), TEST_BALLS_MM)
            noise = rng.standard_normal(scene.target_px.shape)  # the same for all picks, which differ only in its size
            picks = [(scene.target_px + sd * noise, sd) for sd in self.picks_px]
            for method in self.methods:
                for sd, error in zip(self.picks_px, errors(scene, method, picks), strict=True):
                    values[key(plates, method, sd)] = None if error is None else error.round(5).tolist()
        return values

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return distributions of the largest of four errors, compared with the paper's values."""
        spreads = {
            (plates, method, sd): Spread.of(key(plates, method, sd), trials)
            for plates in self.plates
            for method in self.methods
            for sd in self.picks_px
        }
        held = [PaperComparison(*place, spread) for place, spread in spreads.items()]
        against = [
            comparison
            for comparison in held
            if comparison.paper is not None and comparison.spread.middle.value is not None
        ]
        return Summary(
            findings=tuple(_findings(against)),
            estimates=tuple(estimate for spread in spreads.values() for estimate in spread.estimates),
            tables=(
                _paper_table(against, self.picks_px),
                *(self._methods_table(plates, spreads) for plates in self.plates),
                self._points_table(trials),
            ),
            plots=tuple(_plots(self.picks_px, against, spreads)),
        )

    def _methods_table(self, plates: str, spreads: dict[tuple[str, str, float], "Spread"]) -> Table:
        rows = [
            (
                method,
                *(spreads[plates, method, sd].cell for sd in self.picks_px),
                spreads[plates, method, self.picks_px[0]].refusals,
            )
            for method in self.methods
        ]
        columns = ("method", *(f"picks {sd:g} px" for sd in self.picks_px), "refused")
        return Table(
            f"Largest of four errors, mm: {plates} mm",
            columns,
            tuple(rows),
            "Median and 95 % over the set-ups that the method does not refuse; default tolerances of the frame.",
        )

    def _points_table(self, trials: Sequence[Values]) -> Table:
        rows = []
        for (frame, method), estimates in PAPER_MM.items():
            rows.append(
                (f"paper: {frame}, {method}", "by hand", *(f"{v:.2f}" for v in estimates), f"{max(estimates):.2f}")
            )
            for plates, sd in ((p, sd) for p in self.plates if PLATES[p][0] == frame for sd in self.picks_px):
                for own in GLOBAL if method == "global" else (method,):
                    each = _answers(key(plates, own, sd), trials) if own in self.methods else np.zeros((0, 4))
                    if len(each):
                        middle = [*np.median(each, axis=0), np.median(each.max(axis=1))]
                        rows.append((f"{plates}, {own}", f"{sd:g} px", *(f"{v:.2f}" for v in middle)))
        columns = ("frame, compensation", "picks", "point 1", "point 2", "point 3", "point 4", "maximum")
        return Table("Each test point: median error, mm", columns, tuple(rows), "The paper's points lay elsewhere.")


def frame_with(plates: str) -> Frame:
    """Return the frame of an entry of PLATES, with the default tolerances of balls, plates and arms."""
    name, source, xrii = PLATES[plates]
    return replace(Frame.from_design(replace(builtin_design(name), source_mm=source, xrii_mm=xrii)), tolerances=WHOLE)


def key(plates: str, method: str, pick_px: float) -> str:
    """Return the key of one result of a trial."""
    return f"{plates}, {method}, picks {pick_px:g} px"


def _answers(name: str, trials: Sequence[Values]) -> np.ndarray:
    """Return the errors (N, 4) of the trials that were not refused."""
    return np.array([trial[name] for trial in trials if trial[name] is not None]).reshape(-1, len(TEST_BALLS_MM))


@dataclass(frozen=True)
class Spread(EstimateGroup):
    """Distribution of the largest of four errors over set-ups: 5 %, median, 95 %; and the share of refusals."""

    low: Estimate
    middle: Estimate
    high: Estimate
    refused: Estimate

    @staticmethod
    def of(name: str, trials: Sequence[Values]) -> "Spread":
        """Return the distribution of one result over all trials."""
        largest = _answers(name, trials).max(axis=1, initial=0.0)
        words = f"{name}: {{}} of the largest of four"
        low, middle, high = (quantile(words.format(f"{at:.0%}"), largest, at) for at in (0.05, 0.5, 0.95))
        return Spread(low, middle, high, share(f"{name}: refused", np.array([trial[name] is None for trial in trials])))

    @property
    def cell(self) -> str:
        """The table cell: median / 95 %."""
        if self.middle.value is None or self.high.value is None:
            return "refused"
        return f"{self.middle.value:.3f} / {self.high.value:.3f}"

    @property
    def refusals(self) -> str:
        """The number of refusals and set-ups, as text."""
        return f"{round((self.refused.value or 0.0) * self.refused.number)} of {self.refused.number}"


@dataclass(frozen=True)
class PaperComparison:
    """One distribution compared with the paper's value, if there is one."""

    plates: str
    method: str
    pick_px: float
    spread: Spread

    @property
    def paper(self) -> float | None:
        """The paper's largest error of four, mm."""
        row = (PLATES[self.plates][0], "global" if self.method in GLOBAL else self.method)
        return max(PAPER_MM[row]) if row in PAPER_MM else None

    @property
    def where(self) -> str:
        """The paper's value relative to the central 90 %: inside, below, above, or undecided with too few trials."""
        paper = self.paper or 0.0
        if any(_may_be(end, paper) for end in (self.spread.low, self.spread.high)):
            return "undecided"
        low, high = self.spread.low.value or 0.0, self.spread.high.value or 0.0
        return "inside" if low <= paper <= high else "below" if paper < low else "above"

    @property
    def cell(self) -> str:
        """The table cell: the central 90 %, and the paper's value relative to it."""
        return f"{self.spread.low.value:.2f} to {self.spread.high.value:.2f}: {self.where}"


def _may_be(end: Estimate, value: float) -> bool:
    """Whether the interval of an end of the distribution contains a value; an open interval has no upper end."""
    return (end.low or 0.0) <= value <= (np.inf if end.high is None else end.high)


def _paper_table(held: Sequence[PaperComparison], picks_px: Sequence[float]) -> Table:
    rows = [
        (plates, method, f"{some[0].paper:.2f}", *(comparison.cell for comparison in some))
        for (plates, method), some in _by_place(held).items()
    ]
    columns = ("plates mm", "compensation", "paper", *(f"picks {sd:g} px" for sd in picks_px))
    note = (
        "Largest of four errors, mm: the central 90 % over set-ups, and the paper's value relative to it. That value "
        "is of one machine and one person; the paper does not state the degree of its global function."
    )
    return Table("The paper's Table 1", columns, tuple(rows), note)


def _by_place(held: Sequence[PaperComparison]) -> dict[tuple[str, str], list[PaperComparison]]:
    by_place: dict[tuple[str, str], list[PaperComparison]] = {}
    for comparison in held:
        by_place.setdefault((comparison.plates, comparison.method), []).append(comparison)
    return by_place


def _findings(held: Sequence[PaperComparison]) -> Iterable[str]:
    """Yield one sentence for each of the paper's values and each compensation that it may mean."""
    for (frame, method), estimates in PAPER_MM.items():
        for own in GLOBAL if method == "global" else (method,):
            places: dict[str, dict[str, list[str]]] = {}
            for h in held:
                if PLATES[h.plates][0] == frame and h.method == own:
                    places.setdefault(h.where, {}).setdefault(h.plates, []).append(f"{h.pick_px:g}")
            words = "; ".join(
                f"{where} for "
                + ", ".join(f"{plates} mm with picks of {'/'.join(picks)} px" for plates, picks in some.items())
                for where, some in places.items()
            )
            if words:
                paper = f"The paper's {max(estimates):.2f} mm ({frame}, {method})"
                yield f"{paper} against the central 90 % of {own}: {words}."


def _plots(
    picks_px: Sequence[float], held: Sequence[PaperComparison], spreads: dict[tuple[str, str, float], Spread]
) -> Iterable[Plot]:
    for sd in picks_px:
        rows = [_span(f"{h.plates}, {h.method}", h.spread, h.paper) for h in held if h.pick_px == sd]
        if rows:
            title = f"The paper's values, picks {sd:g} px"
            caption = "Largest of four errors: central 90 % (bar), median (tick). Diamond: the paper's Table 1."
            yield Plot(title, spans(rows, "mm", title, "the paper"), caption)
        rows = [
            _span(f"{plates}, {method}", spread, None)
            for (plates, method, own), spread in spreads.items()
            if own == sd and plates in (GAMMA, BIPLANE) and spread.middle.value is not None
        ]
        if rows:
            title = f"All methods on the same beads, picks {sd:g} px"
            yield Plot(title, spans(rows, "mm", title), "Largest of four errors: central 90 % (bar), median (tick).")


def _span(name: str, spread: Spread, mark: float | None) -> Span:
    low, middle, high = (estimate.value or 0.0 for estimate in (spread.low, spread.middle, spread.high))
    colour = "focal" if "smooth" in name else "frame" if "localized" in name else "beads"
    return Span(name, low, middle, high, mark, colour)
