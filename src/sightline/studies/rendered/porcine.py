"""The trials planned in the paper: porcine femurs in soft tissue, compared with its bored plastic femur. Whole images.

Each trial renders both views, finds and labels their beads, calibrates, and plans a wire; only the picks use the truth.
The bore of the plastic femur is visible, so its ends are careful clicks. A pig's femur has no bore, so its ends are
ordinary clicks. Errors of judging where the wire should go are not modelled, only those of picks, images and frame.
Scatter is that of the image chain, the same for both. The wire is planned, not drilled.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sightline.common.checks import failed
from sightline.common.geometry.lines import angle_rad
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.planning import kind, plan
from sightline.studies.runs.study import Estimate, EstimateGroup, Summary, Table, Values, quantile, rms, share
from sightline.studies.scenes import CAREFUL_PX, ORDINARY_PX, PAPER_DEG, PAPER_MM, PHANTOMS, VIEWS, calibrated_images

PICKS_PX = {"plastic, bored": CAREFUL_PX, "porcine": ORDINARY_PX}


@dataclass(frozen=True)
class Porcine:
    """The study; its fields can be varied."""

    name = "porcine"
    about = "Wires planned on images of a porcine femur in its flesh, beside the paper's plastic femur"

    phantoms: tuple[str, ...] = ("porcine", "plastic, bored")

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants that they depend on."""
        wires = {name: PHANTOMS[name].wire_mm.tolist() for name in self.phantoms}
        return {**asdict(self), "wires_mm": wires, "picks_px": {name: PICKS_PX[name] for name in self.phantoms}}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return for each phantom the plan's outcome, beads used per view, errors of the ends, mm, and direction, °."""
        return {name: _planned(name, np.random.default_rng(int(rng.integers(2**32)))) for name in self.phantoms}

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return outcomes and errors."""
        ended = {name: PhantomResult.of(name, [trial[name] for trial in trials]) for name in self.phantoms}
        columns = (
            "phantom",
            "picks",
            "refused",
            "NO-GO",
            "beads a view",
            "entry, mm",
            "end, mm",
            "direction, °",
            "within 1 mm and 0.6°",
            "mm rms over stated",
        )
        note = "Errors: median / 95 %. Within: entry and direction, as in the paper's six trials, of plans that are GO."
        table = Table("Plans on images", columns, tuple(result.row for result in ended.values()), note)
        return Summary(
            findings=tuple(result.words for result in ended.values()),
            estimates=tuple(estimate for result in ended.values() for estimate in result.estimates),
            tables=(table,),
        )


def _planned(phantom: str, rng: np.random.Generator) -> Values:
    try:
        setup, hip = PHANTOMS[phantom].draw(rng, Frame.load("gamma"))
        views = calibrated_images(rng, setup, hip)
        exact = np.array([setup.views[name].project(hip.wire_mm) for name in VIEWS])
        sd = PICKS_PX[phantom]
        uv = exact + sd * rng.standard_normal(exact.shape)
        made = plan(views, uv[:, 0], uv[:, 1], pick_sd_px=sd, procedure=kind("free-wire"))
    except SightlineError as error:
        return {"ended": "refused", "why": type(error).__name__}
    path, wire = made.trajectory, hip.wire_mm
    return {
        "ended": "GO" if made.verdict.go else "NO-GO",
        "why": ", ".join(sorted({check.name for check in failed(made.verdict.checks)})),
        "beads": [int(view.residuals.used.sum()) for view in views],
        "error_mm": np.linalg.norm(path.points.xyz_mm - wire, axis=1).round(6).tolist(),
        "stated_mm": np.sqrt(np.trace(path.points.covariance_mm2, axis1=1, axis2=2)).round(6).tolist(),
        "direction_deg": float(np.rad2deg(angle_rad(path.direction, wire[1] - wire[0]))),
    }


@dataclass(frozen=True)
class PhantomResult(EstimateGroup):
    """Outcomes of the plans on one phantom; `errors`: median and 95 % of entry, end and direction."""

    name: str
    refused: Estimate
    no_go: Estimate
    beads: Estimate
    errors: tuple[Estimate, ...]
    within: Estimate
    normalised: Estimate

    @staticmethod
    def of(name: str, outcomes: Sequence[Values]) -> "PhantomResult":
        """Return the result over all trials."""
        answered = [outcome for outcome in outcomes if outcome["ended"] != "refused"]
        go = [outcome for outcome in answered if outcome["ended"] == "GO"]
        kept = [outcome["error_mm"][0] <= PAPER_MM and outcome["direction_deg"] <= PAPER_DEG for outcome in go]
        sizes = {
            "entry": ([outcome["error_mm"][0] for outcome in answered], "mm"),
            "end": ([outcome["error_mm"][1] for outcome in answered], "mm"),
            "direction": ([outcome["direction_deg"] for outcome in answered], "°"),
        }
        errors = [
            quantile(f"{name}: {what}, {at:.0%}", np.array(values), at, unit)
            for what, (values, unit) in sizes.items()
            for at in (0.5, 0.95)
        ]
        counts = np.array([count for outcome in answered for count in outcome["beads"]])
        over = [np.array(outcome["error_mm"]) / np.array(outcome["stated_mm"]) for outcome in answered]
        return PhantomResult(
            name,
            share(f"{name}: refused", np.array([outcome["ended"] == "refused" for outcome in outcomes])),
            share(f"{name}: NO-GO", np.array([outcome["ended"] == "NO-GO" for outcome in outcomes])),
            quantile(f"{name}: beads a view, median", counts, 0.5, ""),
            tuple(errors),
            share(f"{name}: GO within {PAPER_MM:g} mm and {PAPER_DEG:g}°", np.array(kept, dtype=bool)),
            rms(f"{name}: error over stated, rms", over),
        )

    @property
    def words(self) -> str:
        """The result as a sentence."""
        entry, direction = self.errors[0], self.errors[4]
        if entry.value is None or direction.value is None:
            return f"{self.name}: every image is refused."
        within = "no plan is GO" if self.within.value is None else f"{self.within.value:.0%} of GO within 1 mm and 0.6°"
        return f"{self.name}: entry {entry.value:.2f} mm, direction {direction.value:.2f}° (medians); {within}."

    @property
    def row(self) -> tuple[str, ...]:
        """The row of the table."""
        pairs = zip(self.errors[::2], self.errors[1::2], strict=True)
        return (
            self.name,
            f"{PICKS_PX[self.name]:g} px",
            f"{self.refused.value:.0%}",
            f"{self.no_go.value:.0%}",
            "none" if self.beads.value is None else f"{self.beads.value:.0f}",
            *("none" if a.value is None else f"{a.value:.2f} / {b.value:.2f}" for a, b in pairs),
            "none" if self.within.value is None else f"{self.within.value:.0%}",
            str(self.normalised),
        )
