"""What is checked of a calibrated view; what a plan asks of it at its target, planning checks.

A view is never judged by its focal point alone: an error of F along the beam of 100 mm can mean less than 0.2 mm at
the target.
"""

from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull
from scipy.special import chdtri

from sightline.calibration.beads import Beads
from sightline.calibration.joint import JointFit
from sightline.calibration.residuals import Residuals
from sightline.checks import Check
from sightline.frame import Frame
from sightline.geometry.planes import Plane

MIN_COUNT = 24  # [ours] one more than the 23 numbers of a cubic and F
MIN_COVERAGE = 0.45  # [ours] share of each plate's area, within the hull of its beads used
MAX_LEAVE_ONE_OUT_MM = 0.5  # [ours] half of the 1 mm the paper reaches at the entry point
MAX_NOISE_PX = 2.0  # [ours] twice an ordinary click (physics.md, Picks)
CHI_SQUARE_FALSE_ALARM = 1e-4  # [ours]
MIN_BESIDE_ROW = 6  # [ours] beads on either side of a row at which an image may be torn


def view_checks(beads: Beads, residuals: Residuals) -> list[Check]:
    """The checks of every method: count, coverage, wrong beads, leave-one-out, tolerances."""
    used = beads.where(residuals.used)
    out = [_count(len(used)), _coverage(used), _leave_one_out(residuals)]
    if residuals.left_out:
        out.append(_wrong(residuals))
    if beads.frame.tolerances is None and beads.frame.covariance_mm2 is None:
        sd = beads.frame.effective_tolerances
        sentence = (
            f"The frame file states no tolerances; {sd.bead_mm} mm per bead, {sd.plate_mm} mm per plate are assumed."
        )
        out.append(Check("frame tolerances", True, sd.plate_mm, None, "mm", sentence))
    return out


def noise_checks(fit: JointFit) -> list[Check]:
    """Whether the residuals agree with the noise stated, or what the noise was estimated to be."""
    if fit.beads.covariance_px2 is None:
        figure = fit.learned.noise_scale
        sentence = (
            f"No covariance of the beads was given; their noise is estimated from the residuals: {figure:.2f} px."
        )
        return [Check("measurement noise", figure <= MAX_NOISE_PX, figure, MAX_NOISE_PX, "px", sentence)]
    free = len(fit.data_mm) - fit.solution.theta.shape[0]
    figure = float(fit.data_mm @ fit.solution.dual[:, 0]) / free
    limit = float(chdtri(free, CHI_SQUARE_FALSE_ALARM)) / free
    sentence = (
        "The residuals agree with the noise and the tolerances stated."
        if figure <= limit
        else "The residuals are larger than the noise and tolerances stated explain: check labels and frame."
    )
    return [Check("chi-square", figure <= limit, figure, limit, "", sentence)]


def handedness_check(upright: bool, mirrored_display: bool | None) -> Check:
    """Whether the frame file describes the frame, and not its mirror image.

    `upright`: an image shows the beads as the file has them, once a mirrored display is allowed for;
    `mirrored_display`: what a person said of it, None where nobody was asked.
    """
    if mirrored_display is None:
        sentence = (
            "An image shows the frame as its file describes it, not as a mirror image."
            if upright
            else "Every image shows the mirror image of the frame file: either the displays are mirrored, or the file "
            "is left-handed and every point is wrong. Look at writing in the images. If it is mirrored, confirm that: "
            "mirrored_display=True of calibrate, --mirrored on the command line, in the app on the step Images. If "
            "not, correct the frame file."
        )
    else:
        display = "mirrored" if mirrored_display else "not mirrored"
        sentence = f"The display is {display}, as was said, and the image of the beads agrees"
        if not upright:
            sentence = (
                f"The display is {display}, as was said, and the image of the beads contradicts it: the frame file "
                "describes the mirror image of the frame. Correct its axes to a right-handed system, and run "
                "'sightline frame check --before' with the file before it"
            )
        sentence += "."
    return Check("frame handedness", upright, None, None, "", sentence)


def row_check(fit: JointFit) -> Check:
    """Whether the rows above some row are shifted against those below, in the direction that shows it best.

    A shift of the pixels of one side, along the rows or across, is one number more in the model of the image; every row
    between two beads is tried.
    """
    uv, slopes = fit.beads.uv_px, fit.map.jacobian(fit.beads.uv_px)
    order = np.sort(uv[:, 1])
    rows = (order[MIN_BESIDE_ROW - 1 : -MIN_BESIDE_ROW] + order[MIN_BESIDE_ROW : len(order) - MIN_BESIDE_ROW + 1]) / 2
    below = uv[:, 1, None] > rows
    directions = np.concatenate([-slopes[:, :, k, None] * below[:, None] for k in range(2)], axis=2)
    shifts_px, sds_px = fit.solution.score(directions.reshape(2 * len(uv), -1))
    sigma = np.abs(shifts_px) / sds_px
    worst = int(sigma.argmax())
    figure, limit = float(sigma[worst]), float(np.sqrt(chdtri(1, CHI_SQUARE_FALSE_ALARM / len(sigma))))
    if passed := figure <= limit:
        sentence = "No row is found at which the image is torn."
    else:
        way = ("along", "across")[worst // len(rows)]
        sentence = (
            f"The image seems torn at row {rows[worst % len(rows)]:.0f}: what lies below is shifted by "
            f"{abs(shifts_px[worst]):.1f} px {way} the rows. Take another image, or check how it was transferred."
        )
    return Check("image rows", passed, figure, limit, "σ", sentence)


def _count(count: int) -> Check:
    sentence = f"{count} beads are used; {MIN_COUNT} are needed for a residual to tell anything, 60 or more are good."
    return Check("bead count", count >= MIN_COUNT, float(count), float(MIN_COUNT), "beads", sentence)


def _coverage(used: Beads) -> Check:
    view, areas = used.frame.view(used.view), _plate_areas_mm2(used.frame, used.view)
    figures = {}
    for name, plate, mine in (("XRII", view.xrii, used.on_xrii), ("source", view.source, ~used.on_xrii)):
        figures[name] = _area_mm2(plate.plane, used.xyz_mm[mine]) / areas[name]
    least = min(figures, key=lambda name: figures[name])
    figure = float(figures[least])
    sentence = f"The beads used span {figure:.0%} of the {least} plate" + (
        "." if figure >= MIN_COVERAGE else ": move the frame so that more of this plate lies in the field."
    )
    return Check("bead coverage", figure >= MIN_COVERAGE, figure, MIN_COVERAGE, "", sentence)


def _area_mm2(plane: Plane, xyz_mm: np.ndarray) -> float:
    return float(ConvexHull(plane.to_plane(xyz_mm)).volume)  # of a hull in two dimensions: its area


@lru_cache(maxsize=16)
def _plate_areas_mm2(frame: Frame, view: str) -> dict[str, float]:
    """The same for every image taken with the frame."""
    plates = {"XRII": frame.view(view).xrii, "source": frame.view(view).source}
    return {name: _area_mm2(plate.plane, plate.xyz_mm) for name, plate in plates.items()}


def _leave_one_out(residuals: Residuals) -> Check:
    limit = MAX_LEAVE_ONE_OUT_MM
    if not (residuals.used & residuals.predicted).any():
        sentence = "No bead can be predicted from the others: too few are seen. More beads are needed."
        return Check("leave-one-out error", False, None, limit, "mm", sentence)
    figure = residuals.leave_one_out_rms_mm
    sentence = f"Each bead is predicted by the others to {figure:.3f} mm rms per axis on its plate."
    return Check("leave-one-out error", figure <= limit, figure, limit, "mm", sentence)


def _wrong(residuals: Residuals) -> Check:
    names = ", ".join(residuals.left_out)
    sentence = f"Beads that contradict the others were left out: {names}. Check their labels and centres."
    count = float(len(residuals.left_out))
    return Check("wrong beads", True, count, None, "beads", sentence)
