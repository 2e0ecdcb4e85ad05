"""Alarm for movement of the calibration frame against the C-arm, from the lines of sight of a target.

The limit lies between rest and the promised shift, with equal margins for false and missed alarms. With noise of
standard deviation s per direction, two images in a row falsely exceed a limit z_f s away from rest once an hour, and
both exceed a limit z_d s below the promised shift with a probability of 99 %.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from sightline.calibration.displacement import Displacement

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
