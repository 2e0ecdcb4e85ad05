"""Errors of targets relative to the lower bound of their set-ups.

The bound is the inverse Fisher information of the target (bound.py). The metric is rms (error / bound) over all
set-ups, where the bound of a target is the square root of the trace. 1 is the best value for an unbiased method that
knows the prior of the distortion, as the bound does. The bound for exactly known maps is printed beside it, to show
what remains without distortion.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from sightline.frame import Frame
from sightline.studies.bound import bound
from sightline.studies.figure_xy import PlotAxis, PlotPoint, PlotSeries, xy
from sightline.studies.intervals import rms, share
from sightline.studies.methods import errors
from sightline.studies.scenes import FRAMES, TargetScene, draw_scene
from sightline.studies.study import Estimate, Plot, Summary, Table, Values

TARGETS = 4
BOUND, KNOWN = "bound", "bound, maps known"


@dataclass(frozen=True)
class AgainstBound:
    """The study; its fields can be varied."""

    name = "bound"
    about = "Errors of targets against the bound that no unbiased method can beat"

    methods: tuple[str, ...] = ("smooth", "localized", "polynomial 3", "thin-plate spline")
    frames: tuple[str, ...] = tuple(FRAMES)
    picks_px: tuple[float, ...] = (0.1, 0.5, 1.0)  # centred, careful, ordinary (physics.md, Picks)
    bead_px: float = 0.1  # physics.md, Centroid limit

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants that they depend on."""
        return {**asdict(self), "tolerances": {n: asdict(FRAMES[n]) for n in self.frames}, "targets": TARGETS}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return for each "frame, pick" both bounds and each method's errors at four targets, mm; None: refused."""
        out: Values = {}
        for frame in self.frames:
            told = replace(Frame.load("gamma"), tolerances=FRAMES[frame])
            scene = draw_scene(rng, told, self.bead_px, targets=TARGETS)
            noise = rng.standard_normal(scene.target_px.shape)
            picks = [(scene.target_px + sd * noise, sd) for sd in self.picks_px]
            made = {method: errors(scene, method, picks) for method in self.methods}
            for k, sd in enumerate(self.picks_px):
                out[key(frame, sd)] = {
                    BOUND: _bounds(scene, sd, known_map=False),
                    KNOWN: _bounds(scene, sd, known_map=True),
                    **{method: _listed(each[k]) for method, each in made.items()},
                }
        return out

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return rms (error / bound) by frame, pick and method, and the rms errors and bounds."""
        places = {(frame, sd): key(frame, sd) for frame in self.frames for sd in self.picks_px}
        ratios = {
            (place, method): rms(f"{name}: {method}, error over bound", over(trials, name, method, BOUND))
            for place, name in places.items()
            for method in (*self.methods, KNOWN)
        }
        sizes = {
            (place, what): rms(f"{name}: {what}", [np.array(t[name][what]) for t in trials if t[name][what]], "mm")
            for place, name in places.items()
            for what in (BOUND, KNOWN, *self.methods)
        }
        refused = [
            share(f"{name}: {method} refused", np.array([t[name][method] is None for t in trials]))
            for name in places.values()
            for method in self.methods
        ]
        return Summary(
            findings=tuple(self._findings(ratios)),
            estimates=(*ratios.values(), *sizes.values(), *refused),
            tables=(self._ratio_table(ratios), self._size_table(sizes)),
            plots=tuple(self._plot(frame, sizes) for frame in self.frames),
        )

    def _findings(self, ratios: dict[Any, Estimate]) -> list[str]:
        out = []
        for method in self.methods:
            some = [f for (_, m), f in ratios.items() if m == method and f.value is not None]
            if not some:
                out.append(f"{method} refuses every set-up.")
                continue
            worst = max(some, key=lambda estimate: estimate.value or 0.0)
            least = min(estimate.value or 0.0 for estimate in some)
            out.append(f"{method}: rms (error / bound) from {least:.2f} to {worst} ({worst.name.split(':')[0]}).")
        known = [f.value for (_, m), f in ratios.items() if m == KNOWN and f.value is not None]
        if known:
            out.append(f"With maps known exactly the bound would be {min(known):.2f} to {max(known):.2f} of itself.")
        return out

    def _ratio_table(self, ratios: dict[Any, Estimate]) -> Table:
        rows = [
            (frame, f"{sd:g} px", *(str(ratios[(frame, sd), what]) for what in (*self.methods, KNOWN)))
            for frame in self.frames
            for sd in self.picks_px
        ]
        note = (
            "In brackets: 95 % intervals. 1 is the best possible value. Only set-ups that the method does not refuse."
        )
        return Table("rms (error / bound)", ("frame", "picks", *self.methods, KNOWN), tuple(rows), note)

    def _size_table(self, sizes: dict[Any, Estimate]) -> Table:
        columns = (BOUND, KNOWN, *self.methods)
        rows = [
            (frame, f"{sd:g} px", *(_three(sizes[(frame, sd), what].value) for what in columns))
            for frame in self.frames
            for sd in self.picks_px
        ]
        return Table("rms bound and rms error, mm", ("frame", "picks", *columns), tuple(rows))

    def _plot(self, frame: str, sizes: dict[Any, Estimate]) -> Plot:
        series = []
        for what in (BOUND, KNOWN, *self.methods):
            estimates = [(sd, sizes[(frame, sd), what]) for sd in self.picks_px]
            points = [PlotPoint(sd, f.value, f.low, f.high) for sd, f in estimates if f.value is not None]
            if points:
                series.append(PlotSeries(what, points, dashed=what in (BOUND, KNOWN)))
        title = f"Errors and bounds, {frame}"
        drawing = xy(series, PlotAxis("standard deviation of picks, px"), PlotAxis("rms, mm"), title)
        return Plot(title, drawing, "Three-dimensional errors of targets that beads surround; bounds dashed.")


def key(frame: str, pick_px: float) -> str:
    """Return the key of one part of a trial."""
    return f"{frame}, picks {pick_px:g} px"


def over(trials: Sequence[Values], name: str, what: str, of: str) -> list[np.ndarray]:
    """Return `what` over `of` at every target, for each trial that has it."""
    return [np.array(t[name][what]) / np.array(t[name][of]) for t in trials if t[name][what] is not None]


def _bounds(scene: TargetScene, pick_px: float, *, known_map: bool) -> list[float]:
    """Return the square root of the trace of the bound of each target, mm."""
    seen = scene.seen(np.broadcast_to(pick_px**2 * np.eye(2), (2, 2, 2)))
    each = [bound(scene.setup, seen, x, known_map=known_map) for x in scene.target_mm]
    return [float(np.sqrt(np.trace(c))) for c in each]


def _listed(error: np.ndarray | None) -> list[float] | None:
    return None if error is None else error.tolist()


def _three(value: float | None) -> str:
    return "refused" if value is None else f"{value:.3f}"
