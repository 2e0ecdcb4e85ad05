"""Right plans of each procedure on its own bone: errors, how often their stated bounds hold, and how many are GO.

Each trial draws a patient, a set-up and what a person draws, with a careful click's noise; beads and edges of a nail
are points with the noise of measured ones. Of a hip's free wire the band of the image-matching curve is measured too.
"""

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np

from benchmarks.harness import Refusal, Rows, trials
from benchmarks.scenes.nails import Sight, seen
from sightline.calibration.view import CalibratedView
from sightline.case.report.content import Compared, Truth
from sightline.frame import Frame
from sightline.planning import Hole, Plan, fit_hole, matching_curve
from sightline.rehearsal.patient import AT_HIP, BONES_OF, RehearsedPatient, draw_patient, frame_of
from sightline.studies.scenes import calibrated_views, measure
from sightline.twin import BoneScene
from sightline.twin.anatomy.femur import to_cfcs
from sightline.twin.anatomy.nailed_femur import NailedFemur

TRIALS = 200  # of each procedure
FIRST_SEED = 1  # of the noise; the patients have their own
BEAD_PX, PICK_PX = 0.1, 0.5  # physics.md: Centroid limit, Picks
SIDES = ("right", "left")
CURVES_OF = "free-wire"


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark."""
    rows, names, number = Rows("procedures"), (*AT_HIP, *BONES_OF), TRIALS // 10 if quick else TRIALS
    results, in_band = trials(_planned, product(names, range(number))), np.zeros((0, 2))
    for k, name in enumerate(names):
        made = [each for each in results[k * number : (k + 1) * number] if not isinstance(each, Refusal)]
        errors, within = (np.concatenate([each[key] for each in made]) for key in ("errors", "within"))
        values = zip(*np.quantile(errors, (0.5, 0.95), axis=0), ("mm", "mm", "°"), strict=True)
        text = "; ".join(f"{a:.2f} / {b:.2f} {unit}" for a, b, unit in values)
        frame = {"gamma": "Γ"}.get(frame_of(name), frame_of(name))
        rows.add(f"{name}, {frame}: error of entry; end; direction, median / 95 %", text)
        rows.number(f"{name}: within their stated 95 % bounds", 100 * within.mean(), ".1f", "%")
        rows.number(f"{name}: right plans that are GO", 100 * sum(each["go"] for each in made) / number, ".1f", "%")
        if name == CURVES_OF:
            in_band = np.array([each["in_band"] for each in made])
    entry, end = 100 * in_band.mean(axis=0)
    rows.add(f"{CURVES_OF}: the curve's 95 % band holds the true place", f"{entry:.1f} % (entry), {end:.1f} % (end)")
    return rows


def _planned(case: tuple[str, int]) -> dict[str, Any]:
    """Return of the plan of one patient whether it is GO, the errors (wires, 3) of entry and end, mm, and direction, °,
    whether each is within its stated 95 % bound, and whether the band of the curve of each end holds the true pixel."""
    procedure, seed = case
    rng = np.random.default_rng([seed, FIRST_SEED])
    patient = draw_patient(procedure, seed, Frame.load(frame_of(procedure)), SIDES[seed % 2], imaged=False)
    views = calibrated_views(patient.setup, measure(rng, patient.setup, BEAD_PX))
    asked, _ = patient.asked(rng, PICK_PX)
    if asked.nail is not None:
        made = asked.plan_holes_on(views, holes_of(patient, views, rng))
    else:
        made = asked.plan_on(views) if asked.others is None else asked.plan_wires_on(views)
    plans = [made] if isinstance(made, Plan) else [made.plans[wire.key] for wire in patient.document.wires]
    compared = [
        Compared("smooth", "", plan.trajectory, Truth(wire, patient.pixels(wire)))
        for plan, wire in zip(plans, patient.wires_mm, strict=True)
    ]
    errors = np.array([list(each.errors) for each in compared])
    bounds = np.array([list(each.bounds_95 or (np.inf,) * 3) for each in compared])
    in_band = _in_bands(patient, views, rng) if procedure == CURVES_OF else ()
    return {"go": made.verdict.go, "errors": errors, "within": (errors <= bounds).ravel(), "in_band": in_band}


def holes_of(patient: RehearsedPatient, views: Sequence[CalibratedView], rng: np.random.Generator) -> dict[str, Hole]:
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
    numbers, nail = range(len(keys))[::-1], bone.dimensions.nail  # wires run from the nail's tip upwards
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
