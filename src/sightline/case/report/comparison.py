"""Plans held against a truth that is known, as it is for images of the twin."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sightline.planning import Trajectory


@dataclass(frozen=True, eq=False)
class Truth:
    """Where the wire should go: entry and end point (2, 3), CFCS, and where both stand in each image, (2, 2, 2) px."""

    xyz_mm: np.ndarray
    uv_px: np.ndarray


@dataclass(frozen=True, eq=False)
class Compared:
    """One plan beside the truth. `picks` says in words how its points were picked."""

    method: str
    picks: str
    trajectory: Trajectory
    truth: Truth

    @property
    def errors_mm(self) -> tuple[float, float]:
        """Of the entry and of the end point."""
        entry, end = np.linalg.norm(self.trajectory.points.xyz_mm - self.truth.xyz_mm, axis=1)
        return float(entry), float(end)

    @property
    def direction_error_rad(self) -> float:
        """Angle between the planned and the true direction."""
        true = self.truth.xyz_mm[1] - self.truth.xyz_mm[0]
        true = true / np.linalg.norm(true)
        across = np.linalg.norm(np.cross(true, self.trajectory.direction))
        return float(np.arctan2(across, true @ self.trajectory.direction))

    @property
    def figures(self) -> tuple[float, float, float]:
        """Error of the entry point, mm; of the end point, mm; of the direction, degrees."""
        return *self.errors_mm, float(np.rad2deg(self.direction_error_rad))

    @property
    def bounds_95(self) -> tuple[float, float, float] | None:
        """What the plan stated for the same three; None where its error is unknown."""
        if not self.trajectory.error_stated:
            return None
        path = self.trajectory
        return path.entry_error_95_mm, path.end_error_95_mm, float(np.rad2deg(path.direction_error_95_rad))

    @property
    def kept(self) -> int | None:
        """How many of the three errors are within their bounds."""
        bounds = self.bounds_95
        return None if bounds is None else sum(e <= b for e, b in zip(self.figures, bounds, strict=True))

    def document(self) -> dict[str, Any]:
        """As JSON types."""
        names = ("entry_mm", "end_mm", "direction_deg")
        bounds = self.bounds_95
        return {
            "method": self.method,
            "picks": self.picks,
            "error": dict(zip(names, self.figures, strict=True)),
            "stated_95": None if bounds is None else dict(zip(names, bounds, strict=True)),
            "within_bounds": self.kept,
        }


@dataclass(frozen=True)
class Refused:
    """A plan that a method refused to make, and why."""

    method: str
    picks: str
    reason: str

    def document(self) -> dict[str, Any]:
        """As JSON types."""
        return {"method": self.method, "picks": self.picks, "refused": self.reason}
