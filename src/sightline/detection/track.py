"""Beads of a sequence of images: where they were in the last image says where they are in the next one.

No candidate is looked for and nothing is labelled anew: each bead is fitted from its last centre, radius and contrast,
with the noise of the last whole look. What a label rests on, the sizes of the balls, is compared all the time.
"""

from dataclasses import dataclass, replace

import numpy as np

from sightline.detection import columns, refine
from sightline.detection.again import look_again_with, without_overlaps
from sightline.detection.detector import fine_reasons, fit_of, without_middles
from sightline.detection.log_image import field_inset, log_image, logs_of
from sightline.detection.noise import estimate_noise
from sightline.detection.results import Detections, Observations
from sightline.detection.scale import FACTOR, coarser, coarser_observations, finer_observations, is_fine
from sightline.errors import ObservationsError
from sightline.frame import Frame
from sightline.imaging import Radiograph

MOST_LOST = 0.25  # share of the beads of the last whole look; more is no instrument in the beam [ours]
SIZES_WRONG = 3  # balls whose size is nearer to that of the frame's other balls; labelling allows two [ours]
_HALF_WAY = 0.5  # of the step of log radius between two sizes of ball
_OTHER_SIZE = 0.15  # log radius; a right bead's changes by 0.03 from image to image [twin], the datum's step is 0.51
_FROM_OTHERS_PX = 3.0  # from where the others' movement puts it; a bead that went elsewhere is none [ours]
_AT_REST_PX = 0.3  # movement of a plate's beads below which the next image is not expected to move on [ours]
_STALE_PX = 0.5  # movement after which overlaps and middles are looked at anew; they have margins of 2 px and more


class TrackLost(Exception):  # noqa: N818 - the sequence is lost, the image may be a good one
    """Why beads cannot be followed into an image: it must be looked at as if it were the first."""


@dataclass(frozen=True, eq=False)
class Track:
    """What an image of a sequence leaves for the next.

    `ids` (L,): the labelled beads, the first L of `rows` (N, COUNT) of `columns`; after them spots that are no bead of
    the frame. `seen` (L,) bool: in this image. `crowded` (L,) bool: fitted only where others and metal leave it free.
    `radius_px` (L,) at the last whole look. `mask` (H, W): the field; `written` (H, W) or None: letters. `washer` (N,)
    bool. `fit`: to what counts of the field, `free` (H, W): what of that counts for crowded beads, since the labelled
    ones were at `free_at_px` (L, 2).
    `step_px` (N, 2): how the beads of each plate moved last: the source plate's move twice as far as the other's.
    `image_shape`: of the images. Fine ones are `halved` so many times before beads are followed, as `detect` does: all
    else here is in pixels of the halved image.
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
    image_shape: tuple[int, int]
    halved: int = 0

    @staticmethod
    def begin(image: Radiograph, beads: Detections, observations: Observations, frame: Frame) -> "Track":
        """From an image that was looked at whole: `observations` are what `label` or `look_again` made of `beads`.

        Raises DetectionRefusedError.
        """
        shape, halved = image.shape, 0
        while is_fine(beads.radius_px):
            image, beads, observations = image.binned(FACTOR), coarser(beads), coarser_observations(observations)
            halved += 1
        track = Track._begun(fit_of(image, beads), image, beads, observations, frame)
        return replace(track, image_shape=shape, halved=halved)

    @staticmethod
    def _begun(
        fit: refine.BeadFitter, image: Radiograph, beads: Detections, observations: Observations, frame: Frame
    ) -> "Track":
        """`begin` with the fit of an image that needs no halving."""
        row_of = {place: row for row, place in enumerate(map(tuple, beads.uv_px.tolist()))}
        row = np.array([row_of.get(tuple(uv), -1) for uv in observations.uv_px.tolist()], dtype=int)
        radius, contrast = _sizes(beads, observations, row, frame)
        apart = np.hypot(*(beads.uv_px[:, None, k] - observations.uv_px[:, k] for k in range(2)))
        other = (apart > np.maximum(beads.radius_px[:, None], radius)).all(axis=1)
        rows = refine.start(
            np.concatenate([observations.uv_px, beads.uv_px[other]]),
            np.concatenate([radius, beads.radius_px[other]]),
            np.concatenate([contrast, beads.contrast[other]]),
        )
        kind = np.array(beads.kind, dtype=object)
        washer = np.concatenate([(row >= 0) & (kind[row] == "washer"), kind[other] == "washer"])
        mask, crowded = field_inset(image), row < 0
        fit = fit.within(without_middles(mask, rows[washer, :2], rows[washer, columns.RADIUS]))
        free, free_for = without_overlaps(image, fit, rows, np.flatnonzero(crowded))
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
            image_shape=image.shape,
        )

    def follow(self, image: Radiograph) -> tuple["Track", Observations]:
        """The beads of the next image, each fitted from where it was. Raises TrackLost."""
        image = self._halved(image)
        fit = self.fit.on(logs_of(image, self.mask, self.written))
        moved = np.hypot(*(self._expected()[: len(self.ids), :2] - self.free_at_px).T)
        if np.median(moved) > _STALE_PX:
            fit = fit.within(self._usable(self.mask))
        track = self._fitted(image, fit)
        return track, track.observations

    def look(self, image: Radiograph) -> tuple["Track", Observations]:
        """`follow`, with field and noise measured anew, and beads looked for that came into sight. Raises TrackLost."""
        image = self._halved(image)
        mask = field_inset(image)
        logs = log_image(image, mask)
        noise = estimate_noise(logs, mask)
        if noise is None:
            raise TrackLost("no part of the image is left to measure its noise in")
        fit = refine.BeadFitter(logs, self._usable(mask), noise)
        track = self._fitted(image, fit)
        beads, alone = track._alone(image)
        try:
            observations = look_again_with(lambda: fit, image, beads, alone, self.frame)
        except ObservationsError as refused:
            raise TrackLost(str(refused)) from None
        anew = Track._begun(fit, image, beads, observations, self.frame)
        steps = dict(zip(track.ids, track.step_px, strict=False))
        none = np.zeros(2)
        step = np.array([steps.get(name, none) for name in anew.ids] + [none] * (len(anew.rows) - len(anew.ids)))
        anew = replace(anew, step_px=step, image_shape=self.image_shape, halved=self.halved)
        return anew, anew._in_image(observations)

    @property
    def observations(self) -> Observations:
        """The beads that are seen."""
        rows = self.rows[: len(self.ids)][self.seen]
        seen = Observations(
            view=self.view,
            ids=tuple(i for i, seen in zip(self.ids, self.seen, strict=True) if seen),
            uv_px=rows[:, :2],
            covariance_px2=_covariance(rows),
            mirrored=self.mirrored,
            image_shape=self.mask.shape,
        )
        return self._in_image(seen)

    def _in_image(self, seen: Observations) -> Observations:
        """Observations in the halved image as those in the image itself."""
        for _ in range(self.halved):
            seen = finer_observations(seen, self.image_shape)
        return seen

    def _expected(self) -> np.ndarray:
        out = self.rows.copy()
        out[:, :2] += self.step_px
        return out

    def _halved(self, image: Radiograph) -> Radiograph:
        """The next image as beads are followed in it. Raises TrackLost."""
        if image.shape != self.image_shape:
            raise TrackLost("the images changed their size")
        return image.binned(FACTOR**self.halved) if self.halved else image

    def _fitted(self, image: Radiograph, fit: refine.BeadFitter) -> "Track":
        """Every bead where this image has it. Raises TrackLost."""
        rows, count = self._expected(), len(self.ids)
        free, free_for, free_at = self._free(image, fit, rows)
        crowded = np.flatnonzero(self.crowded)
        alone = np.setdiff1d(np.arange(len(rows)), crowded)
        out = rows.copy()
        out[crowded, columns.STATUS] = columns.TOO_FEW_PIXELS
        out[alone] = fit(rows, alone)
        out[crowded[free_for]] = fit.within(free)(rows, crowded[free_for])
        good = fine_reasons(out) == ""
        moved = out[:, :2] - self.rows[:, :2]
        self._refuse_few(good[:count])
        self._refuse_other_sizes(out[:count], good[:count])
        step = self._steps(moved[:count], good[:count])
        off_size = np.abs(np.log(out[:count, columns.RADIUS].clip(1e-3) / self.radius_px)) > _OTHER_SIZE
        good[:count] &= ~off_size & (np.hypot(*(moved - step)[:count].T) < _FROM_OTHERS_PX)
        self._refuse_few(good[:count])
        out[~good] = self.rows[~good]
        out[~good, :2] += step[~good]
        moving = np.hypot(*step.T)[:, None] > _AT_REST_PX
        return replace(
            self,
            rows=out,
            seen=good[:count],
            fit=fit,
            free=free,
            free_for=free_for,
            free_at_px=free_at,
            step_px=np.where(moving, step, 0.0),
        )

    def _steps(self, moved_px: np.ndarray, good: np.ndarray) -> np.ndarray:
        """(N, 2): the median movement of each plate's beads; none of what is no bead of the frame."""
        xrii = set(self.frame.view(self.view).xrii.ids)
        near = np.array([name in xrii for name in self.ids])
        out = np.zeros((len(self.rows), 2))
        for plate in (near, ~near):
            if (plate & good).any():
                out[: len(near)][plate] = np.median(moved_px[plate & good], axis=0)
        return out

    def _usable(self, mask: np.ndarray) -> np.ndarray:
        """`mask` (H, W) without the middles of washers, where these are expected."""
        washer = self._expected()[self.washer]
        return without_middles(mask, washer[:, :2], washer[:, columns.RADIUS])

    def _free(
        self, image: Radiograph, fit: refine.BeadFitter, rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`free`, `free_for` and `free_at_px`, looked at anew where other pixels count than before."""
        if fit.usable is self.fit.usable:
            return self.free, self.free_for, self.free_at_px
        places = rows[: len(self.ids), :2]
        return *without_overlaps(image, fit, rows, np.flatnonzero(self.crowded)), places

    def _refuse_few(self, good: np.ndarray) -> None:
        """Raises TrackLost."""
        lost = len(good) - int(good.sum())
        if lost > MOST_LOST * len(good):
            raise TrackLost(f"{lost} of {len(good)} beads are not where they were")

    def _refuse_other_sizes(self, rows: np.ndarray, good: np.ndarray) -> None:
        """Raises TrackLost: beads that moved by a step of their grid lie where others were, and have their sizes."""
        by_id = self.frame.view(self.view).by_id
        log_mm = np.log([by_id[name].diameter_mm for name in self.ids])
        sizes = np.unique(log_mm.round(6))
        if len(sizes) < 2:
            return
        larger = np.log(rows[:, columns.RADIUS].clip(1e-3) / self.radius_px)
        wrong = good & (np.abs(larger) > _HALF_WAY * np.diff(sizes).min())
        if wrong.sum() >= SIZES_WRONG:
            raise TrackLost(f"{wrong.sum()} balls have another size than their labels say")

    def _alone(self, image: Radiograph) -> tuple[Detections, Observations]:
        """What was fitted by itself in this image, as detection and labelling would hand it on."""
        count = len(self.ids)
        labelled = np.flatnonzero(self.seen & ~self.crowded)
        others = np.arange(count, len(self.rows))
        which = np.concatenate([labelled, others])
        rows = self.rows[which]
        dark = rows[:, columns.CONTRAST] < 0
        beads = Detections(
            uv_px=rows[:, :2],
            radius_px=rows[:, columns.RADIUS],
            covariance_px2=_covariance(rows),
            kind=tuple(np.where(self.washer[which], "washer", np.where(dark, "ball", "hole")).tolist()),
            contrast=rows[:, columns.CONTRAST],
            image_shape=image.shape,
        )
        first = slice(0, len(labelled))
        ids = tuple(self.ids[k] for k in labelled)
        seen = Observations(
            self.view, ids, beads.uv_px[first], beads.covariance_px2[first], self.mirrored, self.mask.shape
        )
        return beads, seen


def _sizes(
    beads: Detections, observations: Observations, row: np.ndarray, frame: Frame
) -> tuple[np.ndarray, np.ndarray]:
    """(L,) radii and contrasts of labelled beads; what `look_again` found has those of its plate's balls."""
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


def _covariance(rows: np.ndarray) -> np.ndarray:
    """(N, 2, 2) px²."""
    return rows[:, [columns.CUU, columns.CUV, columns.CUV, columns.CVV]].reshape(-1, 2, 2)
