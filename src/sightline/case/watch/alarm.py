"""Whether frame and C-arm have moved against each other, told from the lines of sight of a target.

The limit lies between rest and the shift that is promised to be found, so that both errors have the same room: with
noise of standard deviation s per direction, two images in a row exceed it falsely once in an hour where it is z_f s
away from rest, and both exceed it with 99 % where it is z_d s below the promised shift.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from sightline.calibration.displacement import Displacement

PROMISED_MM = 0.3  # shift at the target that is reported within two images ...
FOUND = 0.99  # ... with this probability
HOUR = 108_000  # images, 30 a second: in so many one false alarm
IN_A_ROW = 2  # images beyond the limit: one alone may be torn, blurred or badly measured [ours]
_REST_SD = 3.0  # how far off the place of rest itself may be: it stays the same, and does not average out [ours]
BLIND_TO = "a bone that moves against a still frame moves no bead: this cannot see it; take a check image"


@dataclass(frozen=True)
class Movement:
    """Of the lines of sight at the targets, across the beam, against the images at rest.

    `shift_mm`: the largest of the targets; `sd_mm`: of it, the image at rest included; `moved`: the alarm, which stays;
    `able`: whether the noise is small enough for what is promised; `beads`: how many it rests on. `since`: "planning"
    or "rest"; `text` for people.
    """

    shift_mm: float
    sd_mm: float
    moved: bool
    able: bool
    beads: int
    since: str
    text: str


def quantiles(targets: int) -> tuple[float, float]:
    """z_f and z_d: of the length of two numbers, any of `targets` of them; of one number, in one direction."""
    falsely, missed = HOUR ** (-1 / IN_A_ROW) / targets, (1 - FOUND) / IN_A_ROW
    return float(np.sqrt(-2 * np.log(falsely))), -float(ndtri(missed))


def limit_mm(targets: int) -> float:
    """The shift beyond which an image counts as moved."""
    falsely, missed = quantiles(targets)
    return PROMISED_MM * falsely / (falsely + missed)


class Alarm:
    """Goes on with the second image in a row beyond the limit, and stays on."""

    def __init__(self, targets: int, since: str) -> None:
        self._limit_mm, self._quantiles, self._since = limit_mm(targets), quantiles(targets), since
        self._beyond = 0
        self._moved = False

    def take(self, displacement: Displacement) -> Movement:
        """The next image's; images that tell nothing are left out."""
        shift, limit = displacement.length_mm, self._limit_mm
        self._beyond = self._beyond + 1 if shift > limit else 0
        self._moved |= self._beyond >= IN_A_ROW
        # Both errors have the room of `room` standard deviations; the place of rest takes from the smaller one most.
        room = PROMISED_MM / sum(self._quantiles)
        able = displacement.sd_mm + _REST_SD * displacement.rest_sd_mm / min(self._quantiles) <= room
        sd = float(np.hypot(displacement.sd_mm, displacement.rest_sd_mm))
        return Movement(shift, sd, self._moved, able, displacement.beads, self._since, self._text(shift, able))

    def _text(self, shift_mm: float, able: bool) -> str:
        if self._moved:
            return (
                f"frame or C-arm moved since {self._since}: now {shift_mm:.2f} mm at the target; stop, and see what did"
            )
        if not able:
            return f"too noisy to tell {PROMISED_MM:g} mm within two images; raise the dose, or show more beads"
        return f"still to {self._limit_mm:.2f} mm since {self._since}"
