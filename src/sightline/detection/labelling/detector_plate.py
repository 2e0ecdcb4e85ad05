"""Label the plate on the detector of an image intensifier, and take the other detections to its plane."""

from dataclasses import dataclass, replace

import numpy as np

from sightline.detection.labelling.checks import AttemptError, Stage
from sightline.detection.labelling.growth import grow
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.labelling.seeds import find_seeds
from sightline.detection.labelling.solve import LabellingProblem, solve_alone
from sightline.detection.results import Detections
from sightline.errors import LabellingRefusedError

MIN_BEADS = 12  # what the calibration needs
SEEDS = 12  # [ours]
FOCAL_MM = (850.0, 1300.0)  # from the X-ray source to the plate, 95 % [ours]


@dataclass(frozen=True, eq=False)
class LabelledPlate:
    """A plate's beads: detections `rows` are its fiducials `ids`; `mirrored`: the image shows them as a mirror image.

    `xy_mm` (N, 2): all N detections on the plate's plane; `variance_mm2` (N,): of each coordinate there; `px_per_mm`.
    """

    pattern: Pattern
    rows: np.ndarray
    ids: tuple[str, ...]
    mirrored: bool
    xy_mm: np.ndarray
    variance_mm2: np.ndarray
    px_per_mm: float

    @property
    def focal_px(self) -> tuple[float, float]:
        """Limits of the focal length of the undistorted image."""
        low, high = (self.px_per_mm * mm for mm in FOCAL_MM)
        return low, high

    def undistorted(self, detections: Detections) -> tuple[Detections, np.ndarray]:
        """Return the other detections as a panel in the plate's plane shows them, seen from the source, and their rows.

        The plate's z points towards the source, so that its x, y and the beam are left-handed: u is -x.
        """
        rows = np.delete(np.arange(len(detections)), self.rows)
        middle = self.pattern.plane.to_plane(np.zeros(3))
        half = self.px_per_mm * np.abs(self.pattern.xy_mm - middle).max()
        size = 2 * int(np.ceil(half)) + 1
        uv = (size - 1) / 2 + self.px_per_mm * (self.xy_mm[rows] - middle) * [-1.0, 1.0]
        variance = self.px_per_mm**2 * self.variance_mm2[rows]
        return (
            replace(
                detections,
                uv_px=uv,
                radius_px=detections.radius_px[rows],
                covariance_px2=variance[:, None, None] * np.eye(2),
                kind=tuple(detections.kind[k] for k in rows),
                contrast=detections.contrast[rows],
                image_shape=(size, size),
                rejected=(),
                pixels=None,
            ),
            rows,
        )


def label_plate(detections: Detections, usable: np.ndarray, pattern: Pattern) -> LabelledPlate:
    """Return the labels of the plate on the detector. Raises LabellingRefusedError."""
    problem = LabellingProblem(detections, usable, [], None)
    failure = AttemptError(
        Stage.SEEDS,
        "no datum markers of the plate on the detector are found among the beads; check that the plate is on the "
        "detector, or use the frame without it ('block30', not 'block30+detector-plate')",
    )
    for seed in find_seeds(detections, [pattern], usable, SEEDS):
        grown = grow(seed, detections, usable)
        if len(grown) < MIN_BEADS:
            continue
        try:
            beads, fit = solve_alone(problem, grown)
        except AttemptError as error:
            failure = max(failure, error, key=lambda one: one.stage)
            continue
        if len(beads) >= MIN_BEADS:
            similarity = grown.sheet.similarity
            ids = tuple(pattern.ids[place] for place in beads[:, 1])
            return LabelledPlate(
                pattern, beads[:, 0], ids, not similarity.mirror, fit.xy_mm, fit.variance_mm2, similarity.scale
            )
        few = f"{len(beads)} beads of the plate on the detector are labelled; {MIN_BEADS} are needed: show more of it"
        failure = AttemptError(Stage.CHECKS, few)
    raise LabellingRefusedError(str(failure))
