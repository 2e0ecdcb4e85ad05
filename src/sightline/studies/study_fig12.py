"""The paper's figure 12: a PA line of sight in the lateral view, the image-matching curve.

Measured: the distance of a point's true lateral pixel from the curve of its PA pick, compared with the curve's stated
band; and the bend of the curve from its chord, which a straight line would ignore. Beads are noisy points here; the
radiograph of the plot is rendered.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

import sightline as sl
from sightline.calibration import BeadView
from sightline.case.report.drawing import plan_marks, radiographs
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.planning.curve import MatchingCurve, matching_curve
from sightline.studies.intervals import quantile, rms, share
from sightline.studies.phantoms import PHANTOMS, image_of
from sightline.studies.scenes import VIEWS, draw_showing, measure
from sightline.studies.study import Plot, Summary, Table, Values
from sightline.twin import SetUp

PHANTOM = "plastic, bored"
PICK_PX = 0.5  # a careful click (physics.md, Picks)
BEAD_PX = 0.1  # physics.md, Centroid limit
ENDS = ("entry", "end")
MIDDLE = 60.0  # mm of the line of sight to either side of the point: the part a surgeon looks at [ours]


@dataclass(frozen=True, eq=False)
class CurveTrial:
    """A set-up, its calibrated views, and the image-matching curves of both ends of the wire."""

    setup: SetUp
    views: list[BeadView]
    curves: list[MatchingCurve]
    true_px: np.ndarray


@dataclass(frozen=True)
class Figure12:
    """The study."""

    name = "fig12"
    about = "The paper's figure 12: a PA line of sight in the lateral view, with its band"

    pick_px: float = PICK_PX
    bead_px: float = BEAD_PX

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants that they depend on."""
        return {**asdict(self), "wire_mm": PHANTOMS[PHANTOM].wire_mm.tolist()}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return for both ends the distance of the true pixel from the curve, half width of the band, bend; px."""
        draw = int(rng.integers(2**32))
        try:
            drawn = self.drawn(np.random.default_rng(draw))
        except SightlineError as error:
            return {"draw": draw, "refused": type(error).__name__}
        pairs = zip(ENDS, drawn.curves, drawn.true_px, strict=True)
        return {"draw": draw, **{end: held(curve, uv) for end, curve, uv in pairs}}

    def drawn(self, rng: np.random.Generator) -> CurveTrial:
        """Draw everything of one trial from its own generator. Raises SightlineError."""
        wire = PHANTOMS[PHANTOM].wire_mm
        setup = draw_showing(rng, Frame.load("gamma"), wire)
        seen = measure(rng, setup, self.bead_px)
        views = [sl.calibrate(seen[name], setup.frame) for name in VIEWS]
        pa, lateral = (setup.views[name].project(wire) for name in VIEWS)
        picks = pa + self.pick_px * rng.standard_normal(pa.shape)
        stated = self.pick_px**2 * np.eye(2)
        return CurveTrial(setup, views, [matching_curve(views[0], uv, views[1], stated) for uv in picks], lateral)

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return distances compared with bands, bends, and the curves of the first set-up that is not refused."""
        kept = [trial for trial in trials if "refused" not in trial]
        refused = share("set-ups refused", np.array(["refused" in trial for trial in trials]))
        if not kept:
            return Summary(("Every set-up was refused.",), (refused,), ())
        off = {end: np.array([trial[end]["off_px"] for trial in kept]) for end in ENDS}
        band = {end: np.array([trial[end]["band_px"] for trial in kept]) for end in ENDS}
        bend = {end: np.array([trial[end]["bend_px"] for trial in kept]) for end in ENDS}
        inside = {end: share(f"{end}: the band holds the true place", np.abs(off[end]) <= band[end]) for end in ENDS}
        away = {end: rms(f"{end}: true place from the curve, rms", list(off[end][:, None]), "px") for end in ENDS}
        width = {end: quantile(f"{end}: half width of the band, median", band[end], 0.5, "px") for end in ENDS}
        bent = {end: quantile(f"{end}: bend of the curve, median", bend[end], 0.5, "px") for end in ENDS}
        most = {end: quantile(f"{end}: bend of the curve, 95 %", bend[end], 0.95, "px") for end in ENDS}
        every = (inside, away, width, bent, most)
        rows = tuple((end, *(str(estimates[end]) for estimates in every)) for end in ENDS)
        columns = ("", "in the 95 % band", "from the curve, px rms", "half width, px", "bend, px", "bend, 95 %, px")
        return Summary(
            findings=tuple(
                f"{end}: the 95 % band holds the true lateral place in {inside[end].value:.1%} of set-ups; its half "
                f"width is {width[end].value:.2f} px, the curve bends by {bent[end].value:.1f} px (medians)."
                for end in ENDS
            ),
            estimates=(refused, *(estimate for estimates in every for estimate in estimates.values())),
            tables=(Table("Image-matching curves", columns, rows, "In brackets: 95 % intervals."),),
            plots=(self._plot(kept[0]["draw"]),),
        )

    def _plot(self, draw: int) -> Plot:
        drawn, rng = self.drawn(np.random.default_rng(draw)), np.random.default_rng([draw])
        image = image_of(rng, drawn.setup, PHANTOMS[PHANTOM].build(drawn.setup, rng), VIEWS[1])
        curves = [plan_marks.curve(curve, end) for curve, end in zip(drawn.curves, ENDS, strict=True)]
        title = "PA lines of sight of entry and end in the lateral view"
        marks = (*curves, plan_marks.truth(drawn.true_px))
        drawing = radiographs.sources({VIEWS[1]: image}) + radiographs.radiograph(image, VIEWS[1], marks, title)
        caption = "Blue: the curves with their 95 % bands, a tick every 10 mm. White: the true points."
        return Plot(title, drawing, caption)


def held(curve: MatchingCurve, uv_px: np.ndarray) -> Values:
    """Return the signed distance of a point from a curve at the nearest sample, the half width of the band there, and
    the largest distance of the curve from its chord within MIDDLE of the point; px."""
    near = int(np.argmin(np.linalg.norm(curve.uv_px - uv_px, axis=1)))
    assert curve.half_width_px is not None  # noqa: S101 - views calibrated from beads state their error
    some = curve.uv_px[np.abs(curve.depth_mm - curve.depth_mm[near]) <= MIDDLE]
    chord = (some[-1] - some[0]) / np.linalg.norm(some[-1] - some[0])
    bend = np.abs((some - some[0]) @ [-chord[1], chord[0]]).max()
    return {
        "off_px": float((uv_px - curve.uv_px[near]) @ curve.across_px[near]),
        "band_px": float(curve.half_width_px[near]),
        "bend_px": float(bend),
    }
