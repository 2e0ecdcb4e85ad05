"""A nail as its maker states it, the measured axis of one of its holes, and how to turn the C-arm along that axis."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check, failed
from sightline.common.geometry.covariance import length_quantile
from sightline.common.geometry.lines import across, unit
from sightline.common.show import Shown, checks_lines, numbers
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.planning.bone.drawings import MIN_ANGLE_RAD, Axis
from sightline.planning.points.results import SpacePoints, error_unknown


@dataclass(frozen=True)
class Nail:
    """A round nail with transverse holes; the walls of a hole are one outer diameter apart.

    `diameter_mm`: outer; `hole_mm`, `bore_mm`: diameters of the holes and of the cannulation (0: none); `material`:
    "titanium" or "steel". `sd_mm`: standard deviation of each radius from its stated value. `spacing_mm`: between the
    two distal holes along the nail; None: not stated. Raises UnusableInputError.
    """

    diameter_mm: float = 11.0
    hole_mm: float = 5.0
    bore_mm: float = 5.0
    material: str = "titanium"
    sd_mm: float = 0.02  # [ours] a machining tolerance of 0.05 mm
    spacing_mm: float | None = None

    @property
    def radii_mm(self) -> np.ndarray:
        """(3,) radii of the hole, of the outline, and of the wall that the rims lie on."""
        return np.array([self.hole_mm, self.diameter_mm, self.diameter_mm]) / 2

    def __post_init__(self) -> None:
        if not (0 < self.hole_mm < self.diameter_mm < np.inf and 0 <= self.bore_mm < self.diameter_mm):
            raise UnusableInputError(
                f"a nail of {self.diameter_mm} mm cannot have holes of {self.hole_mm} mm and a bore of "
                f"{self.bore_mm} mm; give diameters smaller than the nail's"
            )
        if self.spacing_mm is not None and not self.hole_mm < self.spacing_mm < np.inf:
            raise UnusableInputError(
                f"holes of {self.hole_mm} mm cannot be {self.spacing_mm} mm apart; give the spacing"
            )
        if self.material not in ("titanium", "steel") or not 0 < self.sd_mm < np.inf:
            raise UnusableInputError("a nail is of 'titanium' or 'steel', and its sizes have a positive s.d.")


@dataclass(frozen=True, eq=False)
class HolePose:
    """Where a hole and its nail are, CFCS: a point (3,) and a unit vector (3,) of each axis.

    The hole's axis points away from the X-ray source of the first view.
    """

    nail_mm: np.ndarray
    along: np.ndarray
    hole_mm: np.ndarray
    axis: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class Hole(Shown):
    """The axis of a hole, CFCS. Look at `checks` before you use it.

    `entry_mm`, `exit_mm` (3,): where the axis crosses the nail's surface; the entry is nearer to the X-ray source of
    the first view. `covariance_mm2` (6, 6): of (entry, exit); `budget_mm2`: the same for each source of a point's error
    (`SpacePoints`), of which "picks" are the edges and the nail's sizes. `nail_mm`, `nail_direction` (3,): the point of
    the nail's axis nearest to the hole's, and the unit vector along it there. `given`, `kept` (V, 4) int: for each view
    the points of both outlines, entry rim and exit rim, and how many of them the fit kept. `nail`: as its maker
    states it.
    """

    entry_mm: np.ndarray
    exit_mm: np.ndarray
    covariance_mm2: np.ndarray
    budget_mm2: Mapping[str, np.ndarray]
    nail_mm: np.ndarray
    nail_direction: np.ndarray
    given: np.ndarray
    kept: np.ndarray
    checks: tuple[Check, ...]
    nail: Nail

    @property
    def middle_mm(self) -> np.ndarray:
        """(3,) midpoint of entry and exit."""
        return (self.entry_mm + self.exit_mm) / 2

    @property
    def direction(self) -> np.ndarray:
        """(3,) unit vector from entry to exit."""
        return unit(self.exit_mm - self.entry_mm)

    def entered_along(self, direction: np.ndarray) -> "Hole":
        """Return the hole with entry and exit such that a drill passes it along a direction (3,) rather than against
        it."""
        if self.direction @ direction > 0:
            return self
        swap = np.r_[3:6, 0:3]
        return replace(
            self,
            entry_mm=self.exit_mm,
            exit_mm=self.entry_mm,
            covariance_mm2=self.covariance_mm2[np.ix_(swap, swap)],
            budget_mm2={source: own[np.ix_(swap, swap)] for source, own in self.budget_mm2.items()},
        )

    @property
    def pose(self) -> HolePose:
        """Both axes, without their errors."""
        return HolePose(self.nail_mm, self.nail_direction, self.middle_mm, self.direction)

    @property
    def axis(self) -> Axis:
        """Entry and exit, as an axis."""
        return Axis(np.stack([self.entry_mm, self.exit_mm]), self.covariance_mm2)

    def located(self, seen: SpacePoints) -> SpacePoints:
        """Return points whose first two, entry and end of a wire, are this hole's, with its errors."""
        n = 3 * len(seen.xyz_mm)

        def beside(others: np.ndarray, own: np.ndarray) -> np.ndarray:
            joined = np.zeros((n, n))
            joined[6:, 6:], joined[:6, :6] = others[6:, 6:], own
            return joined

        joint, budget = seen.joint_covariance_mm2, seen.budget_mm2
        if joint is None or budget is None:
            raise error_unknown()
        return replace(
            seen,
            xyz_mm=np.concatenate([[self.entry_mm, self.exit_mm], seen.xyz_mm[2:]]),
            joint_covariance_mm2=beside(joint, self.covariance_mm2),
            budget_mm2={source: beside(others, self.budget_mm2[source]) for source, others in budget.items()},
        )

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return not failed(self.checks)

    @property
    def axis_error_95_mm(self) -> float:
        """With a probability of 95 % the axis is nearer to the true one at its middle."""
        return float(length_quantile(np.asarray(self.axis.offset_covariance_mm2)))

    @property
    def direction_error_95_rad(self) -> float:
        """With a probability of 95 % the direction's error is smaller."""
        return float(length_quantile(np.asarray(self.axis.direction_covariance_rad2)))

    @property
    def sentence(self) -> str:
        """The errors of the axis in words."""
        direction = np.rad2deg(self.direction_error_95_rad)
        return f"the axis of the hole is measured, with 95 % to {self.axis_error_95_mm:.2f} mm and {direction:.2f}°"

    def document(self) -> dict[str, Any]:
        """Return the axis, its errors and the nail as JSON types: mm, angles in degrees."""
        return {
            "coordinates": "CFCS",
            "entry_mm": self.entry_mm.tolist(),
            "exit_mm": self.exit_mm.tolist(),
            "nail_mm": self.nail_mm.tolist(),
            "nail_direction": self.nail_direction.tolist(),
            "error_95": {
                "axis_mm": self.axis_error_95_mm,
                "direction_deg": float(np.rad2deg(self.direction_error_95_rad)),
            },
            "points": {"given": self.given.tolist(), "kept": self.kept.tolist()},
            "nail": vars(self.nail),
        }

    def summary(self) -> str:
        """Return entry and exit, the error bounds and the failed checks."""
        error = f"{self.axis_error_95_mm:.2f} mm, {np.rad2deg(self.direction_error_95_rad):.2f}°"
        return "\n".join(
            [
                "Hole of a nail in CFCS",
                f"  entry {numbers(self.entry_mm, 2)} mm",
                f"  exit  {numbers(self.exit_mm, 2)} mm",
                f"  95 % error of the axis {error}",
                *checks_lines(self.checks, 3),
            ]
        )


@dataclass(frozen=True, eq=False)
class Turn:
    """A rotation of the C-arm from one view: `orbit_rad` first, positive from the first view towards the second, then
    `tilt_rad`, positive towards `orbit_axis` (3,), the axis of the orbit, CFCS.

    `error_95_rad`: error of the hole's direction. The hole must stay in the beam's middle: the beam through a hole that
    is 30 mm away from the centre of rotation turns up to 1° less or more than the C-arm.
    """

    view: str
    orbit_rad: float
    tilt_rad: float
    orbit_axis: np.ndarray
    error_95_rad: float

    def document(self) -> dict[str, Any]:
        """Return the turn as JSON types, angles in degrees."""
        orbit, tilt, error = np.rad2deg([self.orbit_rad, self.tilt_rad, self.error_95_rad]).tolist()
        return {"view": self.view, "orbit_deg": orbit, "tilt_deg": tilt, "error_95_deg": error}

    @property
    def sentence(self) -> str:
        """The advice in words."""
        orbit, tilt = np.rad2deg([self.orbit_rad, self.tilt_rad])
        return f"{self.view}: for a perfect circle turn the C-arm by orbit {orbit:+.0f}°, tilt {tilt:+.0f}°."


def perfect_circle(hole: Hole, views: Sequence[CalibratedView], of: int = 0) -> Turn:
    """Return how to turn the C-arm from view `of` so that its beam through the hole runs along the hole.

    The C-arm orbits about the axis that is perpendicular to the first two views' beams. Raises
    ReconstructionRefusedError where these are less than 10° apart.

    >>> turn = sl.planning.perfect_circle(hole, [pa, oblique])  # doctest: +SKIP
    >>> print(turn.sentence)  # doctest: +SKIP
    pa: for a perfect circle turn the C-arm by orbit +7°, tilt -3°.
    """
    beams = [unit(hole.middle_mm - view.focal_point_mm) for view in views]
    axis = np.cross(beams[0], beams[1])
    if np.linalg.norm(axis) < np.sin(MIN_ANGLE_RAD):
        raise ReconstructionRefusedError(
            "the first two views are less than 10° apart and do not show about which axis the C-arm orbits; turn it "
            "further for one of them"
        )
    axis, beam = unit(axis), beams[of]
    goal = hole.direction * np.sign(hole.direction @ beam)
    start, end = across(beam, axis), across(goal, axis)
    orbit = np.arctan2(np.cross(start, end) @ axis, start @ end)
    tilt = np.arcsin(goal @ axis) - np.arcsin(beam @ axis)
    return Turn(views[of].name, float(orbit), float(tilt), axis, hole.direction_error_95_rad)


def perfect_circles(hole: Hole, views: Sequence[CalibratedView]) -> list[Turn]:
    """Return the turn of `perfect_circle` from each of the first two views."""
    return [perfect_circle(hole, views, k) for k in range(2)]
