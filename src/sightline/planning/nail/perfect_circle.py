"""How to turn the C-arm so that its beam runs along a hole, which then shows as a circle."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.errors import ReconstructionRefusedError
from sightline.planning.bone.directions import across, unit
from sightline.planning.nail.result import Hole

_MIN_SINE = np.sin(np.deg2rad(10.0))  # between the beams that give the orbit's axis [ours]


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
    if np.linalg.norm(axis) < _MIN_SINE:
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
