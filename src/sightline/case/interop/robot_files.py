"""A plan as the bytes of two OpenIGTLink messages, TRANSFORM `TGT_plan` and TRAJ, with their content as JSON.

A file does not age, so the messages state that the plan has expired (`valid_s` 0). Our robot refuses them as they are:
the program that sends one must set how long the plan is still valid (docs/robot-link.md).
"""

from math import degrees

import numpy as np

from sightline.calibration.exchange.reading import json_bytes
from sightline.case.interop.itk import T_cfcs_wire
from sightline.case.interop.plan_file import PlanFile
from sightline.robot import contract
from sightline.robot.control.insertion import DEPTH_SLACK_MM
from sightline.robot.igtl import Message, Path, Trajectories, Transform, encode
from sightline.robot.kinematics.target import PlanIdentity


def write(plan: PlanFile, case: str) -> dict[str, bytes]:
    """Return both messages and their description as JSON. Raises RobotRefusedError if the plan may not be sent."""
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
    said = {
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
    return {name: encode(message) for name, message in named.items()} | {"igtl.json": json_bytes(said)}
