"""Plausibility checks of labels: the fit must be possible for this frame, a C-arm and an intensifier."""

from enum import IntEnum

import numpy as np

from sightline.common.fitting import exact_squares
from sightline.detection.labelling.growth import Grown
from sightline.detection.labelling.joint import Joint, Model

MAX_SCATTER = 0.02  # of the pitch, rms of the beads about their places; 2 px at the design distance [ours]
MAX_BEND = 4.5  # s.d. of the prior that a map may need [ours]
# Largest log ratio of apparent and stated ball size: -0.02 to 0.03 in 108 images of the twin. Another machine's blur
# gives larger errors, and confusing 3 mm with 1/8 inch balls does no harm (0.06) [ours]
BALL_LOG_SIZE = 0.15
SIZES_WRONG = 2  # tolerated wrong sizes per plate: 2 % are misjudged, touching pairs look large [ours]
BEYOND_M2, MAX_BEYOND = 9.2, 1  # 99 % of chi-squared; by chance, 1 of 90 scenes has one ball there, none has two [ours]
MIN_EXPLAINED = 0.6  # share of the ball-like detections that must be beads of the frame [ours]
FOCAL_MM = (300.0, 2000.0)  # distance of the focal point from the XRII plate; 920 mm at the design distance [ours]
FOCAL_SLOPE = 0.45  # tangent of the beam's angle to the plates' normal: a tilt of 20° and an off-centre field [ours]


class Stage(IntEnum):
    """The stage at which an attempt to label an image failed, in the order of the steps."""

    SEEDS = 0  # finding three datum markers
    LATTICES = 1  # finding a second lattice of beads
    NAMES = 2  # naming the plates of the lattices
    UNIQUENESS = 3  # excluding every other labelling
    PROJECTION = 4  # fitting one central projection to both plates
    CHECKS = 5  # checking the fit
    FINAL = 6  # the beads are explained but contradict the geometry: no other attempt is made


class AttemptError(Exception):
    """An attempt to label an image failed, with its stage; the message of the furthest attempt is reported."""

    def __init__(self, stage: Stage, message: str) -> None:
        super().__init__(message)
        self.stage = stage


def check(model: Model, fit: Joint, beads: np.ndarray, pair: tuple[Grown, Grown], ball_like: np.ndarray) -> None:
    """Check the labels of `beads` (B, 2): detection and place. Raises AttemptError.

    `ball_like` (N, 2): whether each detection looks like a bead of the XRII plate, and of the source plate.
    """
    left = ball_like.copy()
    left[beads[:, 0]] = False
    _check_map(model, fit, beads)
    _check_explained(beads, int(ball_like.any(axis=1).sum()))
    _check_edge(model, fit, pair, left)
    _check_pattern(pair)
    _check_ball_size(fit, pair)
    _check_focal_point(model, fit, beads)


def check_alone(model: Model, fit: Joint, beads: np.ndarray, plate: Grown) -> None:
    """Check the labels of `beads` (B, 2) of a plate alone. Raises AttemptError."""
    _check_map(model, fit, beads)
    _check_pattern((plate,))


def _check_map(model: Model, fit: Joint, beads: np.ndarray) -> None:
    """Check that the beads lie at their places, by a map that an intensifier can have."""
    off = fit.xy_mm[beads[:, 0]] - fit.target_mm[beads[:, 1]]
    scatter = float(np.sqrt((off**2).mean()))
    if scatter > MAX_SCATTER * model.xrii.pitch_mm:
        raise AttemptError(
            Stage.CHECKS,
            f"the beads miss their places on the {model.xrii.role_name} plate by {scatter:.2f} mm; check the frame "
            "file",
        )
    if fit.bend > MAX_BEND:
        raise AttemptError(
            Stage.CHECKS, "the labels would need a distortion that no intensifier has; is this the frame in the image?"
        )


def _check_explained(beads: np.ndarray, ball_like: int) -> None:
    """Check that most detections that look like beads are explained."""
    if len(beads) < MIN_EXPLAINED * ball_like:
        raise AttemptError(
            Stage.CHECKS,
            f"only {100 * len(beads) / ball_like:.0f} % of the bead-like spots lie on the frame's places; "
            "check the frame file, or give the datum markers' pixels",
        )


def _check_edge(model: Model, fit: Joint, pair: tuple[Grown, Grown], left: np.ndarray) -> None:
    """Check for beads beyond a plate's edge, which show that all labels are shifted by one step of the grid."""
    for plate, own in zip(pair, left.T, strict=True):
        if not own.any():
            continue
        beyond = model.shadows.of_points(plate.pattern.beyond_mm, fit.focal_point_mm)
        off2 = exact_squares(fit.xy_mm[own], beyond) / fit.variance_mm2[own][:, None]
        seen = int((off2 < BEYOND_M2).any(axis=1).sum())
        if seen > MAX_BEYOND:
            raise AttemptError(
                Stage.CHECKS,
                f"{seen} balls are seen beyond the edge of the {plate.pattern.role_name} plate, where its grid would "
                "go on: the labels may be shifted; show more of its datum markers, or give their pixels",
            )


def _check_pattern(pair: tuple[Grown, ...]) -> None:
    """Check the datum markers of each plate: a shifted grid still fits, its pattern of datum markers does not."""
    for plate in pair:
        pattern = plate.pattern
        seen = np.abs(plate.log_ratio[plate.all_rows][:, None] - pattern.log_sizes).argmin(axis=1)
        said = pattern.size_of[plate.all_places]
        agree = int((pattern.datum[plate.all_places] & (seen == said)).sum())
        contradict = int((seen != said).sum())
        if contradict > max(SIZES_WRONG, agree):
            raise AttemptError(
                Stage.FINAL,
                f"the sizes of {contradict} balls contradict the pattern of datum markers of the {pattern.role_name} "
                f"plate and those of {agree} agree; this is another frame than the file describes",
            )


def _check_ball_size(fit: Joint, pair: tuple[Grown, Grown]) -> None:
    """Check the size of each plate's balls against the plate's own grid.

    A tilt shortens the grid by its cosine in one direction, but not the balls.
    """
    for plate in pair:
        pattern = plate.pattern
        ray = fit.focal_point_mm - pattern.xyz_mm[plate.places].mean(axis=0)
        cosine = abs(float(ray @ pattern.plane.normal)) / float(np.linalg.norm(ray))
        larger = plate.level + np.log(cosine) / 2
        if abs(larger) > BALL_LOG_SIZE:
            says = float(np.median(pattern.diameter_mm))
            raise AttemptError(
                Stage.FINAL,
                f"the balls of the {pattern.role_name} plate look {says * np.exp(larger):.2f} mm large, and the "
                f"frame says {says:.2f} mm; is this the frame in the image?",
            )


def _check_focal_point(model: Model, fit: Joint, beads: np.ndarray) -> None:
    """Check that a C-arm can have the focal point there, beyond the source plate."""
    away = model.xrii.plane.normal * model.shadows.side
    ray = fit.focal_point_mm - model.xrii.plane.to_space(fit.target_mm[beads[:, 1]].mean(axis=0))
    far = float(ray @ away)
    aside = float(np.linalg.norm(ray - far * away))
    if not FOCAL_MM[0] < far < FOCAL_MM[1] or aside > FOCAL_SLOPE * far:
        raise AttemptError(
            Stage.FINAL,
            f"the labels put the focal point {far:.0f} mm from the XRII plate and {aside:.0f} mm aside, where no C-arm "
            "has it; check that the frame file describes the frame in the image",
        )
