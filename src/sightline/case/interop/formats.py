"""A plan in small formats: ITK transforms, CSV, and two OpenIGTLink messages.

3D Slicer uses a transform file in the opposite direction: it places objects by the inverse of the mapping in the file.
"""

from collections.abc import Iterator
from math import degrees

import numpy as np

from sightline.calibration.exchange.reading import json_bytes
from sightline.case.interop.plan_file import PlanFile
from sightline.common.geometry.lines import unit
from sightline.common.tables import csv_bytes
from sightline.errors import UnusableInputError
from sightline.robot import contract
from sightline.robot.control.insertion import DEPTH_SLACK_MM
from sightline.robot.igtl import Message, Path, Trajectories, Transform, encode
from sightline.robot.kinematics.target import PlanIdentity


def transform_bytes(matrix: np.ndarray, comment: str) -> bytes:
    """Return the `AffineTransform_double_3_3` file of a matrix (4, 4) that maps points of one frame to another."""
    numbers = [*matrix[:3, :3].ravel(), *matrix[:3, 3]]
    lines = (
        "#Insight Transform File V1.0",
        f"#{comment}".replace("\n", " "),
        "#Transform 0",
        "Transform: AffineTransform_double_3_3",
        "Parameters: " + " ".join(repr(float(x)) for x in numbers),
        "FixedParameters: 0 0 0",
    )
    return ("\n".join(lines) + "\n").encode("ascii", "replace")


def T_lps_cfcs(side: str | None) -> np.ndarray:
    """Return the transform (4, 4) from CFCS to patient LPS, mm. Raises UnusableInputError without a side."""
    transform = np.eye(4)
    transform[:3, :3] = R_lps_cfcs(side)
    return transform


def T_cfcs_wire(points_mm: np.ndarray) -> np.ndarray:
    """Return the wire's pose (4, 4): origin at its end point (the tip), +z from entry to end.

    The rotation about z is arbitrary: x is perpendicular to the CFCS axis at the largest angle to the wire.
    """
    along = unit(points_mm[1] - points_mm[0])
    across = unit(np.cross(np.eye(3)[np.argmin(np.abs(along))], along))
    pose = np.eye(4)
    pose[:3] = np.column_stack([across, np.cross(along, across), along, points_mm[1]])
    return pose


def itk_files(plan: PlanFile, side: str | None) -> dict[str, bytes]:
    """Return the transforms of CFCS and of the wire to LPS, as ITK applies them to points, mm."""
    to_lps = T_lps_cfcs(side)
    wire = to_lps @ T_cfcs_wire(plan.points_mm)
    comment = f"mm; {side} hip; {plan.statement}"
    return {
        "lps_from_cfcs.tfm": transform_bytes(to_lps, f"calibration frame (CFCS) to patient LPS, {comment}"),
        "lps_from_wire.tfm": transform_bytes(
            wire, f"wire (origin at the tip, +z towards it) to patient LPS, {comment}"
        ),
    }


# Rows: left, posterior, superior. Columns: CFCS x (lateral), y (caudal for a right hip, cranial for a left one) and z
# (anterior). Both are rotations, not reflections, because lateral and +Y change sign together with the side.
_LPS_CFCS = {
    "right": np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]),
    "left": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}


def R_lps_cfcs(side: str | None) -> np.ndarray:
    """Return the rotation (3, 3) from CFCS to patient LPS; both share the origin. Raises UnusableInputError without a
    side."""
    if side not in _LPS_CFCS:
        raise UnusableInputError(
            "patient axes depend on the side of the hip; add --side right or --side left, as confirmed in the images"
        )
    return _LPS_CFCS[side]


COLUMNS = (
    "point",
    "coordinates",
    "x_mm",
    "y_mm",
    "z_mm",
    *(f"s{a}{b}_mm2" for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")),
    "error_95_mm",
    "plan",
)
_UPPER = np.triu_indices(3)


def csv_files(plan: PlanFile, side: str | None) -> dict[str, bytes]:
    """Return `trajectory.csv`: in CFCS, and in patient LPS too if the side is given. Unknown errors are empty cells."""
    rows = [*_rows(plan, "CFCS", np.eye(3)), *([] if side is None else _rows(plan, "LPS", R_lps_cfcs(side)))]
    return {"trajectory.csv": csv_bytes(COLUMNS, rows)}


def _rows(plan: PlanFile, frame: str, rotation: np.ndarray) -> Iterator[list[str]]:
    covariance, errors = plan.covariance_mm2, plan.errors_95_mm
    for k, name in enumerate(("entry", "end")):
        spread, error = [""] * 6, ""
        if covariance is not None and errors is not None:
            block = rotation @ covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] @ rotation.T
            spread, error = [repr(float(x)) for x in block[_UPPER]], repr(errors[k])
        yield [name, frame, *_place(rotation @ plan.points_mm[k]), *spread, error, plan.verdict]
    for k, landmark in enumerate(plan.document.landmarks):
        yield [f"landmark {k + 1}", frame, *_place(rotation @ np.array(landmark.xyz_mm)), *[""] * 7, plan.verdict]


def _place(xyz_mm: np.ndarray) -> list[str]:
    return [repr(float(x) + 0.0) for x in xyz_mm]


def igtl_files(plan: PlanFile, case: str) -> dict[str, bytes]:
    """Return the messages TRANSFORM `TGT_plan` and TRAJ, and their content as JSON.

    A file does not age, so the messages state that the plan has expired (`valid_s` 0). Our robot refuses them as they
    are: the program that sends one must set how long the plan is still valid (docs/robot-link.md).
    Raises RobotRefusedError if the plan may not be sent.
    """
    plan.refuse_for_robot()
    serial = plan.document.frame.serial if plan.document.frame else None
    named = (plan.identifier(case), plan.side or "", serial or "")
    identity = PlanIdentity(*named, plan.go, plan.document.kind or "", plan.frame)
    limits = plan.limits
    depth_mm = plan.length_mm + limits.beyond_mm
    entry, end = plan.points_mm
    tip = entry + depth_mm * (end - entry) / plan.length_mm
    metadata = {
        contract.PLAN: identity.plan,
        contract.SIDE: identity.side,
        contract.FRAME_SERIAL: identity.frame_serial,
        contract.GO: contract.YES,
        contract.UNITS: contract.MM,
        contract.COORDINATES: contract.CFCS,
        contract.LENGTH_MM: repr(depth_mm),
        contract.DEPTH_LIMIT_MM: repr(depth_mm + DEPTH_SLACK_MM),
        contract.VALID_S: "0",
        contract.FRAME: identity.frame,
        contract.KIND: identity.kind,
        contract.POSITION_LIMIT_MM: repr(limits.position_mm),
        contract.DIRECTION_LIMIT_DEG: repr(degrees(limits.direction_rad)),
        contract.BEYOND_MM: repr(limits.beyond_mm),
        contract.BEFORE_MM: repr(limits.before_mm),
    }
    pose = T_cfcs_wire(np.stack([entry, tip]))
    path = Path("planned wire", entry, tip, group="Sightline", owner="CFCS")
    named = {
        "target.igtl": Message(Transform(pose), f"{contract.TARGET}plan", version=2, metadata=metadata),
        "trajectory.igtl": Message(Trajectories((path,)), "plan", version=2, metadata=metadata),
    }
    description = {
        "statement": plan.statement,
        "coordinates": "CFCS",
        "units": "mm",
        "pose": "of the wire when it is drilled, +z towards the tip",
        "matrix": pose.tolist(),
        "entry_mm": plan.points_mm[0].tolist(),
        "end_mm": plan.points_mm[1].tolist(),
        "metadata": metadata,
        "messages": {name: {"type": m.type_name, "device": m.device_name} for name, m in named.items()},
    }
    return {name: encode(message) for name, message in named.items()} | {"igtl.json": json_bytes(description)}
