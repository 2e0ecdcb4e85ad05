"""The planned trajectory of the guide wire, its error, and each source's share of the error."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sightline.common.geometry.covariance import length_quantile, line_direction
from sightline.common.show import Plotted, numbers
from sightline.errors import ErrorUnknownError, UnusableInputError
from sightline.planning.points.results import SpacePoints, error_unknown

# Two points nearer than this do not give a direction [ours]: errors of 0.5 mm would turn it by 6°.
MIN_LENGTH_MM = 5.0


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Plotted):
    """A straight path from the entry point to the end point (the tip of the wire), CFCS; independent of any robot.

    `points`: the two reconstructed points, with their joint covariance, budget and gaps. Properties that depend on
    their errors raise ErrorUnknownError where `error_stated` is False. Raises UnusableInputError for points that are
    too close to give a direction.

    >>> wire = sl.load("out/demo/trajectory.json")
    >>> wire.direction.shape
    (3,)
    >>> wire.entry_error_95_mm < 1.0
    True
    """

    points: SpacePoints

    def __post_init__(self) -> None:
        if len(self.points.xyz_mm) != 2:
            raise UnusableInputError(
                f"{len(self.points.xyz_mm)} points given; give two for a trajectory, entry and end"
            )
        if self.length_mm < MIN_LENGTH_MM:
            raise UnusableInputError(
                f"entry and end point are {self.length_mm:.1f} mm apart (at least {MIN_LENGTH_MM:.0f} mm is needed for "
                "a direction); pick them further apart"
            )

    def summary(self) -> str:
        """Return entry and end point with their error bounds, and the length."""
        bounds = ["error unknown"] * 3
        if self.error_stated:
            errors = self.entry_error_95_mm, self.end_error_95_mm
            bounds = [f"95 % error {e:.2f} mm" for e in errors]
            bounds.append(f"95 % error of the direction {np.rad2deg(self.direction_error_95_rad):.2f}°")
        return "\n".join(
            [
                f"Trajectory of {self.length_mm:.1f} mm in CFCS",
                f"  entry {numbers(self.entry_mm, 2)} mm, {bounds[0]}",
                f"  end   {numbers(self.end_mm, 2)} mm, {bounds[1]}",
                f"  direction {numbers(self.direction, 4)}, {bounds[2]}",
            ]
        )

    def _new_axes(self, figure: Any) -> Any:
        return figure.add_subplot(projection="3d")

    def _draw(self, ax: Any) -> None:
        ax.plot(*self.points.xyz_mm.T, color="#0072b2")
        self.points.draw_named(ax, ("entry", "end"), f"wire of {self.length_mm:.1f} mm")

    @property
    def entry_mm(self) -> np.ndarray:
        """(3,) entry point, CFCS."""
        return self.points.xyz_mm[0]

    @property
    def end_mm(self) -> np.ndarray:
        """(3,) end point, CFCS."""
        return self.points.xyz_mm[1]

    @cached_property
    def length_mm(self) -> float:
        """Distance from entry to end."""
        return float(np.linalg.norm(self.end_mm - self.entry_mm))

    @cached_property
    def direction(self) -> np.ndarray:
        """(3,) unit vector from entry to end."""
        direction = (self.end_mm - self.entry_mm) / self.length_mm
        direction.flags.writeable = False
        return direction

    @property
    def error_stated(self) -> bool:
        """Whether the error is known and no gap contradicts it. One bad gap rules out both points: they share views."""
        return bool(self.points.error_stated.all())

    @property
    def covariance_mm2(self) -> np.ndarray:
        """(6, 6) of (entry, end). Raises ErrorUnknownError."""
        self._refuse_unstated()
        assert self.points.joint_covariance_mm2 is not None  # noqa: S101 - stated
        return self.points.joint_covariance_mm2

    def _refuse_unstated(self) -> None:
        failed = self.points.gap_failed
        if failed.any():
            point = ("entry", "end")[int(failed.argmax())]
            raise ErrorUnknownError(
                f"the lines of sight of the {point} point pass {self.points.gap_mm[failed.argmax()]:.2f} mm apart, "
                "more than the stated errors explain, so the error is unknown; pick the point again in all images"
            )
        if self.points.joint_covariance_mm2 is None:
            raise error_unknown()

    @property
    def direction_covariance_rad2(self) -> np.ndarray:
        """(2, 2) covariance of the direction along two axes perpendicular to it."""
        return self._to_direction @ self.covariance_mm2 @ self._to_direction.T

    @cached_property
    def _to_direction(self) -> np.ndarray:
        return line_direction(self.entry_mm, self.end_mm)

    @property
    def entry_error_95_mm(self) -> float:
        """95 % bound of the entry point's error. Raises ErrorUnknownError."""
        return self._errors_95[0]

    @property
    def end_error_95_mm(self) -> float:
        """95 % bound of the end point's error. Raises ErrorUnknownError."""
        return self._errors_95[1]

    @property
    def direction_error_95_rad(self) -> float:
        """95 % bound of the direction's error. Raises ErrorUnknownError."""
        return self._errors_95[2]

    @cached_property
    def _errors_95(self) -> tuple[float, float, float]:
        """The bounds of entry, end and direction, together: in less than half of the time that three take."""
        covariances = np.zeros((3, 3, 3))
        covariances[0], covariances[1] = self.covariance_mm2[:3, :3], self.covariance_mm2[3:, 3:]
        covariances[2, :2, :2] = self.direction_covariance_rad2
        entry, end, direction = length_quantile(covariances).tolist()
        return entry, end, direction

    def budget_rms(self) -> dict[str, dict[str, float]]:
        """Return for each source of BUDGET its rms error: "entry_mm", "end_mm", "direction_rad"; the squares add up.

        Raises ErrorUnknownError.
        """
        self._refuse_unstated()
        if self.points.budget_mm2 is None:
            raise error_unknown()
        return {
            source: {
                "entry_mm": float(np.sqrt(np.trace(c[:3, :3]))),
                "end_mm": float(np.sqrt(np.trace(c[3:, 3:]))),
                "direction_rad": float(np.sqrt(np.trace(self._to_direction @ c @ self._to_direction.T))),
            }
            for source, c in self.points.budget_mm2.items()
        }

    def document(self) -> dict[str, Any]:
        """Return everything as JSON types: mm, angles in degrees.

        Errors are null where `error_stated` is False; a `gap_sigma` is null where its gap was not tested.
        """
        known = self.error_stated
        return {
            "coordinates": "CFCS",
            "robot": "none known: coordinates are those of the calibration frame",
            "method": self.points.method,
            "entry_mm": self.entry_mm.tolist(),
            "end_mm": self.end_mm.tolist(),
            "direction": self.direction.tolist(),
            "length_mm": self.length_mm,
            "covariance_mm2": self.covariance_mm2.tolist() if known else None,
            "error_95": {
                "entry_mm": self.entry_error_95_mm,
                "end_mm": self.end_error_95_mm,
                "direction_deg": float(np.rad2deg(self.direction_error_95_rad)),
            }
            if known
            else None,
            "budget_rms": {
                source: {
                    "entry_mm": rms["entry_mm"],
                    "end_mm": rms["end_mm"],
                    "direction_deg": float(np.rad2deg(rms["direction_rad"])),
                }
                for source, rms in self.budget_rms().items()
            }
            if known
            else None,
            "gap_mm": self.points.gap_mm.tolist(),
            "gap_tested": self.points.gap_tested.tolist(),
            "gap_sigma": None if self.points.gap_sigma is None else self.points.gap_sigma.tolist(),
            "inside_hull": self.points.inside_hull.tolist(),
        }


@dataclass(frozen=True)
class Share:
    """Shares of one error: its rms in `unit`, "mm" or "°", and each source's `percent` of the mean square."""

    rms: float
    unit: str
    percent: dict[str, float]


def error_shares(
    trajectory: Trajectory, robot_mm2: np.ndarray | Mapping[str, np.ndarray] | None = None
) -> dict[str, Share]:
    """Return the shares for "entry", "end" and "direction" of a plan.

    `robot_mm2`: the robot's covariance, (6, 6) of (entry, end), CFCS: one source, "robot", or several by name.
    Raises ErrorUnknownError.
    """
    if not trajectory.error_stated or trajectory.points.budget_mm2 is None:
        raise error_unknown()
    added = {} if robot_mm2 is None else robot_mm2 if isinstance(robot_mm2, Mapping) else {"robot": robot_mm2}
    ends = np.stack([trajectory.entry_mm, trajectory.end_mm])
    return error_shares_of(ends, trajectory.points.budget_mm2 | dict(added))


def error_shares_of(ends_mm: np.ndarray, budget_mm2: Mapping[str, np.ndarray]) -> dict[str, Share]:
    """Return the same for entry and end (2, 3), mm, and a budget of (6, 6) covariances in the same coordinates."""
    to_direction = np.rad2deg(line_direction(*np.asarray(ends_mm, dtype=np.float64)))
    parts = {
        "entry": ("mm", np.eye(6)[:3]),
        "end": ("mm", np.eye(6)[3:]),
        "direction": ("°", to_direction),
    }
    shares = {}
    for name, (unit, rows) in parts.items():
        squares = {source: float(np.trace(rows @ c @ rows.T)) for source, c in budget_mm2.items()}
        total = sum(squares.values())
        shares[name] = Share(
            float(np.sqrt(total)), unit, {source: 100.0 * square / total for source, square in squares.items()}
        )
    return shares
