"""A wire proposed from head, shaft and lateral cortex, for a person to adjust."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.errors import ReconstructionRefusedError
from sightline.planning.anatomy import Anatomy
from sightline.planning.directions import MEDIAL, across, caudal, towards, unit

# Accepted distances of the lateral cortex from the shaft's axis: the shaft's outer diameter is 30 mm (physics.md,
# Femur), the trochanter is wider [ours].
CORTEX_RADII_MM = (5.0, 40.0)
# Minimum distance of the head's centre from the shaft's axis; in adults it is 30 to 50 mm [ours].
MIN_OFFSET_MM = 15.0
# Accepted lengths of a wire in the bone; hip screws have 70 to 120 mm [ours].
LENGTHS_MM = (40.0, 150.0)
_MAX_ROTATION_RAD = np.deg2rad(45.0)  # about the shaft, between the neck's axis and the head's centre [ours]


@dataclass(frozen=True)
class ProposalRule:
    """`angle_rad`: between wire and shaft, measured like the neck-shaft angle; `under_surface_mm`: depth of the tip
    below the head's surface."""

    angle_rad: float = float(np.deg2rad(135.0))  # of the usual plate (physics.md, Planning figures)
    under_surface_mm: float = 8.0  # 5 to 10 mm under the subchondral bone (physics.md)


@dataclass(frozen=True, eq=False)
class Proposal:
    """`entry_mm`, `end_mm` (3,), CFCS; `entry_uv_px`, `end_uv_px` (2, 2), a row for each view, as `plan` takes them."""

    entry_mm: np.ndarray
    end_mm: np.ndarray
    entry_uv_px: np.ndarray
    end_uv_px: np.ndarray
    sentence: str


def propose(views: Sequence[CalibratedView], found: Anatomy, side: str, rule: ProposalRule | None = None) -> Proposal:
    """Return the wire through the head's centre at the rule's angle to the shaft, in the plane of both.

    Where the neck's axis is drawn, the wire is rotated about the shaft to lie along it. It enters at the lateral
    cortex, modelled as a cylinder about the shaft's axis through the click.

    Raises ReconstructionRefusedError with the reason where no wire can be proposed, OutsideRegionError where it lies
    outside a view's calibrated region, UnusableInputError for an unknown side.
    """
    rule = rule or ProposalRule()
    for name in ("head", "shaft", "cortex"):
        if name not in found.at:
            raise ReconstructionRefusedError(f"no wire can be proposed: {found.absent[name]}")
    head, shaft = found.head, found.shaft
    assert head is not None and shaft is not None  # noqa: S101 - checked above
    found.refuse_side(side)
    along = towards(shaft.direction, caudal(side), "the shaft axis")
    to_head = across(head.centre_mm - shaft.ends_mm[0], along)
    if np.linalg.norm(to_head) < MIN_OFFSET_MM:
        raise ReconstructionRefusedError(
            f"the head's centre lies {np.linalg.norm(to_head):.0f} mm from the shaft's axis (at least "
            f"{MIN_OFFSET_MM:.0f} mm expected); draw head and shaft again"
        )
    inward = _inward(found, to_head, along)
    wire = np.cos(rule.angle_rad) * along + np.sin(rule.angle_rad) * inward
    end = head.centre_mm + _beyond_centre(head.radius_mm, rule) * wire
    cortex = across(found.part("cortex") - shaft.ends_mm[0], along)
    entry = head.centre_mm + _to_cortex(cortex, to_head, inward, np.sin(rule.angle_rad)) * wire
    length = float(np.linalg.norm(end - entry))
    if not LENGTHS_MM[0] <= length <= LENGTHS_MM[1]:
        raise ReconstructionRefusedError(
            f"the wire would be {length:.0f} mm long ({LENGTHS_MM[0]:.0f} to {LENGTHS_MM[1]:.0f} mm expected); "
            "check head, shaft and lateral cortex"
        )
    pixels = np.array([view.project(np.stack([entry, end])) for view in views])
    sentence = (
        f"Proposed: through the head's centre at {np.rad2deg(rule.angle_rad):.0f}° to the shaft, {length:.0f} mm long, "
        f"the tip {rule.under_surface_mm:.0f} mm below the head's surface. Adjust it to the images."
    )
    return Proposal(entry, end, pixels[:, 0], pixels[:, 1], sentence)


def _inward(found: Anatomy, to_head: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return the unit vector perpendicular to the shaft in the wire's plane: to the head's centre or along the neck."""
    if found.neck is None:
        return unit(to_head)
    inward = unit(across(towards(found.neck.direction, MEDIAL, "the neck axis"), along))
    angle = np.arccos(np.clip(inward @ unit(to_head), -1.0, 1.0))
    if angle > _MAX_ROTATION_RAD:
        raise ReconstructionRefusedError(
            f"seen along the shaft, the neck's axis points {np.rad2deg(angle):.0f}° away from the head's centre (at "
            f"most {np.rad2deg(_MAX_ROTATION_RAD):.0f}°); draw neck and head again"
        )
    return inward


def _beyond_centre(radius_mm: float, rule: ProposalRule) -> float:
    beyond = radius_mm - rule.under_surface_mm
    if beyond <= 0.0:
        raise ReconstructionRefusedError(
            f"a head of {radius_mm:.0f} mm radius is too small for a tip {rule.under_surface_mm:.0f} mm below its "
            "surface; draw the head again"
        )
    return beyond


def _to_cortex(cortex: np.ndarray, to_head: np.ndarray, inward: np.ndarray, sine: float) -> float:
    """Return where the wire leaves the cortex's cylinder about the shaft, mm along it from the head's centre (< 0).

    `cortex`, `to_head` (3,): perpendicular to the shaft, from its axis to the click's line of sight and to the head's
    centre.
    """
    radius = float(np.linalg.norm(cortex))
    if not CORTEX_RADII_MM[0] <= radius <= CORTEX_RADII_MM[1] or cortex @ to_head > 0:
        where = f"{radius:.0f} mm on the head's side" if cortex @ to_head > 0 else f"{radius:.0f} mm"
        raise ReconstructionRefusedError(
            f"the click on the lateral cortex lies {where} from the shaft's axis ({CORTEX_RADII_MM[0]:.0f} to "
            f"{CORTEX_RADII_MM[1]:.0f} mm expected, away from the head); click on the shaft's lateral edge"
        )
    middle = float(to_head @ inward)
    rest = radius**2 - float(to_head @ to_head) + middle**2
    if rest <= 0.0:
        raise ReconstructionRefusedError(
            f"the wire would pass the shaft's axis at {np.sqrt(to_head @ to_head - middle**2):.0f} mm, outside the "
            "bone; draw the neck again"
        )
    return float(-(middle + np.sqrt(rest)) / sine)
