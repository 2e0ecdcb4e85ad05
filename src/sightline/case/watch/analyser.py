"""Analysis of live images: calibration, overlay of the plan, alarm for movement of the frame against the C-arm.

The alarm's limit lies between rest and the promised shift, with equal margins for false and missed alarms. With noise
of standard deviation s per direction, two images in a row falsely exceed a limit z_f s away from rest once an hour, and
both exceed a limit z_d s below the promised shift with a probability of 99 %.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.special import ndtri

from sightline.calibration import BeadView, calibrate
from sightline.calibration.displacement import Displacement, Rest
from sightline.calibration.plates.joint import JointFit
from sightline.common.geometry.covariance import ellipsoid_factor
from sightline.common.threads import one_blas_thread
from sightline.detection import Observations
from sightline.errors import CalibrationRefusedError, OutsideRegionError, RefusedError, UnusableInputError
from sightline.frame import Frame
from sightline.from_images.pipeline import find_beads, label_beads
from sightline.imaging import Radiograph
from sightline.planning.points.curve import Corridor, corridor
from sightline.planning.points.lines_of_sight import LineResiduals
from sightline.planning.points.trajectory import Trajectory

PROMISED_MM = 0.3  # shift at the target that is reported within two images ...
FOUND = 0.99  # ... with this probability
HOUR = 108_000  # images at 30 a second, with one false alarm
IN_A_ROW = 2  # images beyond the limit: a single one may be torn, blurred or badly measured [ours]
_REST_SD = 3.0  # allowance for the error of the rest position, in s.d.: it is constant and does not average out [ours]
BLIND_TO = (
    "The live check sees only the frame. It cannot detect that the bone moves while the frame stays still. "
    "Acquire a check image if in doubt."
)


@dataclass(frozen=True)
class MovementStatus:
    """Shift of the lines of sight at the targets, across the beam, against the images at rest.

    `shift_mm`: the largest of the targets; `sd_mm`: its standard deviation, including that of the rest position;
    `moved`: the alarm, which stays on; `able`: whether the noise is small enough to detect PROMISED_MM; `beads`: the
    number of beads used; `since`: "planning" or "rest"; `text`: for people.
    """

    shift_mm: float
    sd_mm: float
    moved: bool
    able: bool
    beads: int
    since: str
    text: str


def quantiles(targets: int) -> tuple[float, float]:
    """Return z_f and z_d: z_f for the length of a 2D shift at any of `targets`; z_d for one direction, one-sided."""
    falsely, missed = HOUR ** (-1 / IN_A_ROW) / targets, (1 - FOUND) / IN_A_ROW
    return float(np.sqrt(-2 * np.log(falsely))), -float(ndtri(missed))


def limit_mm(targets: int) -> float:
    """Return the shift beyond which an image counts as moved."""
    falsely, missed = quantiles(targets)
    return PROMISED_MM * falsely / (falsely + missed)


class Alarm:
    """Set by the second image in a row beyond the limit; it stays set."""

    def __init__(self, targets: int, since: str) -> None:
        self._limit_mm, self._quantiles, self._since = limit_mm(targets), quantiles(targets), since
        self._beyond = 0
        self._moved = False

    def update(self, displacement: Displacement) -> MovementStatus:
        """Return the status after the next image; leave out images without a displacement."""
        shift, limit = displacement.length_mm, self._limit_mm
        self._beyond = self._beyond + 1 if shift > limit else 0
        self._moved |= self._beyond >= IN_A_ROW
        # Largest s.d. that keeps both margins; an error of the rest position weighs most on the smaller margin.
        max_sd_mm = PROMISED_MM / sum(self._quantiles)
        able = displacement.sd_mm + _REST_SD * displacement.rest_sd_mm / min(self._quantiles) <= max_sd_mm
        sd = float(np.hypot(displacement.sd_mm, displacement.rest_sd_mm))
        return MovementStatus(shift, sd, self._moved, able, displacement.beads, self._since, self._text(shift, able))

    def _text(self, shift_mm: float, able: bool) -> str:
        if self._moved:
            return (
                f"frame or C-arm moved since {self._since}: now {shift_mm:.2f} mm at the target; stop, and find the "
                "cause"
            )
        if not able:
            return f"too noisy to detect {PROMISED_MM:g} mm within two images; raise the dose, or show more beads"
        return f"still to {self._limit_mm:.2f} mm since {self._since}"


STALE_S = 0.2  # an older image may no longer be true: nothing is drawn into it
REST_FRAMES = 16  # their mean is the rest position: the noise of a mean of 16 is a quarter of one image's [ours]
_WITHIN_95 = ellipsoid_factor(0.95, 2)  # applied to the worse direction's s.d., so the bound is conservative
_ORIGIN_MM = np.zeros((1, 3))  # nominal centre of the hip (docs/conventions.md): the target without a plan


class TimedImage(Protocol):
    """An image of a source, and when it was received, s since 1970."""

    @property
    def image(self) -> Radiograph:
        """The image."""
        ...

    @property
    def stamped_s(self) -> float:
        """When it was received, s since 1970."""
        ...


@dataclass(frozen=True, eq=False)
class Watched:
    """The result for the newest image that was analysed.

    `number`: of the images received, from 1; `dropped`: how many of these a newer one replaced before analysis.
    `came_s`: when it was received, by the monotonic clock, which nobody sets. `latency_s`: from then to this result.
    `age_s`, `stale`: at the time of the request; a stale image has no `corridor`. `view` is None where the image gave
    none; `reason` says why. `error_95_mm`: bound of the error of the view's lines of sight at the target, with a
    probability of at least 95 %.
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
    view: BeadView | None
    reason: str
    corridor: Corridor | None
    error_95_mm: float | None
    movement: MovementStatus | None
    note: str

    @property
    def moved(self) -> bool:
        """Whether the alarm is set."""
        return self.movement is not None and self.movement.moved


class LiveAnalyser:
    """Analyses one image after another, without threads: view, overlay, movement."""

    def __init__(self, frame: Frame, trajectory: Trajectory | None, references: Sequence[BeadView]) -> None:
        self._frame, self._trajectory = frame, trajectory
        self._targets = _ORIGIN_MM if trajectory is None else np.stack([trajectory.entry_mm, trajectory.end_mm])
        self._inverted = False  # whether the last image showed the balls bright
        self._rest: dict[str, tuple[Rest, Alarm]] = {}
        self._settling: list[Observations] = []
        for view in references:
            self._rest[view.name] = Rest.of(view, frame, [_beads_of(view)], self._targets), self._alarm("planning")

    def rest(self) -> None:
        """Forget the rest positions; the next images define new ones."""
        self._rest.clear()
        self._settling.clear()

    @one_blas_thread
    def look(self, shown: TimedImage, came_s: float, number: int, dropped: int) -> Watched:
        """Analyse an image received at `came_s` by the monotonic clock, or earlier if its own stamp says so."""
        view: BeadView | None = None
        movement: MovementStatus | None = None
        reason, note = "", "no view: a movement would not be seen"
        try:
            view, seen = self._calibrated(shown.image)
        except RefusedError as refused:
            reason = str(refused)
        else:
            movement, note = self._movement(view, seen)
        drawn, error = self._overlay(view)
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
            view=view,
            reason=reason,
            corridor=drawn,
            error_95_mm=error,
            movement=movement,
            note=note,
        )

    def _calibrated(self, image: Radiograph) -> tuple[BeadView, Observations]:
        """Return the view of an image and the beads that it was calibrated from. Raises RefusedError."""
        # Detection inverts an image that shows the balls bright, and then runs twice: begin as with the last image.
        upright, beads = find_beads(image.inverted() if self._inverted else image)
        self._inverted = upright.is_inverted != image.is_inverted
        seen = label_beads(upright, beads, self._frame, live=True)
        return calibrate(seen, self._frame), seen

    def _movement(self, view: BeadView, seen: Observations) -> tuple[MovementStatus | None, str]:
        if view.name not in self._rest:
            return None, self._settle(view, seen)
        rest, alarm = self._rest[view.name]
        try:
            return alarm.update(rest.displacement(seen)), ""
        except CalibrationRefusedError as error:
            return None, str(error)

    def _settle(self, view: BeadView, seen: Observations) -> str:
        """Collect images; once there are REST_FRAMES without movement, they define the rest position. Return a note."""
        if self._settling and self._settling[0].view != view.name:
            self._settling.clear()
        self._settling.append(seen)
        if len(self._settling) < REST_FRAMES:
            return f"finding the rest position, {len(self._settling)} of {REST_FRAMES} images"
        rest, alarm = Rest.of(view, self._frame, self._settling, self._targets), self._alarm("rest")
        try:
            moving = any(alarm.update(rest.displacement(seen)).moved for seen in self._settling)
        except CalibrationRefusedError as error:
            moving, why = True, str(error)
        else:
            why = "it moves: hold still"
        self._settling.clear()
        if moving:
            return f"no rest position was found: {why}"
        self._rest[view.name] = rest, alarm
        return "at rest"

    def _alarm(self, since: str) -> Alarm:
        return Alarm(len(self._targets), since)

    def _overlay(self, view: BeadView | None) -> tuple[Corridor | None, float | None]:
        """Return the plan in the view, and the 95 % bound of its lines of sight at the target; None for what is outside
        the view."""
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
    """Return the result with its age at `now_s`, by the monotonic clock; a stale image has no overlay."""
    age = now_s - watched.came_s
    stale = age > STALE_S
    return replace(watched, age_s=age, stale=stale, corridor=None if stale else watched.corridor)


def _beads_of(view: BeadView) -> Observations:
    """Return the beads that a view was calibrated from. Raises UnusableInputError if the method is not smooth."""
    fit = view.posterior
    if not isinstance(fit, JointFit):
        raise UnusableInputError("movement is measured against views of the smooth method; calibrate with 'smooth'")
    return Observations(view.name, fit.beads.ids, fit.beads.uv_px, fit.beads.covariance_px2)
