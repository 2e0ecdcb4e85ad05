"""Coverage of the stated error of a target: predicted errors compared with actual errors.

Set-ups are independent, with one target each. Frame errors are drawn for each; every bead has its own, truly stated
covariance. Bead noise, tolerances of the frame, type of picks and image chain are drawn uniformly. Targets lie inside
and outside the convex hull of the beads.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2

import sightline as sl
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.planning import Pick, matching_curve, snap
from sightline.planning.points.picks import stack
from sightline.studies.bound import bound
from sightline.studies.methods import calibrated
from sightline.studies.runs.plots import PlotAxis, PlotPoint, PlotSeries, xy
from sightline.studies.runs.study import Estimate, EstimateGroup, Plot, Summary, Table, Values, quantile, rms, share
from sightline.studies.scenes import FAR_MM, FRAMES, TargetScene, draw_scene

PICKS = {"picks free, 0.1 px": 0.1, "picks free, 0.5 px": 0.5, "picks snapped, 0.5 px": 0.5}
LEVELS = (0.50, 0.95, 0.99)
MAX_NAMED = 5
BINS = 5  # of the predicted error, with equal counts
UNEVEN = 0.3  # [ours] standard deviations of beads vary by 30 %: bone and metal make the noise uneven


@dataclass(frozen=True)
class Coverage:
    """The study; its fields can be varied."""

    name = "coverage"
    about = "Predicted against actual error of a target: do the stated ellipsoids hold it?"

    methods: tuple[str, ...] = ("smooth", "localized", "polynomial 3")
    beads_px: tuple[float, ...] = (0.05, 0.1, 0.3)
    frames: tuple[str, ...] = tuple(FRAMES)
    picks: tuple[str, ...] = tuple(PICKS)
    chains: tuple[str, ...] = ("9in-1k", "9in-pal", "17cm-1k", "flat-panel")

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants that they depend on."""
        frames = {name: asdict(FRAMES[name]) for name in self.frames}
        return {**asdict(self), "tolerances": frames, "uneven": UNEVEN, "reach_mm": FAR_MM}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return the groups of one target, and for each method the stated and the actual error; None: refused."""
        bead = self.beads_px[rng.integers(len(self.beads_px))]
        frame, picks, chain = (each[rng.integers(len(each))] for each in (self.frames, self.picks, self.chains))
        toleranced = replace(Frame.load("gamma"), tolerances=FRAMES[frame])
        scene = draw_scene(rng, toleranced, bead, targets=1, reach_mm=FAR_MM, uneven=UNEVEN, chain=chain)
        noise = rng.standard_normal((2, 2))
        groups = [f"beads {bead:g} px", frame, picks, f"chain {chain}"]
        return {"groups": groups, **{method: outcome(scene, noise, picks, method) for method in self.methods}}

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return the shares of ellipsoids that contain their target, by method and group."""
        groups = ["all", "inside the hull", "outside the hull", *sorted({g for t in trials for g in t["groups"]})]
        held = {
            (method, group): GroupCoverage.of(f"{method}, {group}", _members(trials, method, group))
            for method in self.methods
            for group in groups
        }
        tables = [
            Table(
                f"{method}: how often the stated ellipsoids hold the target",
                ("group", "targets", *(f"{level:.0%}" for level in LEVELS), "normalised error", "volume"),
                tuple(_row(group, held[method, group]) for group in groups if held[method, group].number),
                "In brackets: 95 % intervals. Normalised error: rms per axis, 1 is right. Volume: median of the stated "
                "ellipsoid over that of the bound; a huge ellipsoid always contains its target and is useless.",
            )
            for method in self.methods
        ]
        refused = [
            share(f"{method}: targets refused", np.array([trial[method] is None for trial in trials]))
            for method in self.methods
        ]
        return Summary(
            findings=tuple(_findings(self.methods, groups, held, refused)),
            estimates=(*refused, *(estimate for coverage in held.values() for estimate in coverage.estimates)),
            tables=tuple(tables),
            plots=tuple(_plots(self.methods, trials)),
        )


def outcome(scene: TargetScene, noise: np.ndarray, picks: str, method: str) -> Values | None:
    """Return the result for one target, picked with `noise` (2, 2) in units of the pick's standard deviation."""
    sd = PICKS[picks]
    clicks = scene.target_px[:, 0] + sd * noise
    try:
        views = calibrated(scene, method)
        first, second = (Pick.free(click, sd) for click in clicks)
        if "snapped" in picks:
            second = snap(matching_curve(views[0], first.uv_px, views[1], first.covariance_px2), second.uv_px, sd)
        uv, covariance, across = stack([(first, second)])
        points = sl.reconstruct(views, uv, covariance, across_px=across)
    except SightlineError:
        return None
    error, stated = points.xyz_mm[0] - scene.target_mm[0], points.covariance_mm2[0]
    true_picks = np.broadcast_to(sd**2 * np.eye(2), (2, 2, 2))
    least = bound(scene.setup, scene.seen(true_picks, across[:, 0]), scene.target_mm[0])
    return {
        "square": float(error @ np.linalg.solve(stated, error)),
        "error_mm": float(np.linalg.norm(error)),
        "stated_mm": float(np.sqrt(np.trace(stated))),
        "volume": float(np.sqrt(np.linalg.det(stated) / np.linalg.det(least))),
        "inside": bool(points.inside_hull[0]),
    }


def _members(trials: Sequence[Values], method: str, group: str) -> list[Values]:
    """Return the results of a method in the trials of a group."""
    belongs: dict[str, Callable[[Values], bool]] = {
        "all": lambda trial: True,
        "inside the hull": lambda trial: trial[method]["inside"],
        "outside the hull": lambda trial: not trial[method]["inside"],
    }
    of_group = belongs.get(group, lambda trial: group in trial["groups"])
    return [trial[method] for trial in trials if trial[method] is not None and of_group(trial)]


@dataclass(frozen=True)
class GroupCoverage(EstimateGroup):
    """The coverage of one method in one group."""

    shares: tuple[Estimate, ...]
    normalised: Estimate
    volume: Estimate

    @staticmethod
    def of(name: str, outcomes: Sequence[Values]) -> "GroupCoverage":
        """Return the coverage over the targets of a group."""
        squares = np.array([outcome["square"] for outcome in outcomes])
        shares = (share(f"{name}: {p:.0%} ellipsoid holds the target", squares <= chi2.ppf(p, 3)) for p in LEVELS)
        normalised = rms(f"{name}: normalised error per axis", [np.array([s / 3]) ** 0.5 for s in squares])
        volumes = np.array([outcome["volume"] for outcome in outcomes])
        return GroupCoverage(tuple(shares), normalised, quantile(f"{name}: volume over the bound's", volumes, 0.5, ""))

    @property
    def number(self) -> int:
        """The number of targets."""
        return self.normalised.number

    def misses(self) -> list[str]:
        """Return the stated shares that are outside their intervals."""
        pairs = zip(LEVELS, self.shares, strict=True)
        return [f"{p:.0%}" for p, s in pairs if s.low is not None and s.high is not None and not s.low <= p <= s.high]


def _row(group: str, held: GroupCoverage) -> tuple[str, ...]:
    shares = [f"{s.value:.1%} ({s.low:.0%} to {s.high:.0%})" for s in held.shares]
    return group, str(held.number), *shares, f"{held.normalised.value:.2f}", f"{held.volume.value:.2f}"


def _findings(
    methods: Sequence[str],
    groups: Sequence[str],
    held: dict[tuple[str, str], GroupCoverage],
    refused: Sequence[Estimate],
) -> Iterable[str]:
    for method, none in zip(methods, refused, strict=True):
        whole = held[method, "all"]
        if not whole.number:
            yield f"{method} refuses every target."
            continue
        words = " / ".join(f"{p:.0%}" for p in LEVELS), " / ".join(f"{s.value:.1%}" for s in whole.shares)
        yield (
            f"{method}: the stated {words[0]} ellipsoids hold {words[1]} of {whole.number} targets; normalised error "
            f"{whole.normalised.value:.2f} (1 is right); it refuses {none.value:.1%}."
        )
        off = [f"{group} {level}" for group in groups for level in held[method, group].misses()]
        named = f" ({', '.join(off)})" if len(off) <= MAX_NAMED else ""
        number = len(LEVELS) * len(groups)
        yield (
            f"{method}: {len(off)} of {number} shares by group exclude the stated one from their 95 % interval{named};"
            f" chance alone would make that about {number * 0.05:.0f}."
        )


def _plots(methods: Sequence[str], trials: Sequence[Values]) -> Iterable[Plot]:
    series = []
    for method in methods:
        outcomes = sorted(
            (t[method] for t in trials if t[method] is not None), key=lambda outcome: outcome["stated_mm"]
        )
        if len(outcomes) < 2 * BINS:
            continue
        points = []
        for part in np.array_split(np.arange(len(outcomes)), BINS):
            stated = np.sqrt(np.mean([outcomes[k]["stated_mm"] ** 2 for k in part]))
            made = rms("", [np.array([outcomes[k]["error_mm"]]) for k in part], "mm")
            points.append(PlotPoint(float(stated), made.value or 0.0, made.low, made.high))
        series.append(PlotSeries(method, points))
    if series:
        title = "Predicted and actual error"
        drawing = xy(
            series, PlotAxis("predicted error, mm rms"), PlotAxis("actual error, mm rms"), title, diagonal=True
        )
        caption = "Targets sorted by their predicted error, in fifths. Dashed: an error as large as was predicted."
        yield Plot(title, drawing, caption)
