"""Plans that are wrong by a known amount, and right ones: how many are GO?

Each trial draws a bone in a set-up, a right wire, and a wrong wire of one kind (`wrong_kinds`). Clicks and drawings are
points with a careful click's noise; nothing is rendered. A right wire lies inside the limit of every check of its
procedure by that check's 95 % error, a wrong one beyond the limit of one check by 3 times its 95 % error or more. Both
are measured without noise: exact beads, exact clicks, and the frame as it is.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.calibration.view import CalibratedView
from sightline.common.checks import failed
from sightline.common.geometry.lines import across, unit
from sightline.errors import SetUpError, SightlineError
from sightline.frame import Frame
from sightline.planning import Aids, MatchingCurve, Plan, Procedure, kind, plan
from sightline.planning.bone.directions import anatomical
from sightline.planning.procedures.document import WantedView
from sightline.planning.procedures.procedure import ProcedureKey
from sightline.planning.verdict.bone_checks import AT_CORTEX
from sightline.planning.verdict.view_directions import frame_axes
from sightline.rehearsal.patient import RehearsedPatient, draw_patient
from sightline.studies.runs.plots import Span, spans
from sightline.studies.runs.study import Estimate, EstimateGroup, Plot, Summary, Table, Values, share
from sightline.studies.scenes import ATTEMPTS, BEAD_PX, CAREFUL_PX, MARGIN_PX, VIEWS, calibrated_views, measure
from sightline.studies.wrong_wires import (
    KINDS,
    MAX_AMOUNT,
    MAX_TIMES,
    MIN_TIMES,
    NEAR_SHARE,
    NEAR_TIMES,
    SOLID_ONLY,
    KnownBone,
    WrongKind,
    draw_times,
    right_wire,
)
from sightline.twin import SetUp

SOLID = "block60"
ARMS = {"gamma": "Γ on the intensifier", SOLID: "block60 on the flat panel"}
VIOLATED = 3.0  # times its 95 % error, by which a wrong plan violates a limit at least
# Wrong plans that no image shows. Their sizes are in 95 % errors of the entry point.
MOVED, ALONG_CURVE = "bone moved along the second beam", "one click along its curve"
UNSEEN = (MOVED, ALONG_CURVE)
_KINDS = {kind.name: kind for kind in KINDS}


@dataclass(frozen=True)
class WrongPlans:
    """The study; its fields can be varied. `without`: checks that are removed from the procedures."""

    name = "wrong-plans"
    about = "Wrong plans by kind and size: is one of them GO? And how many right ones are?"

    kinds: tuple[str, ...] = tuple(_KINDS)
    frames: tuple[str, ...] = tuple(ARMS)
    without: tuple[str, ...] = ()

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants that they depend on."""
        times = {"times": [MIN_TIMES, NEAR_TIMES, MAX_TIMES], "near_share": NEAR_SHARE}
        return {**asdict(self), **times, "pick_px": CAREFUL_PX, "bead_px": BEAD_PX}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return frame and kind, the wrong plan's `times` beyond its limit, and how the "right" and the "wrong" plan
        ended: "GO", "NO-GO", "incomplete" or "refused", and the checks that failed (`why`). "unseen": the same of
        the right plan after one of UNSEEN (`hidden`).

        Raises SetUpError where no hip is found.
        """
        frame, of = self.frames[rng.integers(len(self.frames))], _KINDS[self.kinds[rng.integers(len(self.kinds))]]
        frame = SOLID if of.procedure in SOLID_ONLY or of.turned else frame
        drawn = _drawn(rng, Frame.load(frame), of)
        setup, side, asked = drawn.patient.setup, drawn.patient.side, self._asked(of)
        views = dict.fromkeys(drawn.pixels, calibrated_views(setup, measure(rng, setup, BEAD_PX)))
        if drawn.turned is not None:
            views["wrong"] = calibrated_views(drawn.turned, measure(rng, drawn.turned, BEAD_PX))
        wrong = of.side(side), of.undrawn
        ended = {
            name: _ended(views[name], jittered(px, rng), asked, *(wrong if name == "wrong" else (side, ())))
            for name, px in drawn.pixels.items()
        }
        return {"frame": frame, "kind": of.name, "times": drawn.times, "hidden": drawn.unseen, **ended}

    def _asked(self, of: WrongKind) -> Procedure:
        """Return the procedure of a kind, without the removed checks."""
        asked = kind(of.procedure)
        rules = tuple(rule for rule in asked.checks if rule.check not in self.without)
        return replace(asked, document=asked.document.model_copy(update={"checks": rules}))

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return how right and wrong plans end, by kind and by frame."""
        groups = {"all": list(trials)}
        groups |= {name: [trial for trial in trials if trial["kind"] == name] for name in self.kinds}
        groups |= {ARMS[frame]: [trial for trial in trials if trial["frame"] == frame] for frame in self.frames}
        shares = {name: PlanShares.of(name, group) for name, group in groups.items()}
        columns = (
            "kind",
            "n",
            "wrong and GO",
            "by its own check",
            "other checks",
            "right and GO",
            "right, refused for",
        )
        note = (
            "A wrong plan violates the limit of its own check by 3 times that check's 95 % error or more. A plan may "
            "fail several checks. Right plans lie inside the limits of all checks by their 95 % errors."
        )
        hidden = [row for name in UNSEEN for row in _hidden_rows(name, [t for t in trials if t["hidden"] == name])]
        estimates = [estimate for trial in shares.values() for estimate in trial.estimates]
        return Summary(
            findings=tuple(_findings(shares["all"])),
            estimates=(*estimates, *(estimate for estimate, _ in hidden)),
            tables=(
                Table("How plans end", columns, tuple(trial.row(name) for name, trial in shares.items()), note),
                Table("What no image shows", ("kind", "n", "GO", "checks that failed"), tuple(r for _, r in hidden)),
            ),
            plots=tuple(_plots({name: groups[name] for name in self.kinds})),
        )


@dataclass(frozen=True)
class PlanShares(EstimateGroup):
    """How the plans of a group end."""

    wrong_go: Estimate
    caught: Estimate
    right_go: Estimate
    near: Estimate
    others: str
    refused: str

    @staticmethod
    def of(name: str, trials: Sequence[Values]) -> "PlanShares":
        """Return the shares over the trials of a group."""
        own = {trial.name: verdict_name(trial.check) for trial in KINDS}
        wrong, right = [trial["wrong"] for trial in trials], [trial["right"] for trial in trials]
        sized = [trial["times"] for trial in trials]
        others = Counter(why for trial in trials for why in trial["wrong"]["why"] if why != own[trial["kind"]])
        refused = Counter(why for trial in right for why in trial["why"])
        return PlanShares(
            share(f"{name}: wrong and GO", np.array([trial["ended"] == "GO" for trial in wrong])),
            share(
                f"{name}: by its own check", np.array([own[trial["kind"]] in trial["wrong"]["why"] for trial in trials])
            ),
            share(f"{name}: right and GO", np.array([trial["ended"] == "GO" for trial in right])),
            share(f"{name}: within {NEAR_TIMES:g} times", np.array([times <= NEAR_TIMES for times in sized])),
            _counted(others),
            _counted(refused),
        )

    @property
    def count_go(self) -> int:
        """The number of wrong plans that are GO."""
        return round((self.wrong_go.value or 0.0) * self.wrong_go.number)

    def row(self, name: str) -> tuple[str, ...]:
        """Return the row of the table."""
        n = self.wrong_go.number
        wrong = f"{self.count_go} of {n}"
        caught, right = (f"{estimate.value:.1%}" if n else "none" for estimate in (self.caught, self.right_go))
        return name, str(n), wrong, caught, self.others, right, self.refused


def verdict_name(check: str) -> str:
    """Return the name in a verdict of a check of a procedure's file."""
    return "entry at cortex" if check in AT_CORTEX else check


@dataclass(frozen=True, eq=False)
class PlanPixels:
    """The exact pixels of plans of one bone, by name of the plan: "right", "wrong", "unseen".

    `times`: of the wrong one beyond its limit, in 95 % errors. `unseen`: which of UNSEEN. `turned`: the set-up of the
    wrong one where it has its own.
    """

    patient: RehearsedPatient
    pixels: dict[str, dict[str, np.ndarray]]
    times: float
    unseen: str
    turned: SetUp | None = None


def _drawn(rng: np.random.Generator, frame: Frame, of: WrongKind) -> PlanPixels:
    """Draw a bone with its plans. Raises SetUpError if none is found."""
    asked = kind(of.procedure)
    for _ in range(ATTEMPTS):
        seed, side = int(rng.integers(2**32)), str(rng.choice(["right", "left"]))
        try:
            patient = draw_patient(ProcedureKey.of(of.procedure).file, seed, frame, side, imaged=False)
            return _planned(rng, patient, of, asked)
        except SightlineError:  # a point outside an image, a wire that this bone does not have
            continue
    raise SetUpError(f"none of {ATTEMPTS} bones has a right plan, and a wrong one of the kind {of.name!r}")


def _planned(rng: np.random.Generator, patient: RehearsedPatient, of: WrongKind, asked: Procedure) -> PlanPixels:
    """Return the plans of this bone. Raises SightlineError where it has none."""
    # Plates stand in their directions.
    plates = patient.setup.frame.solid is None
    rules = [rule for rule in asked.checks if rule.check != "view directions" or not plates]
    rule = next(rule for rule in rules if rule.check == of.check)
    wire, views = right_wire(rng, patient.anatomy, of.procedure), _exact(patient.setup)
    right_px = clicks(patient, wire)
    made = plan_of(views, right_px, asked, patient.side)
    right = KnownBone.of(made)
    inside = [-right.times_beyond(rule) for rule in rules]
    if not np.isfinite(inside).all() or min(inside) < 1.0:
        raise SetUpError("not a right plan")
    turned = None
    if of.turned:
        error = right.error_95(rule)
        other, beyond = _from_elsewhere(rng, patient, wire, asked, draw_times(rng) * error)
        wrong_px, turned, times = clicks(other, wire), other.setup, beyond / error
    else:
        wrong = of.wrong_wire(
            patient.anatomy, wire, draw_times(rng), rule, lambda other: right.with_wire(patient.in_cfcs(other))
        )
        wrong_px = {**right_px, "wire": wire_pixels(patient, wrong)}
        times = KnownBone.of(plan_of(views, wrong_px, asked, of.side(patient.side), of.undrawn)).times_beyond(rule)
    if times < VIOLATED:
        raise SetUpError("not a wrong plan")
    unseen = UNSEEN[rng.integers(len(UNSEEN))]
    unseen_px = _unseen(patient, wire, right_px, unseen, draw_times(rng) * made.trajectory.entry_error_95_mm)
    return PlanPixels(patient, {"right": right_px, "wrong": wrong_px, "unseen": unseen_px}, times, unseen, turned)


def _from_elsewhere(
    rng: np.random.Generator, patient: RehearsedPatient, wire_mm: np.ndarray, asked: Procedure, beyond_deg: float
) -> tuple[RehearsedPatient, float]:
    """Return the bone with one of its two views turned so far beyond its tolerance, and by how much that is.

    Measured along the patient's axes in the twin, not along those that the drawings show. Raises SetUpError.
    """
    which, seed, about = int(rng.integers(2)), int(rng.integers(2**32)), rng.standard_normal(3)
    views = asked.document.views
    amount, away, aim = 0.0, 0.0, views[which].within_deg + beyond_deg
    turned = patient
    for _ in range(4):  # its pose varies about the nominal beam
        amount += aim - away
        if not 0.0 < amount <= MAX_AMOUNT:
            raise SetUpError("no view is turned so far")
        turned = patient.seen_along(turned_beams(views, which, amount, about), np.random.default_rng(seed))
        middle, view = patient.in_cfcs(wire_mm.mean(axis=0)), list(turned.setup.views.values())[which]
        beam = frame_axes(patient.side) @ unit(middle - view.focal_point_mm)
        away = float(np.rad2deg(np.arccos(beam @ anatomical(views[which].orbit_deg, views[which].tilt_deg))))
    return turned, away - views[which].within_deg


def _unseen(
    patient: RehearsedPatient, wire_mm: np.ndarray, right_px: dict[str, np.ndarray], unseen: str, by_mm: float
) -> dict[str, np.ndarray]:
    """Return the pixels of a right plan after one of UNSEEN. Raises SetUpError where an image does not show them."""
    first, second = patient.setup.views.values()
    entry, unseen_px = patient.in_cfcs(wire_mm[0]), {name: uv.copy() for name, uv in right_px.items()}
    if unseen == ALONG_CURVE:
        unseen_px["wire"][1, 0] = second.project((entry + by_mm * unit(entry - first.focal_point_mm))[None])[0]
        return unseen_px
    moved = clicks(patient.moved(by_mm * unit(entry - second.focal_point_mm)), wire_mm)
    if moved.keys() != unseen_px.keys():
        raise SetUpError("one of the two images does not show a drawing")
    for name, uv in unseen_px.items():
        uv[1] = moved[name][1]
    return unseen_px


def _exact(setup: SetUp) -> Sequence[CalibratedView]:
    """Return the views of exact beads, and of the frame as it is, with the errors that are stated for noisy ones."""
    beads = measure(np.random.default_rng(0), setup, BEAD_PX, noisy=False)
    return calibrated_views(setup, beads, setup.true_frame)


def _ended(
    views: Sequence[CalibratedView],
    pixels: dict[str, np.ndarray],
    asked: Procedure,
    side: str,
    undrawn: Collection[str],
) -> Values:
    """Return how a plan ends, and the checks that failed."""
    try:
        made: Plan = plan_of(views, pixels, asked, side, undrawn)
    except SightlineError as error:
        return {"ended": "refused", "why": [type(error).__name__]}
    ended = {"go": "GO", "no-go": "NO-GO"}.get(made.verdict.state, made.verdict.state)
    return {"ended": ended, "why": sorted({check.name for check in failed(made.verdict.checks)})}


def _hidden_rows(name: str, trials: Sequence[Values]) -> Iterable[tuple[Estimate, tuple[str, ...]]]:
    """Return share and row of all plans of one of UNSEEN, then those of each procedure among them."""
    yield _hidden(name, [trial["unseen"] for trial in trials])
    by_procedure: dict[str, list[Values]] = {}
    for trial in trials:
        by_procedure.setdefault(ProcedureKey.of(_KINDS[trial["kind"]].procedure).file, []).append(trial["unseen"])
    for procedure in sorted(by_procedure):
        yield _hidden(f"{name}, {procedure}", by_procedure[procedure])


def _hidden(name: str, ended: Sequence[Values]) -> tuple[Estimate, tuple[str, ...]]:
    """Return the share of GO among the plans of one of UNSEEN, and the row of the table."""
    go = share(f"{name}: GO", np.array([plan["ended"] == "GO" for plan in ended]))
    return go, (name, str(go.number), str(go), _counted(Counter(why for plan in ended for why in plan["why"])))


def _plots(by_kind: dict[str, Sequence[Values]]) -> Iterable[Plot]:
    times = {name: np.array([plan["times"] for plan in trials]) for name, trials in by_kind.items() if trials}
    rows = [Span(name, *np.quantile(each, (0.05, 0.5, 0.95)).tolist()[:3]) for name, each in times.items()]
    if rows:
        title = "How far wrong plans violate their limits"
        caption = "In 95 % errors of the check that must catch them: central 90 % (bar) and median (tick) by kind."
        yield Plot(title, spans(rows, "times", title), caption)


def _counted(reasons: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in reasons.most_common(4))


def _findings(shares: PlanShares) -> Iterable[str]:
    n, near = shares.wrong_go.number, shares.near.value or 0.0
    yield f"{shares.count_go} of {n} wrong plans are GO; {near:.0%} of them violate by {NEAR_TIMES:g} times or less."
    yield f"{shares.right_go.value or 0.0:.1%} of {n} right plans are GO."


Pixels = Mapping[str, np.ndarray]


def clicks(patient: RehearsedPatient, wire_mm: np.ndarray) -> dict[str, np.ndarray]:
    """Return the true pixels (2, N, 2) in both images of a "wire" (2, 3), anatomical, of the procedure's "landmarks",
    and of the clicks on each aid by its key, NaN in an image in which it is not drawn.

    Raises SetUpError where a wire or a landmark lies outside.
    """
    marks = dict(zip(patient.landmark_keys, patient.landmarks.values(), strict=True))
    asked = [landmark.key for landmark in patient.document.landmarks]
    if marks.keys() != set(asked):
        raise SetUpError("a landmark lies outside an image")
    aids = {
        key: np.stack(
            [np.full_like(next(uv for uv in both if uv is not None), np.nan) if uv is None else uv for uv in both]
        )
        for key, both in patient.aids_px.items()
    }
    return {
        "wire": wire_pixels(patient, wire_mm),
        "landmarks": np.stack([marks[key] for key in asked], axis=1),
        **aids,
    }


def wire_pixels(patient: RehearsedPatient, wire_mm: np.ndarray) -> np.ndarray:
    """Return the pixels (2, 2, 2) of a wire (2, 3), anatomical. Raises SetUpError where it lies outside an image."""
    uv = patient.pixels(patient.in_cfcs(wire_mm))
    if not all(patient.setup.views[name].in_field(uv[k], MARGIN_PX).all() for k, name in enumerate(VIEWS)):
        raise SetUpError("a wire lies outside an image")
    return uv


def turned_beams(wanted: Sequence[WantedView], which: int, by_deg: float, about: np.ndarray) -> dict[str, np.ndarray]:
    """Return the nominal beams (3,) of two views by name, anatomical, one of them turned by an angle about the part of
    `about` (3,) that is perpendicular to it."""
    beams = {view.name: np.array(anatomical(view.orbit_deg, view.tilt_deg)) for view in wanted[: len(VIEWS)]}
    beam = beams[wanted[which].name]
    beams[wanted[which].name] = Rotation.from_rotvec(np.deg2rad(by_deg) * unit(across(about, beam))).apply(beam)
    return beams


def jittered(pixels: Pixels, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the pixels with a careful click's noise."""
    return {name: uv + CAREFUL_PX * rng.standard_normal(uv.shape) for name, uv in pixels.items()}


def plan_of(
    views: Sequence[CalibratedView], pixels: Pixels, procedure: Procedure, side: str, undrawn: Collection[str] = ()
) -> Plan:
    """Return the plan of clicks and drawings, without the aids `undrawn`. Raises SightlineError."""
    types = {aid.key: aid.type for aid in procedure.aids if aid.key in pixels and aid.key not in undrawn}
    clicked = {key: [None if np.isnan(uv).any() else uv for uv in pixels[key]] for key in types}
    wire = pixels["wire"]
    return plan(
        views,
        wire[:, 0],
        wire[:, 1],
        landmarks_uv_px=pixels["landmarks"],
        landmark_names=[landmark.key for landmark in procedure.landmarks],
        procedure=procedure,
        side=side,
        aids=Aids.clicked(types, clicked),
        curve=_no_curve,
    )


def _no_curve(*_: object) -> MatchingCurve:
    """Return a curve that nothing looks at: drawing one takes most of the time of a plan."""
    nothing, pixels = np.zeros(0), np.zeros((0, 2))
    return MatchingCurve("pa", "lateral", nothing, np.zeros((0, 3)), pixels, pixels, nothing.astype(bool), lambda: None)
