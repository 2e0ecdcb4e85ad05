"""Error budget of a target: the contribution of each source, measured and as stated.

Each source of error is switched on alone, in the same set-up and with the same draws; its effect is the difference from
a run without any source. The error without any source is the distortion that the maps do not model. The values stated
by the reconstruction are printed beside the measured ones. Squares of small independent errors add up, so the root of
their sum is compared with the effect of all sources together.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

import sightline as sl
from sightline.case.report.charts import Bar, budget
from sightline.detection import Observations
from sightline.errors import SightlineError
from sightline.frame import Frame, Tolerances
from sightline.planning import SpacePoints
from sightline.studies.methods import calibrated
from sightline.studies.runs.study import Estimate, Plot, Summary, Table, Values, rms, share
from sightline.studies.scenes import BEAD_PX, CAREFUL_PX, CENTRED_PX, EXACT, ORDINARY_PX, VIEWS, WHOLE, TargetScene
from sightline.twin import bead_images, draw_setup
from sightline.twin.scenes.hip_scene import TEST_BALLS_MM

# Sources in the frame, each with the tolerances that its errors are drawn from.
FRAME_ALONE = {
    "balls": Tolerances(WHOLE.bead_mm, 0.0, 0.0, 0.0, 0.0),
    "plates": Tolerances(0.0, WHOLE.plate_mm, WHOLE.plate_rad, 0.0, 0.0),
    "arms": Tolerances(0.0, 0.0, 0.0, WHOLE.arm_mm, WHOLE.arm_rad),
}
MEANINGS = {
    "balls": "position of each ball in its plate",
    "plates": "position of each plate on its arm",
    "arms": "position of each arm of the frame",
    "beads": "noise of the beads' measured centres, through map and focal point",
    "map": "distortion that the maps do not model, all else exact",
    "picks": "errors of the target's picks in the images",
}
TOGETHER = "together"
# Sources of the reconstruction's stated budget, and the measured sources that they correspond to.
STATED = {
    "frame": ("balls", "plates", "arms"),
    "beads, map, focal_point": ("beads", "map"),
    "picks": ("picks",),
}


@dataclass(frozen=True)
class Budget:
    """The study; its fields can be varied."""

    name = "budget"
    about = "The error of a target, source by source: measured, and as the reconstruction states it"

    picks_px: tuple[float, ...] = (CENTRED_PX, CAREFUL_PX, ORDINARY_PX)
    bead_px: float = BEAD_PX

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants that they depend on."""
        return {**asdict(self), "tolerances": asdict(WHOLE), "points_mm": TEST_BALLS_MM.tolist()}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return for each pick the error of each source at the four test points, mm, and its stated value."""
        noise = rng.standard_normal((len(VIEWS), len(TEST_BALLS_MM), 2))
        try:
            none = SetUpWith(rng, EXACT, self.bead_px, bead_noise=False)
            alone = {name: SetUpWith(rng, sd, self.bead_px, bead_noise=False) for name, sd in FRAME_ALONE.items()}
            alone["beads"] = SetUpWith(rng, EXACT, self.bead_px, bead_noise=True)
            everything = SetUpWith(rng, WHOLE, self.bead_px, bead_noise=True)
            return {f"{sd:g}": _sources(none, alone, everything, sd, noise) for sd in self.picks_px}
        except SightlineError as error:
            return {"refused": str(error)}

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return root mean squares by source and pick."""
        kept = [trial for trial in trials if "refused" not in trial]
        refused = share("set-ups refused", np.array(["refused" in trial for trial in trials]))
        if not kept:
            return Summary(("Every set-up was refused.",), (refused,), ())
        names = (*MEANINGS, TOGETHER, *(f"{source}, stated" for source in STATED))
        rms_of = {
            (sd, name): rms(f"picks {sd:g} px: {name}", [np.array(trial[f"{sd:g}"][name]) for trial in kept], "mm")
            for sd in self.picks_px
            for name in names
        }
        title = "Shares of the variance of a target, by picks"
        bars = [Bar(f"{sd:g} px", "mm", {name: _size(rms_of[sd, name]) for name in MEANINGS}) for sd in self.picks_px]
        caption = f"From left to right: {', '.join(MEANINGS)}. Their squares add up."
        return Summary(
            findings=tuple(_finding(sd, rms_of) for sd in self.picks_px),
            estimates=(refused, *rms_of.values()),
            tables=(self._alone_table(rms_of), self._stated_table(rms_of)),
            plots=(Plot(title, budget(bars, title), caption),),
        )

    def _alone_table(self, rms_of: dict[tuple[float, str], Estimate]) -> Table:
        columns = ("source", *(f"picks {sd:g} px" for sd in self.picks_px), "meaning")
        rows = [
            (name, *(f"{_size(rms_of[sd, name]):.3f}" for sd in self.picks_px), MEANINGS[name]) for name in MEANINGS
        ]
        roots = (f"{_root(rms_of, sd, MEANINGS):.3f}" for sd in self.picks_px)
        rows.append(("sum", *roots, "root of the sum of their squares"))
        rows.append((TOGETHER, *(f"{_size(rms_of[sd, TOGETHER]):.3f}" for sd in self.picks_px), "all of them at once"))
        note = "Three-dimensional error of the four test points, mm rms; default tolerances of the frame."
        return Table("Each source alone", columns, tuple(rows), note)

    def _stated_table(self, rms_of: dict[tuple[float, str], Estimate]) -> Table:
        rows = [
            (
                source.replace("_", " "),
                *(
                    f"{_root(rms_of, sd, parts):.3f} / {_size(rms_of[sd, f'{source}, stated']):.3f}"
                    for sd in self.picks_px
                ),
            )
            for source, parts in STATED.items()
        ]
        columns = ("source", *(f"picks {sd:g} px" for sd in self.picks_px))
        note = "The two agree where the error budget in the report of a plan is right."
        return Table("Measured / stated, mm rms", columns, tuple(rows), note)


class SetUpWith:
    """A set-up with frame errors drawn from the tolerances `drawn`, and with or without bead noise of `bead_px`.

    It copies the generator, so that all have the same poses, distortions and draws. It is always calibrated as if all
    errors were present, so that its weights are those of a plan. Raises SightlineError.
    """

    def __init__(self, rng: np.random.Generator, drawn: Tolerances, bead_px: float, *, bead_noise: bool) -> None:
        own = deepcopy(rng)
        setup = draw_setup(own, replace(Frame.load("gamma"), tolerances=drawn))
        toleranced = replace(setup, frame=replace(setup.frame, tolerances=WHOLE))
        observations = {}
        for name in VIEWS:
            ids, exact = bead_images(setup, name, own, sd_px=0.0)
            noise = bead_px * own.standard_normal(exact.shape)
            stated = np.broadcast_to(bead_px**2 * np.eye(2), (len(ids), 2, 2))
            observations[name] = Observations(name, ids, exact + noise if bead_noise else exact, stated)
        self.scene = TargetScene.of(toleranced, observations, TEST_BALLS_MM)
        self.views = calibrated(self.scene)

    def points(self, pick_px: float, noise: np.ndarray | float = 0.0) -> SpacePoints:
        """Reconstruct the test points from picks with `noise` (2, 4, 2), px, weighted as picks of `pick_px`."""
        covariance = np.broadcast_to(pick_px**2 * np.eye(2), (*self.scene.target_px.shape, 2))
        return sl.reconstruct(self.views, self.scene.target_px + noise, covariance)


def _sources(
    none: SetUpWith, alone: dict[str, SetUpWith], everything: SetUpWith, pick_px: float, noise: np.ndarray
) -> Values:
    """Return the error (4,) of each source at the test points, mm, and its stated value."""
    exact = none.points(pick_px).xyz_mm
    moved = {name: varied.points(pick_px).xyz_mm - exact for name, varied in alone.items()}
    moved["map"] = exact - TEST_BALLS_MM
    moved["picks"] = none.points(pick_px, pick_px * noise).xyz_mm - exact
    whole = everything.points(pick_px, pick_px * noise)
    moved[TOGETHER] = whole.xyz_mm - TEST_BALLS_MM
    assert whole.budget_mm2 is not None  # noqa: S101 - a view calibrated from beads states its error
    errors: Values = {name: np.linalg.norm(by, axis=1).tolist() for name, by in moved.items()}
    for source in STATED:
        variances = sum(np.diag(whole.budget_mm2[part]) for part in source.split(", "))
        errors[f"{source}, stated"] = np.sqrt(np.reshape(variances, (-1, 3)).sum(axis=1)).tolist()
    return errors


def _finding(pick_px: float, rms_of: dict[tuple[float, str], Estimate]) -> str:
    squares = {name: _size(rms_of[pick_px, name]) ** 2 for name in MEANINGS}
    first, second = sorted(squares, key=lambda name: -squares[name])[:2]
    total, together = sum(squares.values()), rms_of[pick_px, TOGETHER]
    return (
        f"Picks {pick_px:g} px: {together} mm rms; of the sum of squares {squares[first] / total:.0%} is {first}, "
        f"{squares[second] / total:.0%} {second}. The root of that sum is {total**0.5 / _size(together):.2f} of their "
        "joint effect."
    )


def _root(rms_of: dict[tuple[float, str], Estimate], pick_px: float, names: Sequence[str] | dict[str, str]) -> float:
    return sum(_size(rms_of[pick_px, name]) ** 2 for name in names) ** 0.5


def _size(estimate: Estimate) -> float:
    return estimate.value or 0.0
