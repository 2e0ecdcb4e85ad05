"""The paper's figure 15: guide wires inserted into the bore of a plastic femur, end to end.

The robot holds the frame. Beads are found and labelled in two radiographs of the plastic femur, the views are
calibrated, the ends of the bore are picked, and the trajectory is transformed to robot coordinates and inserted through
the real link. Evaluated from the physics: distance of the wire's axis from the entry point, of its tip from the end
point, and its angle to the bore's axis. Fixed beforehand: picks of 0.5 px, frame and wire on the flange known to
0.1 mm, backlash of 0.05°, frame tolerances of physics.md.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

import sightline as sl
from sightline.calibration import BeadView
from sightline.calibration.maps.fit_map import Method
from sightline.detection import Observations
from sightline.errors import OutsideRegionError, SightlineError
from sightline.frame import Frame
from sightline.planning import Plan, kind, plan
from sightline.rehearsal.operation import InsertionOutcome, SimulatedTheatre, calibrated_robot
from sightline.robot.control.insertion import Setup
from sightline.robot.kinematics.designs import Design
from sightline.studies.runs.study import Estimate, Summary, Table, Values, quantile, share
from sightline.studies.scenes import CAREFUL_PX, PAPER_DEG, PAPER_MM, PHANTOMS, SIDE, VIEWS, image_of, observed
from sightline.twin import HipScene, SetUp

PHANTOM = "plastic, bored"
METHODS: tuple[Method, ...] = ("smooth", "localized")
BEYOND_MM = 3.0  # the depth limit lies this far beyond the end point: the bore ends 8 mm under the bone's surface
SIX = 6  # number of trials in the paper


@dataclass(frozen=True, eq=False)
class PlannedInsertion:
    """The input of both methods: set-up, hip, beads, and the picks (2, P, 2) of entry, end and landmarks."""

    setup: SetUp
    hip: HipScene
    seen: dict[str, Observations]
    picks: np.ndarray

    def plan(self, method: Method) -> Plan:
        """Calibrate and plan by one method. Raises SightlineError."""
        views = [sl.calibrate(self.seen[name], self.setup.frame, view=name, method=method) for name in VIEWS]
        entry, end, *marks = np.moveaxis(self.picks, 1, 0)
        known = [mark for mark in marks if _sees(views, mark)]
        landmarks = np.stack(known, axis=1) if known else None
        return plan(views, entry, end, pick_sd_px=CAREFUL_PX, landmarks_uv_px=landmarks, procedure=kind("free-wire"))


@dataclass(frozen=True)
class Figure15:
    """The study."""

    name = "fig15"
    about = "The paper's figure 15: guide wires inserted by the robot into the bore of a plastic femur"

    methods: tuple[Method, ...] = METHODS
    arm: Design = "manipulator"

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants that they depend on."""
        return {**asdict(self), "pick_px": CAREFUL_PX, "wire_mm": PHANTOMS[PHANTOM].wire_mm.tolist()}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return for each method the errors at entry and end, mm, and of the direction, °; or why it was refused."""
        try:
            planned = _planned(rng)
        except SightlineError as error:
            return {"refused": f"{type(error).__name__}: {error}"}
        theatre = int(rng.integers(2**32))  # both methods drive the same robot from the same place
        return {method: _inserted(planned, method, self.arm, np.random.default_rng(theatre)) for method in self.methods}

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return the errors of both methods, and the first six trials, as in the paper."""
        estimates, rows, findings = [], [], []
        for method in self.methods:
            all_of = [trial.get(method, trial) for trial in trials]
            kept = [insertion for insertion in all_of if "refused" not in insertion]
            within = share(
                f"{method}: within {PAPER_MM:g} mm and {PAPER_DEG}°",
                np.array(list(map(_within, all_of))),
            )
            mine = [within, *(f for of in _MEASURED for f in _quantiles(method, of, kept))]
            plans = [insertion for insertion in all_of if "plan_entry" in insertion]
            estimates += [*mine, *(f for of in ("plan_entry", "plan_angle") for f in _quantiles(method, of, plans))]
            rows.append((method, f"{len(kept)} of {len(trials)}", *(str(estimate) for estimate in mine)))
            findings.append(
                f"{method}: {sum(map(_within, all_of))} of {len(trials)} insertions within {PAPER_MM:g} mm "
                f"of the entry point and {PAPER_DEG}° of the bore's axis; {len(trials) - len(kept)} refused."
            )
        columns = ("method", "drilled", "within", *(f"{of}, {what}" for of in _MEASURED for what in ("median", "95 %")))
        table = Table("Insertions", columns, tuple(rows), "In brackets: 95 % intervals. Entry and end mm, angle °.")
        return Summary(tuple(findings), tuple(estimates), (table, self._first_six(trials)))

    def _first_six(self, trials: Sequence[Values]) -> Table:
        rows = []
        for number, trial in enumerate(trials[:SIX], start=1):
            for method in self.methods:
                insertion = trial.get(method, trial)
                rows.append(
                    (
                        str(number),
                        method,
                        *(f"{insertion[of]:.2f}" if of in insertion else "refused" for of in _MEASURED),
                    )
                )
        columns = ("trial", "method", "entry mm", "end mm", "angle °")
        return Table(
            "Six trials, as the paper's figure shows", columns, tuple(rows), "The paper: all within 1 mm, 0.6°."
        )


_MEASURED = ("entry", "end", "angle")


def _sees(views: list[BeadView], uv_px: np.ndarray) -> bool:
    """Whether both views have a line of sight there; `localized` has none outside the convex hull of its beads."""
    try:
        for view, uv in zip(views, uv_px, strict=True):
            view.lines_of_sight(uv[None])
    except OutsideRegionError:
        return False
    return True


def _planned(rng: np.random.Generator) -> PlannedInsertion:
    setup, hip = PHANTOMS[PHANTOM].draw(rng, Frame.load("gamma"))
    seen = {name: observed(image_of(rng, setup, hip, name), setup.frame, name) for name in VIEWS}
    points = np.concatenate([hip.wire_mm, np.stack(list(hip.landmarks_mm.values()))])
    true = np.stack([setup.views[name].project(points) for name in VIEWS])
    return PlannedInsertion(setup, hip, seen, true + CAREFUL_PX * rng.standard_normal(true.shape))


def _inserted(planned: PlannedInsertion, method: Method, arm: Design, rng: np.random.Generator) -> Values:
    """Return the result of one method's plan; only the errors of the plan if the robot does not carry it out."""
    plan_errors: Values = {}
    try:
        made = planned.plan(method)
        by_plan = InsertionOutcome.of(made.trajectory.points.xyz_mm, planned.hip.wire_mm)
        plan_errors = {"plan_entry": by_plan.entry_mm, "plan_angle": float(np.rad2deg(by_plan.angle_rad))}
        # The wire enters the bore without touching bone, so there is no contact to wait for.
        confirmed = Setup(SIDE, planned.setup.frame.serial or "twin", into_bone=False)
        theatre = SimulatedTheatre.draw(calibrated_robot(SIDE, arm=arm), planned.hip, rng, confirmed)
        target = theatre.target(made, "fig15")
        theatre.drill(target, target.length_mm + BEYOND_MM)
    except SightlineError as error:
        return {**plan_errors, "refused": f"{type(error).__name__}: {error}"}
    outcome: InsertionOutcome = theatre.outcome(planned.hip.wire_mm)
    return {
        **plan_errors,
        "entry": outcome.entry_mm,
        "end": outcome.end_mm,
        "angle": float(np.rad2deg(outcome.angle_rad)),
        "stated_entry": target.entry_error_95_mm,
        "stated_end": target.end_error_95_mm,
        "stated_angle": float(np.rad2deg(target.direction_error_95_rad)),
    }


def _within(trial: Values) -> bool:
    return "refused" not in trial and trial["entry"] <= PAPER_MM and trial["angle"] <= PAPER_DEG


def _quantiles(method: str, of: str, kept: Sequence[Values]) -> list[Estimate]:
    unit = "°" if of.endswith("angle") else "mm"
    values = np.array([trial[of] for trial in kept])
    return [
        quantile(f"{method}: {of.replace('_', ', ')}, {what}", values, at, unit)
        for what, at in (("median", 0.5), ("95 %", 0.95))
    ]
