"""One live image after another: calibrated, with the plan drawn into it and movements told."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sightline.calibration import BeadView
from sightline.calibration.displacement import Rest
from sightline.calibration.joint import JointFit
from sightline.case.watch.alarm import Alarm, Movement
from sightline.case.watch.follow import Followed, Follower, State
from sightline.detection import Observations
from sightline.errors import CalibrationRefusedError, OutsideRegionError, UnusableInputError
from sightline.frame import Frame
from sightline.geometry.covariance import ellipsoid_factor
from sightline.imaging import Radiograph
from sightline.planning.corridor import Corridor, corridor
from sightline.planning.line_residuals import LineResiduals
from sightline.planning.trajectory import Trajectory

STALE_S = 0.2  # an older image is not what is: nothing is drawn into it
REST_FRAMES = 16  # half a second: their mean is where the beads are at rest [ours]
_WITHIN_95 = ellipsoid_factor(0.95, 2)  # standard deviations of the worse direction: a bound on the safe side
_ORIGIN_MM = np.zeros((1, 3))  # where the hip's centre should lie (docs/conventions.md): the target without a plan


class Shown(Protocol):
    """A frame of a source: its image, and when it came, s since 1970."""

    @property
    def image(self) -> Radiograph:
        """The image."""
        ...

    @property
    def stamped_s(self) -> float:
        """When it came."""
        ...


@dataclass(frozen=True, eq=False)
class Watched:
    """What is known of the newest frame that was worked on.

    `number`: of the frames that came, from 1; `dropped`: of these, replaced by a newer one before they were worked on.
    `came_s`: when it came, by the monotonic clock, which nobody sets. `latency_s`: from then to when this was known.
    `age_s` and `stale`: when asked; of a stale image there is no `corridor`. `error_95_mm`: at the target the view's
    lines of sight err by less, with 95 % or more.
    `movement` is None while there is nothing to compare with; `note` says why.
    """

    image: Radiograph
    number: int
    dropped: int
    stamped_s: float
    came_s: float
    latency_s: float
    age_s: float
    stale: bool
    state: State
    reason: str
    view: BeadView | None
    corridor: Corridor | None
    error_95_mm: float | None
    movement: Movement | None
    note: str

    @property
    def moved(self) -> bool:
        """The alarm."""
        return self.movement is not None and self.movement.moved


class Eye:
    """What `Watch` does with one frame after the other, without threads: view, overlay, movement."""

    def __init__(self, frame: Frame, trajectory: Trajectory | None, references: Sequence[BeadView]) -> None:
        self._frame, self._trajectory = frame, trajectory
        self._targets = _ORIGIN_MM if trajectory is None else np.stack([trajectory.entry_mm, trajectory.end_mm])
        self._follower = Follower(frame)
        self._still: dict[str, tuple[Rest, Alarm]] = {}
        self._settling: list[Observations] = []
        for view in references:
            self._still[view.name] = Rest.of(view, frame, [_beads_of(view)], self._targets), self._alarm("planning")

    def rest(self) -> None:
        """Where all is now is where it is at rest: the next frames say where that is."""
        self._still.clear()
        self._settling.clear()

    def look(self, shown: Shown, came_s: float, number: int, dropped: int) -> Watched:
        """One frame, which came at `came_s` by the monotonic clock, or earlier as it says itself."""
        followed = self._follower.take(shown.image, shown.stamped_s)
        movement, note = self._movement(followed)
        drawn, error = self._drawn(followed.view)
        now_s = time.monotonic()
        latency = max(now_s - came_s, time.time() - shown.stamped_s)
        return Watched(
            image=shown.image,
            number=number,
            dropped=dropped,
            stamped_s=shown.stamped_s,
            came_s=now_s - latency,
            latency_s=latency,
            age_s=latency,
            stale=latency > STALE_S,
            state=followed.state,
            reason=followed.reason,
            view=followed.view,
            corridor=drawn,
            error_95_mm=error,
            movement=movement,
            note=note,
        )

    def _movement(self, followed: Followed) -> tuple[Movement | None, str]:
        view, seen = followed.view, followed.observations
        if view is None or seen is None:
            return None, "no view: a movement would not be seen"
        if view.name not in self._still:
            return None, self._settle(view, seen)
        rest, alarm = self._still[view.name]
        try:
            return alarm.take(rest.displacement(seen)), ""
        except CalibrationRefusedError as few:
            return None, str(few)

    def _settle(self, view: BeadView, seen: Observations) -> str:
        """Collect frames of rest; they are the reference once enough of them show none that moved."""
        if self._settling and self._settling[0].view != view.name:
            self._settling.clear()
        self._settling.append(seen)
        if len(self._settling) < REST_FRAMES:
            return f"finding the place of rest, {len(self._settling)} of {REST_FRAMES} images"
        rest, alarm = Rest.of(view, self._frame, self._settling, self._targets), self._alarm("rest")
        try:
            moving = any(alarm.take(rest.displacement(one)).moved for one in self._settling)
        except CalibrationRefusedError as few:
            moving, why = True, str(few)
        else:
            why = "it moves: hold still"
        self._settling.clear()
        if moving:
            return f"no place of rest was found: {why}"
        self._still[view.name] = rest, alarm
        return "at rest"

    def _alarm(self, since: str) -> Alarm:
        return Alarm(len(self._targets), since)

    def _drawn(self, view: BeadView | None) -> tuple[Corridor | None, float | None]:
        """The plan in the view, and how far its lines of sight may be off at the target; None where it sees neither."""
        if view is None:
            return None, None
        try:
            lines = view.lines_of_sight(view.project(self._targets))
        except OutsideRegionError:
            return None, None
        at = LineResiduals.at(lines, self._targets)
        whole = np.sum(list((lines.covariance or {}).values()), axis=0)
        own = np.einsum("iaib->iab", (at.to_line @ whole @ at.to_line.T).reshape(len(at.reach), 2, -1, 2))
        error = _WITHIN_95 * float((at.reach * np.sqrt(np.linalg.eigvalsh(own)[:, -1])).max())
        if self._trajectory is None:
            return None, error
        try:
            return corridor(view, self._trajectory), error
        except OutsideRegionError:
            return None, error


def aged(watched: Watched, now_s: float) -> Watched:
    """The same as it is at `now_s`, by the monotonic clock: a stale image has no overlay."""
    age = now_s - watched.came_s
    stale = age > STALE_S
    return replace(watched, age_s=age, stale=stale, corridor=None if stale else watched.corridor)


def _beads_of(view: BeadView) -> Observations:
    """The beads that a view was calibrated from. Raises UnusableInputError."""
    fit = view.posterior
    if not isinstance(fit, JointFit):
        raise UnusableInputError("movements are told against views of the smooth method; calibrate with 'smooth'")
    return Observations(view.name, fit.beads.ids, fit.beads.uv_px, fit.beads.covariance_px2)
