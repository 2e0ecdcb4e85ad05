"""The error budget in percent: each source's share of an error."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sightline.common.geometry.covariance import line_direction
from sightline.planning.points.results import error_unknown
from sightline.planning.points.trajectory import Trajectory


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
    out = {}
    for name, (unit, rows) in parts.items():
        squares = {source: float(np.trace(rows @ c @ rows.T)) for source, c in budget_mm2.items()}
        total = sum(squares.values())
        out[name] = Share(
            float(np.sqrt(total)), unit, {source: 100.0 * square / total for source, square in squares.items()}
        )
    return out
