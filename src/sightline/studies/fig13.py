"""The paper's figure 13: a plate of holes fixed to the intensifier, seen in the PA and in the lateral pose.

Without magnetic fields both images would be the same. The plate lies on the input plane; the C-arm rotates by 90° about
the patient's long axis, and its display stays the same. In the paper the centre hole moved by 2 to 3 mm. The twin's
shift per field was chosen to match this value (docs/twin.md), so its size is not a test. Results are the spread over
headings of the table and stray fields, and the displacement field.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sightline.studies.runs.plots import field
from sightline.studies.runs.study import Plot, Summary, Table, Values, quantile, share
from sightline.twin.xray.distributions import Distortion
from sightline.twin.xray.presets import preset
from sightline.twin.xray.tubes import draw_earth, draw_tube

PAPER_MM = (2.0, 3.0)
HOLE_PITCH_MM = 20.0  # [ours] the paper does not state it; the measures do not depend on it, but for their sampling
QUANTILES = (0.05, 0.5, 0.95)
# u, v and the beam of both poses, CFCS: the image's v points caudally (a right hip).
POSES = {
    "pa": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "lateral": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
}
MEASURES = {
    "centre": "the centre hole moves by",
    "largest": "the hole that moves most, by",
    "rms": "all holes move by, rms",
    "shape": "without the shift of the whole image, rms",
}


@dataclass(frozen=True)
class Figure13:
    """The study."""

    name = "fig13"
    about = "The paper's figure 13: a plate fixed to the intensifier, PA against lateral image"

    chain: str = "9in-1k"

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the distributions that they depend on."""
        return {**asdict(self), "distortion": asdict(Distortion()), "hole_pitch_mm": HOLE_PITCH_MM}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return the positions of the holes in both images, mm at the input plane, and their displacements."""
        optics, spread = preset(self.chain), Distortion()
        tube, earth = draw_tube(rng, optics, spread), draw_earth(rng, spread)
        middle = (np.array(optics.shape[::-1]) - 1) / 2
        pa, lateral = (
            (tube.expose(rng, axes, earth).to_image(holes_mm(optics.field_mm / 2)) - middle) * optics.pitch_mm
            for axes in POSES.values()
        )
        moved = lateral - pa
        length = np.linalg.norm(moved, axis=1)
        rest = np.linalg.norm(moved - moved.mean(axis=0), axis=1)
        return {
            "centre": float(length[0]),
            "largest": float(length.max()),
            "rms": float(np.sqrt(np.mean(length**2))),
            "shape": float(np.sqrt(np.mean(rest**2))),
            "pa": pa.round(3).tolist(),
            "lateral": lateral.round(3).tolist(),
        }

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return the displacements of the holes, and a plot of one displacement field."""
        quantiles = {
            name: [quantile(f"{name}, {at:.0%}", np.array([t[name] for t in trials]), at) for at in QUANTILES]
            for name in MEASURES
        }
        low, high = PAPER_MM
        centre = np.array([trial["centre"] for trial in trials])
        inside = share("set-ups whose centre hole moves by 2 to 3 mm", (centre >= low) & (centre <= high))
        rows = [(words, *(f"{estimate.value:.2f}" for estimate in quantiles[name])) for name, words in MEASURES.items()]
        optics = preset(self.chain)
        typical = trials[int(np.argmin(np.abs(centre - np.median(centre))))]
        title = "PA (hollow) and lateral (filled) positions of the holes"
        drawing = field(np.array(typical["pa"]), np.array(typical["lateral"]), optics.field_mm / 2, title)
        five, median, ninety_five = (estimate.value for estimate in quantiles["centre"])
        return Summary(
            findings=(
                f"The centre hole moves by {median:.1f} mm (median; central 90 %: {five:.1f} to {ninety_five:.1f} mm), "
                f"{(median or 0.0) / optics.pitch_mm:.0f} px; the paper saw 2 to 3 mm, 8 px.",
                f"In {inside.value:.0%} of set-ups it moves by 2 to 3 mm.",
            ),
            estimates=(inside, *(estimate for estimates in quantiles.values() for estimate in estimates)),
            tables=(Table("Displacement, mm at the input plane", ("", "5 %", "median", "95 %"), tuple(rows)),),
            plots=(Plot(title, drawing, "The set-up whose centre hole (pink) moves by the median; to scale."),),
        )


def holes_mm(radius_mm: float) -> np.ndarray:
    """Return a square grid of holes (N, 2) over the round field, the centre hole first."""
    reach = int(radius_mm // HOLE_PITCH_MM)
    steps = HOLE_PITCH_MM * np.arange(-reach, reach + 1)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    distance = np.linalg.norm(grid, axis=1)
    order = np.argsort(distance, kind="stable")
    return grid[order][distance[order] < radius_mm - 2.0]
