"""Right plans of each procedure on its own bone: errors, how often their stated bounds hold, and how many are GO.

Each trial draws a patient, a set-up and what a person draws, with a careful click's noise; beads and edges of a nail
are points with the noise of measured ones. Of a hip's free wire the band of the image-matching curve is measured too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from benchmarks.holes.nail_edges import Sight, seen
from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from sightline.calibration.view import CalibratedView
from sightline.case.report.content import Compared, Truth
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.planning import Hole, Plan, fit_hole, matching_curve
from sightline.rehearsal.patient import AT_HIP, BONES_OF, RehearsedPatient, draw_patient, frame_of
from sightline.studies.scenes import calibrated_views, measure
from sightline.twin import BoneScene
from sightline.twin.anatomy.femur import to_cfcs
from sightline.twin.anatomy.nailed_femur import NailedFemur

TRIALS = 200  # of each procedure
BEAD_PX, PICK_PX = 0.1, 0.5  # physics.md: Centroid limit, Picks
SIDES = ("right", "left")
CURVES_OF = "free-wire"


@dataclass(frozen=True)
class _Planned:
    """The plan of one patient: `errors` (wires, 3) of entry and end, mm, and direction, °, whether each is `within` its
    stated 95 % bound, and whether the band of the curve of each end holds the true pixel."""

    go: bool
    errors: np.ndarray
    within: np.ndarray
    in_band: tuple[bool, ...]


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    names, number = (*AT_HIP, *BONES_OF), TRIALS // 10 if quick else TRIALS
    trials = in_parallel(_planned, product(names, range(number)))
    rows = [
        row
        for k, name in enumerate(names)
        for row in _rows(name, trials[k * number : (k + 1) * number], frame_of(name))
    ]
    held = [one for trial in trials if trial is not None for one in trial.in_band]
    name = f"{CURVES_OF}: the curve's 95 % band holds the true place"
    return [*rows, Row("procedures", name, f"{np.mean(held):.1%} of {len(held)}")]


def _rows(name: str, trials: Sequence[_Planned | None], frame: str) -> list[Row]:
    made = [trial for trial in trials if trial is not None]
    errors = np.concatenate([trial.errors for trial in made])
    within = np.concatenate([trial.within.ravel() for trial in made])
    middle, most = np.median(errors, axis=0), np.quantile(errors, 0.95, axis=0)
    values = [f"{a:.2f} / {b:.2f} {unit}" for a, b, unit in zip(middle, most, ("mm", "mm", "°"), strict=True)]
    group = "procedures"
    return [
        Row(group, f"{name}, {frame}: error of entry; end; direction, median / 95 %", "; ".join(values)),
        Row(group, f"{name}: within their stated 95 % bounds", f"{within.mean():.1%} of {len(within)}"),
        Row(group, f"{name}: right plans that are GO", f"{sum(trial.go for trial in made) / len(trials):.1%}"),
    ]


def _planned(case: tuple[str, int]) -> _Planned | None:
    """Return the plan of one patient; None if it is refused."""
    procedure, seed = case
    rng = np.random.default_rng([seed, 1])  # of the noise; the patient has its own
    try:
        patient = draw_patient(procedure, seed, Frame.load(frame_of(procedure)), SIDES[seed % 2], imaged=False)
        views = calibrated_views(patient.setup, measure(rng, patient.setup, BEAD_PX))
        asked, _ = patient.asked(rng, PICK_PX)
        if asked.nail is not None:
            made = asked.plan_holes_on(views, _holes(patient, views, rng))
        else:
            made = asked.plan_on(views) if asked.others is None else asked.plan_wires_on(views)
    except SightlineError:
        return None
    plans = [made] if isinstance(made, Plan) else [made.plans[wire.key] for wire in patient.document.wires]
    compared = [
        Compared("smooth", "", plan.trajectory, Truth(wire, patient.pixels(wire)))
        for plan, wire in zip(plans, patient.wires_mm, strict=True)
    ]
    errors = np.array([list(one.errors) for one in compared])
    bounds = np.array([list(one.bounds_95 or (np.inf,) * 3) for one in compared])
    in_band = _in_bands(patient, views, rng) if procedure == CURVES_OF else ()
    return _Planned(made.verdict.go, errors, errors <= bounds, in_band)


def _holes(patient: RehearsedPatient, views: Sequence[CalibratedView], rng: np.random.Generator) -> dict[str, Hole]:
    """Return the holes of a nail by the procedure's wires, fitted to points of their edges as the images show them."""
    bone, drawn = patient.bone, patient.nail
    assert isinstance(bone, BoneScene) and isinstance(bone.dimensions, NailedFemur) and drawn is not None
    sights = {
        name: Sight(
            bone.anatomical(view.focal_point_mm),
            lambda mm, view=view: view.project(to_cfcs(mm, bone.side, bone.origin_mm)),
        )
        for name, view in patient.setup.views.items()
    }
    keys = [wire.key for wire in patient.document.wires]
    numbers = range(len(keys))[::-1]  # wires run from the nail's tip upwards
    nail = bone.dimensions.nail
    return {key: fit_hole(views, seen(rng, nail, sights, k), drawn) for key, k in zip(keys, numbers, strict=True)}


def _in_bands(patient: RehearsedPatient, views: Sequence[CalibratedView], rng: np.random.Generator) -> tuple[bool, ...]:
    """Return for both ends of the wire whether the band of the curve of a pick in the first view holds its true pixel
    in the second."""
    held = []
    for first, second in patient.pixels(patient.wires_mm[0]).swapaxes(0, 1):
        pick = first + PICK_PX * rng.standard_normal(2)
        curve = matching_curve(views[0], pick, views[1], PICK_PX**2 * np.eye(2))
        near = int(np.argmin(np.linalg.norm(curve.uv_px - second, axis=1)))
        assert curve.half_width_px is not None
        off = (second - curve.uv_px[near]) @ curve.across_px[near]
        held.append(bool(abs(off) <= curve.half_width_px[near]))
    return tuple(held)
