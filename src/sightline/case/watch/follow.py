"""Calibrated views of successive images: tracked from the previous image, or searched anew where tracking fails."""

from dataclasses import dataclass
from enum import StrEnum

from sightline.calibration import BeadView, calibrate
from sightline.calibration.retrack import recalibrate
from sightline.checks import failed
from sightline.detection import Observations
from sightline.detection.track import Track, TrackLost
from sightline.errors import RefusedError
from sightline.frame import Frame
from sightline.from_images.pipeline import find_beads, label_beads
from sightline.imaging import Radiograph
from sightline.threads import one_blas_thread

REFRESH_EVERY_S = 0.5  # between updates of the field of view, the noise and new beads [ours]
LEARN_EVERY_S = 3.0  # between full calibrations, which estimate the map's prior again [ours]


class TrackingState(StrEnum):
    """How a view was found: tracked from the previous image, searched as in a first image, or not at all."""

    TRACKING = "tracking"
    SEARCHING = "searching"
    LOST = "lost"


@dataclass(frozen=True, eq=False)
class Followed:
    """The `view` and beads of one image; None if the `state` is lost. `reason`: why it was not tracked."""

    state: TrackingState
    reason: str
    view: BeadView | None = None
    observations: Observations | None = None


class Follower:
    """Follows the beads from image to image. If the view changes or beads jump, it searches anew and says why."""

    def __init__(self, frame: Frame) -> None:
        self._frame = frame
        self._track: Track | None = None
        self._view: BeadView | None = None
        self._refreshed_s = self._learnt_s = 0.0
        self._inverted = False
        self._why = "the first image"

    @one_blas_thread
    def update(self, image: Radiograph, at_s: float) -> Followed:
        """Return the view of the next image, received at `at_s`."""
        try:
            if self._track is None or self._view is None:
                return self._search(image, at_s, self._why)
            try:
                return self._follow(image, at_s, self._track, self._view)
            except (TrackLost, RefusedError) as why:
                return self._search(image, at_s, str(why))
        except RefusedError as refused:
            self._track = self._view = None
            self._why = str(refused)
            return Followed(TrackingState.LOST, self._why)

    def _follow(self, image: Radiograph, at_s: float, track: Track, last: BeadView) -> Followed:
        """Track the beads from the previous image. Raises TrackLost, RefusedError."""
        image = image.inverted() if self._inverted else image
        due = at_s - self._refreshed_s >= REFRESH_EVERY_S
        track, seen = track.look(image) if due else track.follow(image)
        learn = at_s - self._learnt_s >= LEARN_EVERY_S
        view = calibrate(seen, self._frame) if learn else recalibrate(seen, self._frame, last)
        news = {check.name for check in failed(view.checks)} - {check.name for check in failed(last.checks)}
        if news:
            raise TrackLost(f"a check failed that had passed: {', '.join(sorted(news))}")
        self._refreshed_s = at_s if due else self._refreshed_s
        self._learnt_s = at_s if learn else self._learnt_s
        self._track, self._view = track, view
        return Followed(TrackingState.TRACKING, "", view, seen)

    def _search(self, image: Radiograph, at_s: float, why: str) -> Followed:
        """Search the beads as in a first image. Raises RefusedError."""
        image, beads = find_beads(image)
        self._inverted = image.is_inverted
        seen = label_beads(image, beads, self._frame)
        view = calibrate(seen, self._frame)
        self._track, self._view = Track.begin(image, beads, seen, self._frame), view
        self._refreshed_s = self._learnt_s = at_s
        return Followed(TrackingState.SEARCHING, why, view, seen)
