"""Track labelled beads through a sequence of images.

Candidates and labels are not searched for again: each bead is fitted from its last centre, radius and contrast, with
the noise of the last full detection. At rest, one linear step from an earlier image's fit is enough (`LinearFits`). The
sizes of the balls, on which labels rest, are compared in every image.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from sightline.detection import columns, refine
from sightline.detection.again import look_again_with, rows_with_others
from sightline.detection.clipping import allow_for_missing_foot, clipped_shares
from sightline.detection.covered import without_overlaps
from sightline.detection.detector import bead_fitter, fine_reasons, without_middles
from sightline.detection.linear import LinearFits, reach_px
from sightline.detection.log_image import field_inset, log_image, logs_of, logs_within
from sightline.detection.noise import estimate_noise
from sightline.detection.results import Detections, Observations
from sightline.detection.scale import FACTOR, coarser, coarser_observations, finer_observations, is_fine
from sightline.detection.window import window_reach
from sightline.errors import ObservationsError
from sightline.fitting.robust import MEDIAN_M2, median
from sightline.frame import Frame
from sightline.imaging import Radiograph

MAX_LOST = 0.25  # share of the tracked beads; an instrument in the beam hides fewer [ours]
SIZES_WRONG = 3  # balls with the size of the frame's other balls; labelling allows two [ours]
_HALF_WAY = 0.5  # of the step of log radius between two sizes of ball
_MAX_LOG_SIZE = 0.15  # change of log radius; a correct bead's is 0.03 [twin], the step to a datum ball 0.51
_FROM_OTHERS_PX = 3.0  # largest distance from the place predicted by the other beads' movement [ours]
_AT_REST_PX = 0.3  # smaller movements of a plate are not extrapolated to the next image [ours]
_STILL = 0.5  # share of the reach of linear fits; after larger movements the next image would find them stale [ours]
_STALE_PX = 0.5  # movement after which overlap and washer masks, with margins of 2 px and more, are renewed


class TrackLost(Exception):  # noqa: N818 - the track is lost, the image may be a good one
    """Beads cannot be tracked into an image; detect and label it like a first image."""


@dataclass(frozen=True, eq=False)
class Track:
    """State of the tracked beads after one image of a sequence.

    `ids` (L,): the labelled beads, the first L of `rows` (N, COUNT) of `columns`; after them, spots that are not beads
    of the frame. `seen` (L,) bool: visible in this image. `crowded` (L,) bool: fitted only outside overlaps and metal.
    `radius_px` (L,) at the last full detection. `washer` (N,) bool. `fit`: fitter for the usable pixels. `mask` (H, W):
    the field. `written` (H, W) or None: burnt-in annotations. `free` (H, W): pixels usable for crowded beads, of which
    `free_for` have enough, computed when the labelled beads were at `free_at_px` (L, 2).
    `step_px` (N, 2): last movement of each plate's beads; those of the source plate move twice as far. `linear`: fits
    of beads at rest, about an earlier image; none while they move. `shares` (N,): clipped share around each bead.
    `image_shape`: of the images, which are binned `halved` times before tracking, as `detect` does. Everything else is
    in pixels of the binned image.
    """

    frame: Frame
    view: str
    mirrored: bool
    ids: tuple[str, ...]
    rows: np.ndarray
    seen: np.ndarray
    crowded: np.ndarray
    radius_px: np.ndarray
    washer: np.ndarray
    fit: refine.BeadFitter
    mask: np.ndarray
    written: np.ndarray | None
    free: np.ndarray
    free_for: np.ndarray
    free_at_px: np.ndarray
    step_px: np.ndarray
    shares: np.ndarray
    image_shape: tuple[int, int]
    linear: tuple[LinearFits, ...] = ()
    halved: int = 0

    @staticmethod
    def begin(image: Radiograph, beads: Detections, observations: Observations, frame: Frame) -> "Track":
        """Start from a fully detected image; `observations` are the result of `label` or `look_again` for `beads`.

        Raises DetectionRefusedError.
        """
        shape, halved = image.shape, 0
        while is_fine(beads.radius_px, beads.contrast):
            image, beads, observations = image.binned(FACTOR), coarser(beads), coarser_observations(observations)
            halved += 1
        track = Track._begun(bead_fitter(image, beads), image, beads, observations, frame)
        return replace(track, image_shape=shape, halved=halved)

    @staticmethod
    def _begun(
        fit: refine.BeadFitter, image: Radiograph, beads: Detections, observations: Observations, frame: Frame
    ) -> "Track":
        """`begin` with the fitter of an image that needs no binning."""
        row_of = {place: row for row, place in enumerate(map(tuple, beads.uv_px.tolist()))}
        row = np.array([row_of.get(tuple(uv), -1) for uv in observations.uv_px.tolist()], dtype=int)
        radius, contrast = _sizes(beads, observations, row, frame)
        rows, other = rows_with_others(beads, observations.uv_px, radius, contrast)
        kind = np.array(beads.kind, dtype=object)
        washer = np.concatenate([(row >= 0) & (kind[row] == "washer"), kind[other] == "washer"])
        mask, crowded = field_inset(image), row < 0
        fit = fit.within(without_middles(mask, rows[washer, :2], rows[washer, columns.RADIUS]))
        free, free_for = without_overlaps(fit, rows, np.flatnonzero(crowded))
        return Track(
            frame=frame,
            view=observations.view,
            mirrored=observations.mirrored,
            ids=observations.ids,
            rows=rows,
            seen=np.ones(len(row), dtype=bool),
            crowded=crowded,
            radius_px=radius,
            washer=washer,
            fit=fit,
            mask=mask,
            written=image.burnt_in,
            free=free,
            free_for=free_for,
            free_at_px=observations.uv_px,
            step_px=np.zeros((len(rows), 2)),
            shares=np.zeros(len(rows)),
            image_shape=image.shape,
        )

    def follow(self, image: Radiograph) -> tuple["Track", Observations]:
        """Return the next state and observations, each bead fitted from its predicted place. Raises TrackLost."""
        image = self._halved(image)
        fit, linear = self.fit, self.linear
        if median(np.hypot(*(self._expected()[: len(self.ids), :2] - self.free_at_px).T)) > _STALE_PX:
            fit, linear = fit.within(self._usable(self.mask)), ()
        rows, left = self._linear_rows(image, linear)
        if left.all():
            fit = fit.on(logs_of(image, self.mask, self.written))
        elif left.any():
            half = window_reach(rows[left, columns.RADIUS])
            fit = fit.on_parts(logs_within(image, self.mask, fit.log_image, self._expected()[left, :2], half))
        track, fitted = self._fitted(image, fit, rows, left)
        linear = self._about(image, track, fitted) if left.all() else linear
        track = replace(track, linear=linear, fit=track.fit if left.all() else self.fit)
        return track, track.observations

    def look(self, image: Radiograph) -> tuple["Track", Observations]:
        """`follow` with field and noise measured again, and with a search for beads that appeared. Raises TrackLost."""
        image = self._halved(image)
        mask = field_inset(image)
        logs = log_image(image, mask)
        noise = estimate_noise(logs, mask)
        if noise is None:
            raise TrackLost("no part of the image is suitable for measuring its noise")
        fit = refine.BeadFitter(logs, self._usable(mask), noise)
        track, _ = self._fitted(image, fit, self._expected(), np.ones(len(self.rows), dtype=bool))
        beads, alone = track._alone(image)
        try:
            observations = look_again_with(lambda: fit, image, beads, alone, self.frame)
        except ObservationsError as refused:
            raise TrackLost(str(refused)) from None
        renewed = Track._begun(fit, image, beads, observations, self.frame)
        steps = dict(zip(track.ids, track.step_px, strict=False))
        none = np.zeros(2)
        step = np.array(
            [steps.get(name, none) for name in renewed.ids] + [none] * (len(renewed.rows) - len(renewed.ids))
        )
        renewed = replace(renewed, step_px=step, image_shape=self.image_shape, halved=self.halved)
        return renewed, renewed._in_image(observations)

    @property
    def observations(self) -> Observations:
        """The visible beads."""
        rows = self.rows[: len(self.ids)][self.seen]
        seen = Observations(
            view=self.view,
            ids=tuple(i for i, seen in zip(self.ids, self.seen, strict=True) if seen),
            uv_px=rows[:, :2],
            covariance_px2=columns.centre_covariances(rows),
            mirrored=self.mirrored,
            image_shape=self.mask.shape,
            radius_px=rows[:, columns.RADIUS],
        )
        return self._in_image(seen)

    def _in_image(self, seen: Observations) -> Observations:
        """Convert observations in the binned image to the image itself."""
        for _ in range(self.halved):
            seen = finer_observations(seen, self.image_shape)
        return seen

    def _expected(self) -> np.ndarray:
        out = self.rows.copy()
        out[:, :2] += self.step_px
        return out

    def _halved(self, image: Radiograph) -> Radiograph:
        """Return the next image, binned for tracking. Raises TrackLost."""
        if image.shape != self.image_shape:
            raise TrackLost("the images changed their size")
        return image.binned(FACTOR**self.halved) if self.halved else image

    def _linear_rows(self, image: Radiograph, linear: tuple[LinearFits, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows with the linear fits that hold, and (N,) bool: which are left; all once a plate has moved."""
        rows, left = self._expected(), np.ones(len(self.rows), dtype=bool)
        moved = np.zeros((len(rows), 2))
        for fits in linear:
            fitted, holds = fits(image)
            rows[fits.which[holds]], left[fits.which[holds]] = fitted[holds], False
            moved[fits.which] = fitted[:, :2] - fits.fitted[:, :2]
        if not self._are_still(moved, ~left, rows, 1.0):
            return self._expected(), np.ones_like(left)
        return rows, left

    def _are_still(self, moved_px: np.ndarray, good: np.ndarray, rows: np.ndarray, share: float) -> bool:
        """Whether the beads of each plate moved by less than a `share` of the reach of linear fits.

        Half of a plate's beads decide, by the lengths of their movements, since it may rotate about its middle. The
        noise of both images is allowed for. `good` (N,) bool: beads that show it.
        """
        count = len(self.ids)
        near, good = _labelled(self.frame, self.view, self.ids)[0], good[:count]
        for plate in (near & good, ~near & good):
            if plate.any():
                variance = rows[:count][plate][:, [columns.CUU, columns.CVV]].sum(axis=1)
                length2 = median((moved_px[:count][plate] ** 2).sum(axis=1)) - MEDIAN_M2 * median(variance)
                if length2 > (share * median(reach_px(rows[:count][plate]))) ** 2:
                    return False
        return bool(good.any())

    def _about(self, image: Radiograph, track: "Track", fitted: np.ndarray) -> tuple[LinearFits, ...]:
        """Return linear fits about the rows `fitted` in an image, whose state is `track`; none after a movement."""
        if not self._are_still(track.rows[:, :2] - self.rows[:, :2], track.seen, track.rows, _STILL):
            return ()
        rows = self._expected()
        every = (
            LinearFits.about(fit, image, rows, which, fitted[which], mask=self.mask) for fit, which in track._fits()
        )
        return tuple(fits for fits in every if fits.linear.any())

    def _fits(self) -> tuple[tuple[refine.BeadFitter, np.ndarray], ...]:
        """Return the fitter of isolated beads and that of crowded ones, with their rows."""
        alone = np.concatenate([~self.crowded, np.ones(len(self.rows) - len(self.ids), dtype=bool)])
        return (self.fit, np.flatnonzero(alone)), (self.fit.within(self.free), np.flatnonzero(~alone)[self.free_for])

    def _fitted(
        self, image: Radiograph, fit: refine.BeadFitter, out: np.ndarray, left: np.ndarray
    ) -> tuple["Track", np.ndarray]:
        """Return the state after fitting the beads `left` (N,) to an image, and the fits; `out` has the other rows.

        Raises TrackLost.
        """
        rows, count = self._expected(), len(self.ids)
        free, free_for, free_at = self._free(fit, rows)
        track = replace(self, fit=fit, free=free, free_for=free_for, free_at_px=free_at, shares=self.shares.copy())
        out[left, columns.STATUS] = columns.TOO_FEW_PIXELS
        for one, which in track._fits() if left.any() else ():
            out[which[left[which]]] = one(rows, which[left[which]])
        track.shares[left] = clipped_shares(image, fit.usable, out[left])
        fitted = out.copy()
        allow_for_missing_foot(out, track.shares)
        good = fine_reasons(out) == ""
        moved = out[:, :2] - self.rows[:, :2]
        self._refuse_few(good[:count])
        self._refuse_other_sizes(out[:count], good[:count])
        step = self._steps(moved[:count], good[:count])
        off_size = np.abs(np.log(out[:count, columns.RADIUS].clip(1e-3) / self.radius_px)) > _MAX_LOG_SIZE
        good[:count] &= ~off_size & (np.hypot(*(moved - step)[:count].T) < _FROM_OTHERS_PX)
        self._refuse_few(good[:count])
        out[~good] = self.rows[~good]
        out[~good, :2] += step[~good]
        moving = np.hypot(*step.T)[:, None] > _AT_REST_PX
        return replace(track, rows=out, seen=good[:count], step_px=np.where(moving, step, 0.0)), fitted

    def _steps(self, moved_px: np.ndarray, good: np.ndarray) -> np.ndarray:
        """Return the median movement (N, 2) of each plate's beads; zero for spots that are not beads of the frame."""
        near = _labelled(self.frame, self.view, self.ids)[0]
        out = np.zeros((len(self.rows), 2))
        for plate in (near, ~near):
            if (plate & good).any():
                out[: len(near)][plate] = [median(one) for one in moved_px[plate & good].T]
        return out

    def _usable(self, mask: np.ndarray) -> np.ndarray:
        """Return `mask` (H, W) without the middles of washers at their predicted places."""
        washer = self._expected()[self.washer]
        return without_middles(mask, washer[:, :2], washer[:, columns.RADIUS])

    def _free(self, fit: refine.BeadFitter, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return `free`, `free_for` and `free_at_px`, computed again where the usable pixels have changed."""
        if fit.usable is self.fit.usable:
            return self.free, self.free_for, self.free_at_px
        places = rows[: len(self.ids), :2]
        return *without_overlaps(fit, rows, np.flatnonzero(self.crowded)), places

    def _refuse_few(self, good: np.ndarray) -> None:
        """Raises TrackLost."""
        lost = len(good) - int(good.sum())
        if lost > MAX_LOST * len(good):
            raise TrackLost(f"{lost} of {len(good)} beads are not where they were")

    def _refuse_other_sizes(self, rows: np.ndarray, good: np.ndarray) -> None:
        """Raises TrackLost where balls have other sizes than their labels: they have moved by a step of the grid."""
        step = _labelled(self.frame, self.view, self.ids)[1]
        larger = np.log(rows[:, columns.RADIUS].clip(1e-3) / self.radius_px)
        wrong = good & (np.abs(larger) > _HALF_WAY * step)
        if wrong.sum() >= SIZES_WRONG:
            raise TrackLost(f"{wrong.sum()} balls have other sizes than their labels state")

    def _alone(self, image: Radiograph) -> tuple[Detections, Observations]:
        """Return the beads fitted without masks of overlaps, as the results of `detect` and `label`."""
        count = len(self.ids)
        labelled = np.flatnonzero(self.seen & ~self.crowded)
        others = np.arange(count, len(self.rows))
        which = np.concatenate([labelled, others])
        rows = self.rows[which]
        dark = rows[:, columns.CONTRAST] < 0
        beads = Detections(
            uv_px=rows[:, :2],
            radius_px=rows[:, columns.RADIUS],
            covariance_px2=columns.centre_covariances(rows),
            kind=tuple(np.where(self.washer[which], "washer", np.where(dark, "ball", "hole")).tolist()),
            contrast=rows[:, columns.CONTRAST],
            image_shape=image.shape,
        )
        first = slice(0, len(labelled))
        ids = tuple(self.ids[k] for k in labelled)
        seen = Observations(
            self.view,
            ids,
            beads.uv_px[first],
            beads.covariance_px2[first],
            self.mirrored,
            self.mask.shape,
            beads.radius_px[first],
        )
        return beads, seen


@lru_cache(maxsize=8)
def _labelled(frame: Frame, view: str, ids: tuple[str, ...]) -> tuple[np.ndarray, float]:
    """Return which beads are on the XRII plate, (L,) bool, and the smallest step of log radius between their sizes."""
    by_id, xrii = frame.view(view).by_id, set(frame.view(view).xrii.ids)
    sizes = np.unique(np.log([by_id[name].diameter_mm for name in ids]).round(6))
    return np.array([name in xrii for name in ids]), float(np.diff(sizes).min(initial=np.inf))


def _sizes(
    beads: Detections, observations: Observations, row: np.ndarray, frame: Frame
) -> tuple[np.ndarray, np.ndarray]:
    """Return radii and contrasts (L,) of labelled beads; those found by `look_again` take their plate's medians."""
    by_id, xrii = frame.view(observations.view).by_id, set(frame.view(observations.view).xrii.ids)
    diameter = np.array([by_id[name].diameter_mm for name in observations.ids])
    plate = np.array([name in xrii for name in observations.ids])
    radius, contrast = beads.radius_px[row].copy(), beads.contrast[row].copy()
    for k in np.flatnonzero(row < 0):
        alike = (row >= 0) & (plate == plate[k])
        radius[k] = diameter[k] * np.median(radius[alike] / diameter[alike])
        same = alike & (diameter == diameter[k])
        contrast[k] = np.median(contrast[same if same.any() else alike])
    return radius, contrast
