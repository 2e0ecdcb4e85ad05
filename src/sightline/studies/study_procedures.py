"""Plans of each procedure on its own bone: errors, how often the stated bounds hold, and how many are GO.

Every trial draws a patient and a set-up for each procedure; its ideal wires are picked, its landmarks and aids drawn
with a careful click's noise, and the beads measured with theirs. The edges of a nail are points with the noise of edges
that were found in images; with `nail_images` they are found in rendered ones, from clicks 2 px off. Nothing else is
rendered. Misjudgement of the person, who must find these points in an image, is not included.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.case.report.comparison import Compared, Truth
from sightline.checks import failed
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.interlocking import NailDrawn, find_hole, find_nail
from sightline.planning import Hole, Plan, WirePlans, fit_hole
from sightline.rehearsal.patient import (
    AT_HIP,
    BONES_OF,
    NAIL_CLICK_PX,
    NAILED,
    RehearsedPatient,
    draw_patient,
    frame_of,
)
from sightline.studies.intervals import quantile, share
from sightline.studies.nail_edges import OUTLINE_PX, RIM_PX, Sight, seen
from sightline.studies.scenes import calibrated_views, measure
from sightline.studies.study import Estimate, EstimateGroup, Summary, Table, Values
from sightline.twin import BoneScene, ViewTruth
from sightline.twin.femur import to_cfcs
from sightline.twin.nailed_femur import NailedFemur

BEAD_PX, PICK_PX = 0.1, 0.5  # physics.md: Centroid limit, Picks
SIDES = ("right", "left")
_NAMES = ("entry", "end", "direction")


@dataclass(frozen=True)
class Procedures:
    """The study; its fields can be varied. `nail_images`: render a nail, which takes 10 s of a core for each trial."""

    name = "procedures"
    about = "Right plans of every procedure on its own bone: errors, their bounds, and how many are GO"

    procedures: tuple[str, ...] = (*AT_HIP, *BONES_OF)
    nail_images: bool = False

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants that they depend on."""
        frames = {name: frame_of(name) for name in self.procedures}
        noise = {"bead_px": BEAD_PX, "pick_px": PICK_PX, "nail_px": NAIL_CLICK_PX, "edge_px": [OUTLINE_PX, RIM_PX]}
        return {**asdict(self), "frames": frames, **noise}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return for each procedure how its plan ended, the checks that failed, and of each wire the errors of entry
        and end, mm, and direction, °, and whether each lies within its stated 95 % bound; of a refusal its message."""
        return {name: _planned(name, int(rng.integers(2**32)), self.nail_images) for name in self.procedures}

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return a row for each procedure."""
        found = [ProcedureResult.of(name, [trial[name] for trial in trials]) for name in self.procedures]
        columns = ("procedure", "frame", "plans", "entry mm", "end mm", "direction °", "within 95 % bounds", "GO")
        note = (
            "Errors: median / 95 %. Within: of entries, ends and directions; those of one set-up are not independent, "
            "so its interval is too narrow. GO: of plans, with all their wires and relations."
        )
        table = Table("Right plans by procedure", (*columns, "refused for"), tuple(one.row for one in found), note)
        return Summary(
            findings=tuple(one.words for one in found),
            estimates=tuple(estimate for one in found for estimate in one.estimates),
            tables=(table,),
        )


def _planned(procedure: str, seed: int, nail_images: bool) -> Values:
    rng = np.random.default_rng([seed, 1])  # of the noise; the patient has its own
    try:
        side = SIDES[seed % len(SIDES)]
        imaged = nail_images and procedure == NAILED
        patient = draw_patient(procedure, seed, Frame.load(frame_of(procedure)), side, imaged=imaged)
        views = calibrated_views(patient.setup, measure(rng, patient.setup, BEAD_PX))
        made = _plan(patient, views, rng, imaged)
    except SightlineError as error:
        return {"ended": "refused", "why": [type(error).__name__], "said": str(error)}
    plans = [made] if isinstance(made, Plan) else [made.plans[wire.key] for wire in patient.document.wires]
    compared = [
        Compared("smooth", "", plan.trajectory, Truth(wire, patient.pixels(wire)))
        for plan, wire in zip(plans, patient.wires_mm, strict=True)
    ]
    return {
        "ended": made.verdict.state,
        "why": sorted({check.name for check in failed(made.verdict.checks)}),
        "errors": [list(one.errors) for one in compared],
        "within": [[e <= b for e, b in zip(one.errors, one.bounds_95 or (), strict=False)] for one in compared],
    }


def _plan(
    patient: RehearsedPatient, views: Sequence[CalibratedView], rng: np.random.Generator, imaged: bool
) -> Plan | WirePlans:
    """Return the plan of what a person draws; holes of a nail are found in its images, or fitted to its edges."""
    asked, _ = patient.asked(rng, PICK_PX)
    if asked.nail is None:
        return asked.plan_on(views) if asked.others is None else asked.plan_wires_on(views)
    if imaged:
        found = find_nail(views, list(patient.images.values()), asked.nail.strokes_px, asked.nail.nail)
        holes = {key: find_hole(found, uv) for key, uv in asked.nail.clicks_px.items()}
    else:
        holes = _fitted(patient, views, asked.nail, rng)
    return asked.plan_holes_on(views, holes)


def _fitted(
    patient: RehearsedPatient, views: Sequence[CalibratedView], drawn: NailDrawn, rng: np.random.Generator
) -> dict[str, Hole]:
    """Return the holes of a nail by the procedure's wires, fitted to points of their edges as the images show them."""
    bone = patient.bone
    assert isinstance(bone, BoneScene) and isinstance(bone.dimensions, NailedFemur)  # noqa: S101
    sights = {name: _anatomical(view, bone) for name, view in patient.setup.views.items()}
    nail, upwards = bone.dimensions.nail, range(len(drawn.clicks_px))[::-1]  # wires run from the nail's tip upwards
    return {
        key: fit_hole(views, seen(rng, nail, sights, hole), drawn.nail)
        for key, hole in zip(drawn.clicks_px, upwards, strict=True)
    }


def _anatomical(view: ViewTruth, bone: BoneScene) -> Sight:
    """Return a view of a bone's anatomical coordinates."""
    return Sight(bone.anatomical(view.focal_point_mm), lambda mm: view.project(to_cfcs(mm, bone.side, bone.origin_mm)))


@dataclass(frozen=True)
class ProcedureResult(EstimateGroup):
    """The plans of one procedure; `errors`: median and 95 % of entry, end and direction."""

    name: str
    errors: tuple[Estimate, ...]
    within: Estimate
    go: Estimate
    refused: str

    @staticmethod
    def of(name: str, outcomes: Sequence[Values]) -> "ProcedureResult":
        """Return the result over all trials."""
        made = [one for one in outcomes if one["ended"] != "refused"]
        errors = np.array([wire for one in made for wire in one["errors"]]).reshape(-1, len(_NAMES))
        held = np.array([within for one in made for wire in one["within"] for within in wire], dtype=bool)
        why = Counter(each for one in outcomes for each in one["why"])
        return ProcedureResult(
            name,
            tuple(
                quantile(f"{name}: {what}, {at:.0%}", errors[:, k], at, "°" if what == "direction" else "mm")
                for k, what in enumerate(_NAMES)
                for at in (0.5, 0.95)
            ),
            share(f"{name}: within the 95 % bounds", held),
            share(f"{name}: GO", np.array([one["ended"] == "go" for one in outcomes])),
            ", ".join(f"{check} {count}" for check, count in why.most_common(4)),
        )

    @property
    def row(self) -> tuple[str, ...]:
        """The row of the table."""
        pairs = zip(self.errors[::2], self.errors[1::2], strict=True)
        shown = ["none" if a.value is None else f"{a.value:.2f} / {b.value:.2f}" for a, b in pairs]
        parts = [_percent(self.within), _percent(self.go)]
        return (self.name, frame_of(self.name), str(self.go.number), *shown, *parts, self.refused)

    @property
    def words(self) -> str:
        """The result as a sentence."""
        if self.errors[0].value is None:
            return f"{self.name}: every plan is refused."
        entry, end, direction = (one.value for one in self.errors[::2])
        return (
            f"{self.name}: entry {entry:.2f} mm, end {end:.2f} mm, direction {direction:.2f}° (medians); "
            f"{_percent(self.go)} GO."
        )


def _percent(one: Estimate) -> str:
    return "none" if one.value is None else f"{one.value:.1%} ({one.low:.0%} to {one.high:.0%})"
