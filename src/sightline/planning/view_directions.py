"""The directions from which the images of a plan were taken, against those that its procedure wants."""

from collections.abc import Sequence

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.checks import Check
from sightline.planning.directions import ANTERIOR, MEDIAL, caudal, unit
from sightline.planning.procedures import Procedure
from sightline.planning.results import Verdict
from sightline.planning.trajectory import Trajectory

_NAME = "view directions"
_UNKNOWN = (
    "The directions of the images are not checked: nothing says how the patient lies to this frame. Compare both "
    "images with the views that `sightline procedure show` names."
)
# Checks along lateral, caudal or anterior: those of the frame, by the stated side.
_ALONG_AXES = ("side", "lateral of lesser trochanter", "anterior of lesser trochanter")
_ASSUMED = (
    "The block's axes are taken for the patient's: x towards the operated side, z forwards. No image confirms this, so "
    "the checks of the side and of the lesser trochanter hold only if the block was placed like this."
)


def judge_directions(
    procedure: Procedure, views: Sequence[CalibratedView], trajectory: Trajectory, side: str | None
) -> Verdict:
    """Return the check of the views' beams at the wire's middle, if the procedure has it.

    `views`: in the order of the procedure's; further ones are compared by their names. The axes of a frame with plates
    are those of the patient (docs/conventions.md). Those of a block are not, and a view may have no frame: then the
    check is missing if the procedure requires it, and left out otherwise.
    """
    rule = next((one for one in procedure.checks if one.check == _NAME), None)
    if rule is None:
        return Verdict((), ())
    why = unknown_directions(procedure, views)
    if not why and side is None and any(one.tilt_deg for one in procedure.document.views):
        why = "The directions of the images are not checked: the side is not given, which tells head from feet."
    if why:
        missing = (Check("view directions", False, None, None, "°", why),) if rule.required else ()
        return Verdict(missing, missing)
    middle = (trajectory.entry_mm + trajectory.end_mm) / 2
    wanted = [one for k, one in enumerate(procedure.document.views) if k < 2 or one.name in [v.name for v in views[2:]]]
    seen = [*views[:2], *(next(v for v in views[2:] if v.name == one.name) for one in wanted[2:])]
    judged = []
    for one, view in zip(wanted, seen, strict=False):
        beam = unit(middle - view.focal_point_mm)
        away = np.rad2deg(np.arccos(np.clip(beam @ beam_of(one.orbit_deg, one.tilt_deg, side), -1.0, 1.0)))
        judged.append((float(away) - one.within_deg, float(away), one, angles_of(beam, side)))
    over, away, one, (orbit, tilt) = max(judged, key=lambda each: each[0])
    sentence = f"The view {one.name} is {away:.0f}° from its wanted direction (at most {one.within_deg:.0f}°)"
    if over > 0.0:
        sentence += (
            f"; its beam is at orbit {orbit:.0f}°, tilt {tilt:.0f}°: acquire it at orbit {one.orbit_deg:.0f}°, tilt "
            f"{one.tilt_deg:.0f}°, or check the side and the order of the images"
        )
    return Verdict((Check("view directions", over <= 0.0, away, one.within_deg, "°", f"{sentence}."),), ())


def unknown_directions(procedure: Procedure, views: Sequence[CalibratedView]) -> str:
    """Return why the procedure's check of directions cannot be made on these views, or ""."""
    if all(one.check != _NAME for one in procedure.checks):
        return ""
    lines = [view.lines_of_sight(np.zeros((0, 2))) for view in views]
    return _UNKNOWN if any(one.frame_key is None or one.adjustment is not None for one in lines) else ""


def assumed_axes(procedure: Procedure, views: Sequence[CalibratedView]) -> str:
    """Return what the procedure's checks along a block's axes take for granted, or "" for plates or without such."""
    if all(one.check not in _ALONG_AXES for one in procedure.checks):
        return ""
    lines = [view.lines_of_sight(np.zeros((0, 2))) for view in views]
    return _ASSUMED if any(one.adjustment is not None for one in lines) else ""


def beam_of(orbit_deg: float, tilt_deg: float, side: str | None) -> np.ndarray:
    """Return the unit vector (3,), CFCS of a frame with plates, of a beam from source to detector.

    `orbit_deg` 0 is towards anterior, 90 towards the operated side; `tilt_deg` is positive towards the head. `side` may
    be None for a tilt of 0. Raises UnusableInputError.
    """
    orbit, tilt = np.deg2rad([orbit_deg, tilt_deg])
    level = np.sin(orbit) * -MEDIAL + np.cos(orbit) * ANTERIOR
    return level if tilt == 0.0 else np.cos(tilt) * level - np.sin(tilt) * caudal(side or "")


def angles_of(beam: np.ndarray, side: str | None) -> tuple[float, float]:
    """Return orbit and tilt, °, of a unit vector (3,); without a side the tilt of a right one."""
    orbit = np.arctan2(beam @ -MEDIAL, beam @ ANTERIOR)
    tilt = np.arcsin(np.clip(-beam @ caudal(side or "right"), -1.0, 1.0))
    return float(np.rad2deg(orbit)), float(np.rad2deg(tilt))
