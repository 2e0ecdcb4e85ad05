"""The pose of a registered bone for other programs: 3D Slicer, OpenIGTLink, ROS 2."""

from collections.abc import Callable

import numpy as np

from sightline.calibration.exchange.reading import json_bytes
from sightline.case.interop.formats import transform_bytes
from sightline.case.interop.slicer import RAS_LPS
from sightline.common.checks import failed
from sightline.errors import UnusableInputError
from sightline.planning.bone.registered import RegisteredBone
from sightline.robot import contract
from sightline.robot.igtl import Message, Transform, encode

CT = "ct"  # frame of the CT or mesh: its own coordinates, LPS
_M_OF_MM = 1e-3  # ROS is in metres [REP-103]


def slicer_files(bone: RegisteredBone) -> dict[str, bytes]:
    """Return the transform file that places the CT or mesh in CFCS: Slicer uses the inverse of the one in the file."""
    wrong = ", ".join(check.name for check in failed(bone.checks))
    warning = f"; NOT TO BE TRUSTED, checks failed: {wrong}" if wrong else ""
    text = f"3D Slicer: places the CT or mesh in CFCS, mm; other programs: invert it{warning}"
    return {"bone-pose.tfm": transform_bytes(np.linalg.inv(bone.matrix), text)}


def igtl_files(bone: RegisteredBone) -> dict[str, bytes]:
    """Return two messages TRANSFORM, which take the CT's coordinates to CFCS, mm: in LPS, and in RAS, as 3D Slicer
    applies them to what it shows. Raises UnusableInputError for a pose that is not to be trusted."""
    _refuse_untrusted(bone)
    metadata = {contract.UNITS: contract.MM, contract.COORDINATES: contract.CFCS}
    poses = {"ct": bone.matrix, "ct-ras": RAS_LPS @ bone.matrix @ RAS_LPS}
    return {
        f"{name}.igtl": encode(Message(Transform(pose), f"{name}-to-cfcs", version=2, metadata=metadata))
        for name, pose in poses.items()
    }


def ros2_files(bone: RegisteredBone) -> dict[str, bytes]:
    """Return `ct.yaml`: a geometry_msgs/msg/TransformStamped as `ros2 topic pub` reads it, m; it takes the CT's
    coordinates (its child frame) to CFCS. Raises UnusableInputError for a pose that is not to be trusted."""
    _refuse_untrusted(bone)
    at, turn = _M_OF_MM * bone.pose.translation, bone.pose.rotation.as_quat()
    message = {
        "header": {"frame_id": contract.CFCS.lower()},
        "child_frame_id": CT,
        "transform": {
            "translation": dict(zip("xyz", at.tolist(), strict=True)),
            "rotation": dict(zip("xyzw", turn.tolist(), strict=True)),
        },
    }
    return {"ct.yaml": json_bytes(message)}  # JSON is YAML


FORMATS: dict[str, Callable[[RegisteredBone], dict[str, bytes]]] = {
    "slicer": slicer_files,
    "igtl": igtl_files,
    "ros2": ros2_files,
}


def _refuse_untrusted(bone: RegisteredBone) -> None:
    if wrong := failed(bone.checks):
        raise UnusableInputError(
            f"checks of the bone's pose failed, so it is no message for a machine: {wrong[0].name}; register it again"
        )
