"""Self-calibration of a solid: its balls measured by its own images on a flat panel, and one known distance.

The images show the solid's shape, not its size: a larger one farther away looks alike. One distance between two balls,
measured with a calliper, gives the size. Nor do they show where CFCS lies; it is put where the balls fit the file best.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sightline.calibration.lengths import CArm
from sightline.calibration.plates.self_check import MIN_IMAGES, measured_frame
from sightline.calibration.solids.adjustment import SolidAdjustment
from sightline.calibration.solids.calibrate_together import adjustment_of, calibrate_together
from sightline.common.checks import Check, at_most
from sightline.common.geometry.rigid import displacement
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, UnusableInputError
from sightline.frame import Frame

MAX_SD_MM = 0.05  # [ours] rms over all coordinates: causes 0.07 mm at a target beside block60 (docs/benchmarks.md)


@dataclass(frozen=True)
class KnownDistance:
    """A measured distance between the centres of two balls, mm, with its standard deviation."""

    first: str
    second: str
    mm: float
    sd_mm: float

    def __post_init__(self) -> None:
        if self.first == self.second or not (0 < self.mm < np.inf and 0 < self.sd_mm < np.inf):
            raise UnusableInputError("a distance needs two different balls, a length and its s.d. above zero, in mm")


@dataclass(frozen=True, eq=False)
class SolidSelfCheck:
    """A solid as its images show it: `frame` with the full covariance of its M balls.

    `moved_mm` (M, 3): against the file; `sd_mm` (M, 3); `images` (M,): in how many images each ball was used.
    """

    frame: Frame
    moved_mm: np.ndarray
    sd_mm: np.ndarray
    images: np.ndarray
    checks: tuple[Check, ...]


def self_check_solid(
    observations: Sequence[Observations],
    frame: Frame,
    distance: KnownDistance,
    c_arms: Sequence[CArm | None] | None = None,
) -> SolidSelfCheck:
    """Return the balls of a solid, estimated from 4 images or more from different directions.

    `frame`: its file, whose tolerances say how far the balls may be from it. Arguments else as of `calibrate_together`.
    Raises UnusableInputError, FrameError, and what `calibrate_together` raises.
    """
    frame.refuse_plate("measure the solid alone, by images of a flat panel")
    if len(observations) < MIN_IMAGES:
        raise CalibrationRefusedError(
            f"{len(observations)} images were given; give {MIN_IMAGES} or more of the solid from different directions"
        )
    views = calibrate_together(observations, _with_distance(frame, distance), c_arms)
    fit = adjustment_of(views[0])
    moved, covariance = _at_best_fit(frame, fit)
    seen = np.concatenate([image.rows for image in fit.images])
    sd = np.sqrt(np.diag(covariance)).reshape(-1, 3)
    named = {check.name: check for view in views for check in view.checks if not check.passed}
    shared = [check for check in views[0].checks if check.name == "chi-square" and check.passed]
    return SolidSelfCheck(
        frame=measured_frame(frame, moved, covariance),
        moved_mm=moved,
        sd_mm=sd,
        images=np.bincount(seen, minlength=len(moved)),
        checks=(*shared, *named.values(), _error_check(sd)),
    )


def _with_distance(frame: Frame, known: KnownDistance) -> Frame:
    """Return the frame with its prior conditioned on a distance."""
    place = {f.id: k for k, f in enumerate(frame.fiducials)}
    if unknown := [name for name in (known.first, known.second) if name not in place]:
        raise UnusableInputError(f"frame {frame.name!r} has no ball {unknown[0]!r}; name two of its balls")
    first, second = place[known.first], place[known.second]
    xyz = frame.xyz_mm
    between = xyz[second] - xyz[first]
    length = float(np.linalg.norm(between))
    by_ball = np.zeros(xyz.size)
    by_ball[3 * second : 3 * second + 3], by_ball[3 * first : 3 * first + 3] = between / length, -between / length
    prior = frame.error_factor @ frame.error_factor.T
    gain = prior @ by_ball / (by_ball @ prior @ by_ball + known.sd_mm**2)
    off = known.mm - length
    if abs(off) > 5 * np.sqrt(by_ball @ prior @ by_ball + known.sd_mm**2):
        raise UnusableInputError(
            f"{known.first} and {known.second} are {length:.2f} mm apart by the frame file, not {known.mm:g} mm: check "
            "the distance (between the centres) and the file's tolerance"
        )
    covariance = prior - np.outer(gain, by_ball @ prior)
    return replace(measured_frame(frame, off * gain.reshape(-1, 3), covariance), in_use=None)


def _at_best_fit(frame: Frame, fit: SolidAdjustment) -> tuple[np.ndarray, np.ndarray]:
    """Return the balls' displacements (M, 3) against the file and their covariance, without the rigid motion that best
    fits the file: it belongs to CFCS, not to the solid."""
    before = frame.xyz_mm
    rigid = displacement(before - before.mean(axis=0)).reshape(-1, 6)
    free = np.eye(len(rigid)) - rigid @ np.linalg.pinv(rigid)
    gain = free @ fit.solid.factor @ fit.gain[: len(fit.e)]
    return (free @ (fit.xyz_mm - before).ravel()).reshape(-1, 3), gain @ gain.T


def _error_check(sd_mm: np.ndarray) -> Check:
    rms = float(np.sqrt(np.mean(sd_mm**2)))
    states = f"The balls are known to {rms:.3f} mm rms per coordinate"
    otherwise = ": take more images, from directions that differ by 30° and more."
    return at_most("ball error", rms, MAX_SD_MM, "mm", states, otherwise=otherwise)
