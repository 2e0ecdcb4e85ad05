"""The paper's Table 1 for the user's own machine: reconstructed test points compared with their measured positions."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from sightline.calibration import CalibratedView
from sightline.common.bounded import MAX_TEXT_BYTES
from sightline.common.checks import Check, at_least
from sightline.common.geometry.covariance import length_quantile
from sightline.common.geometry.lines import angle_rad
from sightline.common.tables import read_rows
from sightline.detection import Detections, Observations
from sightline.errors import RefusedError, UnusableInputError
from sightline.planning import SpacePoints, reconstruct
from sightline.planning.points.gaps import MIN_PROBABILITY
from sightline.planning.points.solution import Method

_PLACE = ("name", "x_mm", "y_mm", "z_mm")
_PIXELS = ("pa_u_px", "pa_v_px", "lateral_u_px", "lateral_v_px")
# Maximum distance of a detected ball from the projection of its measured position: 3 mm, less than the error of the
# paper's worst calibration, and half the distance of neighbouring beads [ours].
NEAR_PX = 15.0


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """N points: `names`, `xyz_mm` (N, 3) CFCS, and `uv_px` (2, N, 2), PA then lateral, or None without picks."""

    names: tuple[str, ...]
    xyz_mm: np.ndarray
    uv_px: np.ndarray | None = None


def read_points(path: str | Path) -> MeasuredPoints:
    """Read a CSV file with the columns name,x_mm,y_mm,z_mm and, optionally, pa_u_px,pa_v_px,lateral_u_px,lateral_v_px.

    Raises UnusableInputError, which names the line.
    """
    file = Path(path)
    header, rows = read_rows(file, MAX_TEXT_BYTES, UnusableInputError, "give a table of test points as CSV")
    if header not in (_PLACE, _PLACE + _PIXELS):
        expected = f"{','.join(_PLACE)}[,{','.join(_PIXELS)}]"
        raise UnusableInputError(f"{file.name}, line 1: the columns are {','.join(header)!r}; {expected} was expected")
    numbers: dict[str, list[float]] = {}
    for row in rows:
        name = row.text("name")
        if name in numbers:
            raise row.error(f"the point {name!r} occurs twice; rename one")
        numbers[name] = [row.number(column) for column in header[1:]]
    if not numbers:
        raise UnusableInputError(f"{file.name} holds no points; give one line for each")
    table = np.array(list(numbers.values()))
    picks = table[:, 3:].reshape(-1, 2, 2).swapaxes(0, 1) if len(header) > len(_PLACE) else None
    return MeasuredPoints(tuple(numbers), table[:, :3], picks)


def find_balls(
    view: CalibratedView, detections: Detections, observations: Observations, points: MeasuredPoints
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (N, 2) of test balls among the detections of one image, and their covariances (N, 2, 2).

    A test ball is the detection near the projection of its measured position that is not a bead of the frame. The
    position only selects the detection; it does not change its pixel. Raises RefusedError if none or several are near.
    """
    beads = {tuple(uv) for uv in observations.uv_px}
    free = np.array([i for i, uv in enumerate(detections.uv_px) if tuple(uv) not in beads], dtype=int)
    expected = view.project(points.xyz_mm)
    distance = np.linalg.norm(expected[:, None] - detections.uv_px[free][None], axis=-1)
    balls = []
    for name, row in zip(points.names, distance, strict=True):
        near = free[row < NEAR_PX]
        if len(near) != 1:
            raise RefusedError(
                f"view {view.name!r}: {len(near)} balls are seen within {NEAR_PX:.0f} px of where the test point "
                f"{name!r} should be; give its pixels in the table, and check its coordinates"
            )
        balls.append(near[0])
    return detections.uv_px[balls], detections.covariance_px2[balls]


@dataclass(frozen=True)
class Statistics:
    """Statistics of N errors after ASTM F2554, in `unit`: `mean`, sample `sd` (None for one error), `largest`."""

    what: str
    unit: str
    number: int
    mean: float
    sd: float | None
    largest: float

    @staticmethod
    def of(what: str, unit: str, errors: np.ndarray) -> "Statistics":
        """Return the statistics of absolute errors (N,)."""
        sd = float(np.std(errors, ddof=1)) if len(errors) > 1 else None
        return Statistics(what, unit, len(errors), float(np.mean(errors)), sd, float(np.max(errors)))


@dataclass(frozen=True, eq=False)
class Assessment:
    """N test points: measured by other means (`truth`) and reconstructed from the images (`points`). CFCS, mm."""

    truth: MeasuredPoints
    points: SpacePoints

    @property
    def error_mm(self) -> np.ndarray:
        """Errors (N, 3): reconstructed minus measured."""
        return self.points.xyz_mm - self.truth.xyz_mm

    @property
    def absolute_mm(self) -> np.ndarray:
        """Lengths (N,) of the errors: E of the paper's Table 1."""
        return np.linalg.norm(self.error_mm, axis=1)

    @cached_property
    def predicted_95_mm(self) -> np.ma.MaskedArray | None:
        """95 % bounds (N,) of the errors; None if a view's error is unknown.

        Masked for points whose distance between the lines of sight contradicts the bound.
        """
        if self.points.joint_covariance_mm2 is None:
            return None
        return np.ma.masked_array(length_quantile(self.points.covariance_mm2), mask=self.points.gap_failed)

    @property
    def normalised(self) -> np.ma.MaskedArray | None:
        """Mahalanobis lengths (N,) of the errors: about 1.7 if the covariance is right; None if it is unknown.

        Masked for points whose distance between the lines of sight contradicts the covariance.
        """
        if self.points.joint_covariance_mm2 is None:
            return None
        scaled = np.linalg.solve(self.points.covariance_mm2, self.error_mm[..., None])[..., 0]
        lengths = np.sqrt(np.einsum("ia,ia->i", self.error_mm, scaled))
        return np.ma.masked_array(lengths, mask=self.points.gap_failed)

    def table(self) -> tuple[Statistics, ...]:
        """Return statistics of position and, from two points on, of distances and angles of pairs (ASTM F2554)."""
        position = Statistics.of("position", "mm", self.absolute_mm)
        pairs = list(combinations(range(len(self.truth.names)), 2))
        if not pairs:
            return (position,)
        first, second = np.transpose(pairs)
        seen = self.points.xyz_mm[second] - self.points.xyz_mm[first]
        true = self.truth.xyz_mm[second] - self.truth.xyz_mm[first]
        distance = np.abs(np.linalg.norm(seen, axis=1) - np.linalg.norm(true, axis=1))
        return (
            position,
            Statistics.of("distance between two points", "mm", distance),
            Statistics.of("angle of the line through two points", "°", np.rad2deg(angle_rad(seen, true))),
        )

    @property
    def checks(self) -> tuple[Check, ...]:
        """Checks that the errors of all points agree with the prediction, and each gap with its stated error."""
        if self.points.joint_covariance_mm2 is None:
            sentence = "Error unknown: a view states no covariance, so no error was predicted."
            return (Check("errors as predicted", False, None, MIN_PROBABILITY, "", sentence),)
        errors = self.error_mm.ravel()
        square = errors @ np.linalg.solve(self.points.joint_covariance_mm2, errors)
        probability = float(chi2.sf(square, len(errors)))
        states = f"Errors this large have a probability of {probability:.2g} under the covariance stated"
        otherwise = "; check the measured coordinates, the frame's tolerances and the picks."
        agreement = at_least("errors as predicted", probability, MIN_PROBABILITY, "", states, otherwise=otherwise)
        return (agreement, *self.points.gap_checks(self.truth.names))

    def document(self) -> dict[str, Any]:
        """Return everything as JSON types; null where the error is unknown or contradicted by the gap."""
        unknown = [None] * len(self.truth.names)
        predicted, normalised = (unknown if a is None else a.tolist() for a in (self.predicted_95_mm, self.normalised))
        return {
            "coordinates": "CFCS",
            "method": self.points.method,
            "points": [
                {
                    "name": name,
                    "measured_mm": self.truth.xyz_mm[i].tolist(),
                    "reconstructed_mm": self.points.xyz_mm[i].tolist(),
                    "error_mm": float(self.absolute_mm[i]),
                    "predicted_95_mm": predicted[i],
                    "normalised": normalised[i],
                    "gap_mm": float(self.points.gap_mm[i]),
                    "inside_hull": bool(self.points.inside_hull[i]),
                }
                for i, name in enumerate(self.truth.names)
            ],
            "largest_mm": float(self.absolute_mm.max()),
            "table": [vars(row) for row in self.table()],
        }


def assess(
    views: Sequence[CalibratedView],
    truth: MeasuredPoints,
    uv_px: np.ndarray | None = None,
    uv_covariance_px2: np.ndarray | None = None,
    method: Method = "weighted",
) -> Assessment:
    """Reconstruct test points from pixels (2, N, 2), by default those of the table, and compare them with the truth.

    Raises UnusableInputError if there are no pixels, and what `reconstruct` raises.
    """
    pixels = truth.uv_px if uv_px is None else uv_px
    if pixels is None:
        raise UnusableInputError(
            "the table of test points states no pixels; add the columns pa_u_px,pa_v_px,lateral_u_px,lateral_v_px, "
            "or let the balls be found in the images"
        )
    return Assessment(truth, reconstruct(views, pixels, uv_covariance_px2, method))
