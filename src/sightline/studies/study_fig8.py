"""The paper's figure 8: a registration image, PA view of the plastic femur with both plates' balls.

The paper shows one such image. Here the twin renders it, and the beads that the software finds and labels are counted
and compared with their true shadows. Each trial is one image.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sightline.case.report.drawing import radiographs
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.studies.intervals import rms, share
from sightline.studies.phantoms import PHANTOMS, image_of, observed
from sightline.studies.study import Plot, Summary, Table, Values
from sightline.twin import HipScene, SetUp
from sightline.twin.carm import shadow_centres_px, shadow_radius_px

VIEW = "pa"
PLATES = {"xrii": "XRII plate", "source": "source plate"}


@dataclass(frozen=True)
class Figure8:
    """The study."""

    name = "fig8"
    about = "The paper's figure 8: a registration image, and how many of its beads are found and labelled"

    phantom: str = "plastic, bored"

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants that they depend on."""
        return {**asdict(self), "view": VIEW}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return for each plate the beads entirely in the field and how many of them were labelled; wrong labels;
        errors, px."""
        draw = int(rng.integers(2**32))
        rng, setup, hip = self.scene(draw)
        true, view = shadows(setup), setup.frame.view(VIEW)
        whole = {role: {i for i in getattr(view, role).ids if true[i].whole} for role in PLATES}
        out: Values = {"draw": draw, "shown": {role: len(whole[role]) for role in PLATES}}
        try:
            seen = observed(image_of(rng, setup, hip, VIEW), setup.frame, VIEW)
        except SightlineError as error:
            return {**out, "refused": type(error).__name__}
        off = {i: float(np.linalg.norm(uv - true[i].uv_px)) for i, uv in zip(seen.ids, seen.uv_px, strict=True)}
        right = {i for i, away in off.items() if away < true[i].radius_px}
        return {
            **out,
            "named": {role: len(right & whole[role]) for role in PLATES},
            "wrong": len(off) - len(right),
            "error_px": [round(off[i], 5) for i in off if i in right],
        }

    def scene(self, draw: int) -> tuple[np.random.Generator, SetUp, HipScene]:
        """Draw the scene of a trial from its number `draw`; return also the generator of its noise."""
        rng = np.random.default_rng(draw)
        return rng, *PHANTOMS[self.phantom].draw(rng, Frame.load("gamma"))

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return counts, and the image of the first trial."""
        kept = [trial for trial in trials if "refused" not in trial]
        refused = share("images refused", np.array(["refused" in trial for trial in trials]))
        error = rms("centre of a named bead, rms", [np.array(trial["error_px"]) for trial in kept], "px")
        wrong = sum(trial["wrong"] for trial in kept)
        rows = []
        for role, words in PLATES.items():
            shown = sum(trial["shown"][role] for trial in kept)
            named = sum(trial["named"][role] for trial in kept)
            rows.append((words, str(shown), str(named), f"{named / shown:.1%}" if shown else "none"))
        rng, setup, hip = self.scene(trials[0]["draw"])
        image = image_of(rng, setup, hip, VIEW)
        title = "A registration image: PA view of the plastic femur in the frame"
        drawing = radiographs.sources({VIEW: image}) + radiographs.radiograph(image, VIEW, (), title)
        return Summary(
            findings=(
                f"{len(kept)} of {len(trials)} images are labelled; {wrong} of their beads have a wrong label.",
                f"The centre of a correctly labelled bead has an error of {error} px rms.",
            ),
            estimates=(refused, error),
            tables=(Table("Beads", ("", "entirely in the field", "labelled correctly", "share"), tuple(rows)),),
            plots=(Plot(title, drawing, "The first trial, logarithm of the intensity, as in the paper."),),
        )


@dataclass(frozen=True, eq=False)
class Shadow:
    """The shadow of one bead: centre (2,) and radius, px; whether it lies entirely in the field."""

    uv_px: np.ndarray
    radius_px: float
    whole: bool


def shadows(setup: SetUp) -> dict[str, Shadow]:
    """Return the shadows of all beads of the true frame, by id."""
    truth, beads = setup.views[VIEW], setup.true_frame.view(VIEW).fiducials
    xyz, radius = np.array([b.xyz_mm for b in beads]), np.array([b.diameter_mm / 2 for b in beads])
    uv, px = shadow_centres_px(truth, xyz, radius), shadow_radius_px(truth, xyz, radius)
    whole = truth.in_field(uv, px)
    return {b.id: Shadow(uv[k], float(px[k]), bool(whole[k])) for k, b in enumerate(beads)}
