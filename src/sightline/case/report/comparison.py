"""Comparison of plans with a known truth, as for images of the twin."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sightline.planning import Trajectory


@dataclass(frozen=True, eq=False)
class Truth:
    """The intended wire: entry and end point (2, 3), CFCS, and their pixels in each image (2, 2, 2)."""

    xyz_mm: np.ndarray
    uv_px: np.ndarray


@dataclass(frozen=True, eq=False)
class Compared:
    """One plan compared with the truth. `picks`: how its points were picked, in words."""

    method: str
    picks: str
    trajectory: Trajectory
    truth: Truth

    @property
    def errors_mm(self) -> tuple[float, float]:
        """Errors of the entry and of the end point."""
        entry, end = np.linalg.norm(self.trajectory.points.xyz_mm - self.truth.xyz_mm, axis=1)
        return float(entry), float(end)

    @property
    def direction_error_rad(self) -> float:
        """The angle between the planned and the true direction."""
        true = self.truth.xyz_mm[1] - self.truth.xyz_mm[0]
        true = true / np.linalg.norm(true)
        across = np.linalg.norm(np.cross(true, self.trajectory.direction))
        return float(np.arctan2(across, true @ self.trajectory.direction))

    @property
    def errors(self) -> tuple[float, float, float]:
        """Errors of the entry point, mm, of the end point, mm, and of the direction, degrees."""
        return *self.errors_mm, float(np.rad2deg(self.direction_error_rad))

    @property
    def bounds_95(self) -> tuple[float, float, float] | None:
        """The 95 % bounds that the plan stated for the same errors; None if its error is unknown."""
        if not self.trajectory.error_stated:
            return None
        path = self.trajectory
        return path.entry_error_95_mm, path.end_error_95_mm, float(np.rad2deg(path.direction_error_95_rad))

    @property
    def within_bounds(self) -> int | None:
        """How many of the three errors are within their bounds; None if the plan states no bounds."""
        bounds = self.bounds_95
        return None if bounds is None else sum(e <= b for e, b in zip(self.errors, bounds, strict=True))

    def document(self) -> dict[str, Any]:
        """Return the comparison as JSON types."""
        names = ("entry_mm", "end_mm", "direction_deg")
        bounds = self.bounds_95
        return {
            "method": self.method,
            "picks": self.picks,
            "error": dict(zip(names, self.errors, strict=True)),
            "stated_95": None if bounds is None else dict(zip(names, bounds, strict=True)),
            "within_bounds": self.within_bounds,
        }


@dataclass(frozen=True)
class Refused:
    """A plan that a method refused to make, and the reason."""

    method: str
    picks: str
    reason: str

    def document(self) -> dict[str, Any]:
        """Return the refusal as JSON types."""
        return {"method": self.method, "picks": self.picks, "refused": self.reason}
