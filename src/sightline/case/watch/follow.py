"""Image after image to calibrated views: from the last one's result where that holds, anew where it does not."""

from dataclasses import dataclass
from enum import StrEnum

from sightline.calibration import BeadView, calibrate
from sightline.calibration.retrack import recalibrate
from sightline.checks import failed
from sightline.detection import Observations
from sightline.detection.track import Track, TrackLost
from sightline.errors import RefusedError
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.pipeline import find_beads, label_beads

LOOK_EVERY = 15  # images, half a second: field, noise, and beads that came into sight [ours]
SEARCH_S = 3.0  # after which the prior of the map is learnt anew [ours]


class State(StrEnum):
    """How a view was found: from the last image's, as if the image were the first, or not at all."""

    TRACKING = "tracking"
    SEARCHING = "searching"
    LOST = "lost"


@dataclass(frozen=True, eq=False)
class Followed:
    """One image's `view` and beads, None where `state` is lost; `reason`: why it was not simply tracked."""

    state: State
    reason: str
    view: BeadView | None = None
    observations: Observations | None = None


class Follower:
    """Keeps what one image leaves for the next. A view that changes, or beads that jump, are searched for and said."""

    def __init__(self, frame: Frame) -> None:
        self._frame = frame
        self._track: Track | None = None
        self._view: BeadView | None = None
        self._since_look = 0
        self._searched_s = 0.0
        self._inverted = False
        self._why = "the first image"

    def take(self, image: Radiograph, at_s: float) -> Followed:
        """The view of the next image, which came at `at_s`."""
        try:
            if self._track is None or self._view is None:
                return self._anew(image, at_s, self._why)
            try:
                return self._on(image, at_s, self._track, self._view)
            except (TrackLost, RefusedError) as why:
                return self._anew(image, at_s, str(why))
        except RefusedError as refused:
            self._track = self._view = None
            self._why = str(refused)
            return Followed(State.LOST, self._why)

    def _on(self, image: Radiograph, at_s: float, track: Track, last: BeadView) -> Followed:
        """From the last image. Raises TrackLost, RefusedError."""
        image = image.inverted() if self._inverted else image
        due = self._since_look + 1 >= LOOK_EVERY
        track, seen = track.look(image) if due else track.follow(image)
        learn = at_s - self._searched_s >= SEARCH_S
        view = calibrate(seen, self._frame) if learn else recalibrate(seen, self._frame, last)
        news = {check.name for check in failed(view.checks)} - {check.name for check in failed(last.checks)}
        if news:
            raise TrackLost(f"a check failed that had passed: {', '.join(sorted(news))}")
        self._since_look = 0 if due else self._since_look + 1
        self._searched_s = at_s if learn else self._searched_s
        self._track, self._view = track, view
        return Followed(State.TRACKING, "", view, seen)

    def _anew(self, image: Radiograph, at_s: float, why: str) -> Followed:
        """As if it were the first image. Raises RefusedError."""
        image, beads = find_beads(image)
        self._inverted = image.is_inverted
        seen = label_beads(image, beads, self._frame)
        view = calibrate(seen, self._frame)
        self._track, self._view = Track.begin(image, beads, seen, self._frame), view
        self._since_look, self._searched_s = 0, at_s
        return Followed(State.SEARCHING, why, view, seen)
