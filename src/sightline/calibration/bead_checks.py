"""Checks of a calibrated view. Its error at a target is checked in planning.

The checks of this module do not judge a view by its focal point alone: if F is wrong by 100 mm along the beam, the
error at the target can be below 0.2 mm.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from sightline.calibration.maps.hull import Hull
from sightline.calibration.plates.beads import Beads
from sightline.calibration.plates.joint import JointFit
from sightline.calibration.view import Residuals
from sightline.common.checks import FALSE_ALARM, Check, at_most
from sightline.common.fitting import distances
from sightline.common.geometry.outlines import convex_hull, enclosed_area
from sightline.common.geometry.planes import Plane
from sightline.frame import Frame

MIN_COUNT = 24  # a cubic and F have 23 parameters: more degrees of freedom are left, 25, than are fitted [calc]
MIN_COVERAGE = 0.45  # [ours] of a plate's area in its used beads' convex hull: with less, most of it is extrapolated
MAX_LEAVE_ONE_OUT_MM = 0.5  # [ours] half of the 1 mm the paper reaches at the entry point
MAX_NOISE_PX = 2.0  # twice an ordinary click [physics.md, Picks]
MIN_BESIDE_ROW = 6  # [ours] beads on either side of a row that is tested for a tear: the mean of fewer is uncertain


def view_checks(beads: Beads, residuals: Residuals) -> list[Check]:
    """Return the checks common to all methods: count, coverage, leave-one-out, wrong beads, tolerances."""
    used = beads.where(residuals.used)
    needed = f"beads are used; {MIN_COUNT} are needed for meaningful residuals, 60 or more are good"
    count = count_check(len(used), MIN_COUNT, needed, "move the frame so that more of both plates lies in the field")
    checks = [count, _coverage(used), leave_one_out_check(residuals)]
    if residuals.left_out:
        checks.append(wrong_beads_check(residuals))
    return checks + tolerance_checks(beads.frame)


def tolerance_checks(frame: Frame) -> list[Check]:
    """Return a check that says so where a frame states no tolerances."""
    if frame.tolerances is not None or frame.covariance_mm2 is not None:
        return []
    sd = frame.effective_tolerances
    if frame.solid is not None:
        assumed, keys, value = f"{sd.bead_mm} mm per bead is", "`sd_mm`", sd.bead_mm
    else:
        assumed, keys = f"{sd.bead_mm} mm per bead, {sd.plate_mm} mm per plate are", "`sd_mm` and `sd_rad`"
        value = sd.plate_mm
    sentence = (
        f"The frame file states no tolerances; {assumed} assumed: have the frame measured and state {keys} in its file."
    )
    return [Check("frame tolerances", True, value, None, "mm", sentence)]


def noise_checks(fit: JointFit) -> list[Check]:
    """Return one check: chi-square where covariances were given, otherwise the estimated noise."""
    if fit.beads.covariance_px2 is None:
        noise_px = fit.learned.noise_scale
        states = (
            f"No covariance of the beads was given; their noise, estimated from the residuals, is {noise_px:.2f} px"
        )
        otherwise = f", limit {MAX_NOISE_PX:g} px: check labels and frame, or acquire a sharper image."
        return [at_most("measurement noise", noise_px, MAX_NOISE_PX, "px", states, otherwise=otherwise)]
    return [
        chi_square_check(
            *_misfit(fit),
            "The residuals agree with the stated noise and tolerances.",
            "The residuals are larger than the stated noise and tolerances explain: the frame is not as its file says "
            "(another frame, balls beside their places, too small tolerances), or the image is blurred or torn.",
        )
    ]


def _misfit(fit: JointFit) -> tuple[float, int]:
    """Return the sum of squared residuals over their expected variances, and its degrees of freedom."""
    return float(fit.data_mm @ fit.solution.dual[:, 0]), len(fit.data_mm) - fit.solution.theta.shape[0]


def beyond_misfit(sigma: float, square: float, freedom: int) -> float:
    """Return the significance of one more parameter; where the residuals are too large, against what it leaves of them.

    Where the frame's file is wrong, many a parameter explains a little of that, and none is the cause.

    `sigma`: its estimate over its s.d.; `square`, `freedom`: of the residuals without it.
    """
    if square <= chdtri(freedom, FALSE_ALARM):
        return sigma
    return sigma / float(np.sqrt(max(1.0, (square - sigma**2) / (freedom - 1))))


def chi_square_check(square: float, freedom: int, agrees: str, disagrees: str) -> Check:
    """Return the check of a sum of squared residuals over their expected variances."""
    reduced, limit = square / freedom, float(chdtri(freedom, FALSE_ALARM)) / freedom
    return Check("chi-square", reduced <= limit, reduced, limit, "", agrees if reduced <= limit else disagrees)


def handedness_check(upright: bool, mirrored_display: bool | None) -> Check:
    """Return the check that the frame file describes the frame, not its mirror image.

    `upright`: whether the beads appear unmirrored once a declared mirrored display is undone.
    `mirrored_display`: whether a person saw that the display is mirrored; None where nobody was asked.
    """
    if mirrored_display is None:
        sentence = (
            "An image shows the frame as its file describes it, not as a mirror image."
            if upright
            else "Every image shows the mirror image of the frame file: either the displays are mirrored, or the file "
            "is left-handed and every point is wrong. Look at writing in the images. If it is mirrored, confirm that: "
            "calibrate(..., mirrored_display=True), mirrored in the file of picks, or the step Images of the app. If "
            "not, correct the frame file."
        )
    else:
        display = "mirrored" if mirrored_display else "not mirrored"
        sentence = f"The display is stated to be {display}, and the image of the beads agrees"
        if not upright:
            sentence = (
                f"The display is stated to be {display}, but the image of the beads contradicts it: the frame file "
                "describes the mirror image of the frame. Correct its axes to a right-handed system, and run "
                "'sightline frame check --before' with the previous file"
            )
        sentence += "."
    return Check("frame handedness", upright, None, None, "", sentence)


def row_check(fit: JointFit) -> Check:
    """Return the check that the image is not torn: that no part below a row is shifted against the part above.

    A shift of the lower part, along or across the rows, is one more parameter of the image model, judged by
    `beyond_misfit`. It is tested midway between beads that follow each other in v, wherever at least `MIN_BESIDE_ROW`
    beads lie on either side.
    """
    uv, slopes = fit.beads.uv_px, fit.map.jacobian(fit.beads.uv_px)
    order = np.argsort(uv[:, 1])
    v = uv[order, 1]
    rows = (v[MIN_BESIDE_ROW - 1 : -MIN_BESIDE_ROW] + v[MIN_BESIDE_ROW : len(v) - MIN_BESIDE_ROW + 1]) / 2
    below = np.searchsorted(v, rows, side="right")
    scores = [fit.solution.score_tails(-slopes[:, :, k], order, below) for k in range(2)]
    shifts_px, sds_px = (np.concatenate(values) for values in zip(*scores, strict=True))
    sigma = np.abs(shifts_px) / sds_px
    worst = int(sigma.argmax())
    largest, limit = (
        beyond_misfit(float(sigma[worst]), *_misfit(fit)),
        float(np.sqrt(chdtri(1, FALSE_ALARM / len(sigma)))),
    )
    if passed := largest <= limit:
        sentence = "The image is not torn at any row."
    else:
        direction = ("along", "across")[worst // len(rows)]
        sentence = (
            f"The image seems torn at row {rows[worst % len(rows)]:.0f}: the part below is shifted by "
            f"{abs(shifts_px[worst]):.1f} px {direction} the rows. Acquire another image, or check how it was "
            "transferred."
        )
    return Check("image rows", passed, largest, limit, "σ", sentence)


def strip_check(shift_px: float) -> Check:
    """Return the failed check of an image with a strip of rows shifted by `shift_px`, whose beads were not labelled."""
    sentence = (
        f"A strip of the image seems shifted by {abs(shift_px):.0f} px along the rows: its beads lie beside the places "
        "where the others expect them, all by the same distance. Acquire another image, or check how it "
        "was transferred."
    )
    return Check("image rows", False, abs(shift_px), None, "px", sentence)


def count_check(count: int, least: int, needed: str, advice: str) -> Check:
    """Return the check of the number of beads; `needed`: what the sentence says of it."""
    sentence = f"{count} {needed}" + ("." if count >= least else f": {advice}.")
    return Check("bead count", count >= least, float(count), float(least), "beads", sentence)


def _coverage(used: Beads) -> Check:
    plates, shares = used.frame.view(used.view), {}
    for name, plate, own in (("XRII", plates.xrii, used.on_xrii), ("source", plates.source, ~used.on_xrii)):
        shares[name] = _area_mm2(plate.plane, used.xyz_mm[own]) / _area_mm2(plate.plane, plate.xyz_mm)
    smallest = min(shares, key=lambda name: shares[name])
    share = float(shares[smallest])
    sentence = f"The beads used span {share:.0%} of the {smallest} plate" + (
        "." if share >= MIN_COVERAGE else ": move the frame so that more of this plate lies in the field."
    )
    return Check("bead coverage", share >= MIN_COVERAGE, share, MIN_COVERAGE, "", sentence)


def _area_mm2(plane: Plane, xyz_mm: np.ndarray) -> float:
    xy = plane.to_plane(xyz_mm)
    return enclosed_area(xy[convex_hull(xy)])


def leave_one_out_check(residuals: Residuals) -> Check:
    """Return the check of the rms leave-one-out error."""
    limit = MAX_LEAVE_ONE_OUT_MM
    if not (residuals.used & residuals.predicted).any():
        sentence = "Bring more beads into the field: too few are seen to predict any of them from the others."
        return Check("leave-one-out error", False, None, limit, "mm", sentence)
    rms = residuals.leave_one_out_rms_mm
    states = f"The others predict each bead to {rms:.3f} mm rms per axis on its plate"
    otherwise = f", limit {limit:g} mm: check in the report the labels of the beads with the largest residuals."
    return at_most("leave-one-out error", rms, limit, "mm", states, otherwise=otherwise)


def wrong_beads_check(residuals: Residuals) -> Check:
    """Return the check, always passed, that names the beads left out."""
    names = ", ".join(residuals.left_out)
    sentence = f"Beads that contradict the others were left out: {names}. Check their labels and centres."
    count = float(len(residuals.left_out))
    return Check("wrong beads", True, count, None, "beads", sentence)


# Unlabelled detections beside missing beads, all by one shift along the rows: so many are a strip of shifted rows. Of
# 28 detections and 20 missing beads at random places six agree in fewer than one of a million images [calc].
MIN_STRIP = 6
# Errors of the map, which is extrapolated there: far below a pitch [ours].
_SAME_ROW_PX, _SAME_SHIFT_PX = 4.0, 8.0
_LEAST_SHIFT_PX, _MOST_SHIFT_PX = 3.0, 100.0  # beads that are shifted by less are labelled, and their residuals show it
NEIGHBOURS = 8  # [ours] beads about a pixel, of both plates: within 1.1 pitches with 7 x 7 and 8 x 8 beads


@dataclass(frozen=True, eq=False)
class Support:
    """E isolated beads of the view: `places_px` (E, 2), `radii_px` (E,), `used` (E,) bool.

    `stray_px` (M, 2): detections that are not used beads; None where unknown, and then no bead counts as hidden.
    """

    places_px: np.ndarray
    radii_px: np.ndarray
    used: np.ndarray
    stray_px: np.ndarray | None

    @staticmethod
    def of(places_px: np.ndarray, radii_px: np.ndarray, used: np.ndarray, stray_px: np.ndarray | None) -> "Support":
        """Return the support of all beads that the view projects (M, 2), without those whose shadows touch.

        Of two that touch, detection may find none, or a single one that is neither.
        """
        clearance = distances(places_px, places_px) - radii_px[:, None] - radii_px
        np.fill_diagonal(clearance, np.inf)
        isolated = clearance.min(axis=1, initial=np.inf) > 0.0
        if stray_px is not None:
            on_pair = (distances(stray_px, places_px[~isolated]) < radii_px[~isolated]).any(axis=1)
            stray_px = stray_px[~on_pair]
        return Support(places_px[isolated], radii_px[isolated], used[isolated], stray_px)

    def near(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N, 3) int: how many of the NEIGHBOURS beads nearest to each pixel (N, 2) are used, hidden, expected.

        Expected are beads in the convex hull of the used beads, all other detections and the pixel: the field of view
        is convex and contains these. Without the other detections nothing would be expected of a strip at the field's
        edge whose beads were all dropped.
        """
        inside = _inside(self._hull, uv_px)
        counts = np.zeros((len(uv_px), 3), dtype=int)
        counts[inside] = self._counted(uv_px[inside], self._expected)
        for k in np.flatnonzero(~inside):
            hull = _hull(np.concatenate([self._known_px, uv_px[k : k + 1]]))
            counts[k] = self._counted(uv_px[k : k + 1], _inside(hull, self.places_px, self.radii_px))
        return counts

    @cached_property
    def _known_px(self) -> np.ndarray:
        """(K, 2): the used beads and all other detections."""
        used = self.places_px[self.used]
        return used if self.stray_px is None else np.concatenate([used, self.stray_px])

    @cached_property
    def _hull(self) -> Hull | None:
        return _hull(self._known_px)

    @cached_property
    def _expected(self) -> np.ndarray:
        """(E,) bool: within the convex hull of the used beads and all other detections."""
        return _inside(self._hull, self.places_px, self.radii_px)

    def _counted(self, uv_px: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Return `near` of pixels (N, 2) where the beads `seen` (E,) and the used ones are expected."""
        expected = np.flatnonzero(seen | self.used)
        away, count = distances(uv_px, self.places_px[expected]), min(len(expected), NEIGHBOURS)
        near = away.argsort(axis=1)[:, :count]
        used = self.used[expected[near]].sum(axis=1)
        hidden = np.zeros_like(used)
        if self.stray_px is not None:
            reach = np.take_along_axis(away, near, axis=1).max(axis=1, initial=0.0)
            beside = (distances(uv_px, self.stray_px) <= reach[:, None]).sum(axis=1)
            hidden = np.maximum(count - used - beside, 0)
        return np.stack([used, hidden, np.full_like(used, count)], axis=1)

    def strip_shift_px(self) -> float | None:
        """Return the shift along the rows that takes missing beads to MIN_STRIP or more unlabelled detections, if any.

        Labelling drops the beads of a strip of shifted rows, so no residual shows them.
        """
        missing = self.places_px[~self.used]
        if self.stray_px is None or min(len(missing), len(self.stray_px)) < MIN_STRIP:
            return None
        shift, off_row = np.moveaxis(self.stray_px[:, None] - missing, -1, 0)
        beside = (np.abs(off_row) < _SAME_ROW_PX) & (np.abs(shift) < _MOST_SHIFT_PX) & (np.abs(shift) > _LEAST_SHIFT_PX)
        starts = np.append(shift[beside], 0.0)
        together = beside & (np.abs(shift - starts[:, None, None] - _SAME_SHIFT_PX / 2) <= _SAME_SHIFT_PX / 2)
        count = np.minimum(together.any(axis=1).sum(axis=1), together.any(axis=2).sum(axis=1))
        best = int(count.argmax())
        return float(np.median(shift[together[best]])) if count[best] >= MIN_STRIP else None


def _hull(uv_px: np.ndarray) -> Hull | None:
    """Return the convex hull of pixels (N, 2); None where they are collinear."""
    return Hull.of(uv_px) if len(convex_hull(uv_px)) > 2 else None


def _inside(hull: Hull | None, uv_px: np.ndarray, margin_px: np.ndarray | float = 0.0) -> np.ndarray:
    """Return (N,) bool: whether pixels (N, 2) lie within a convex hull, by at least a margin.

    All True without a hull: then every bead is expected.
    """
    return np.ones(len(uv_px), dtype=bool) if hull is None else hull.distance_px(uv_px) <= -np.asarray(margin_px)
