"""Arms from model files: MJCF or URDF, read by MuJoCo."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.common.bounded import MAX_TEXT_BYTES, read_bounded
from sightline.common.mujoco import import_mujoco
from sightline.errors import UnusableInputError
from sightline.robot.kinematics.designs import ARM_PLAY_RAD, ARM_SPEED_RAD_S, ARM_STIFFNESS, GUIDE_MM
from sightline.robot.kinematics.manipulator import Capsule, Manipulator

# Of a joint that moves straight, as of the manipulator (docs/robot.md) [ours]; a model file states none of them.
SLIDE_SPEED_MM_S, SLIDE_PLAY_MM, SLIDE_STIFFNESS = 20.0, 0.01, 2e3
RESOLUTION_RAD, RESOLUTION_MM = 2 * np.pi / 2**19, 0.005  # [ours, typical]
_M = 1e3  # mm in a metre
# MuJoCo's numbers of types [src: mjmodel.h, mjtJoint and mjtGeom].
_SLIDE, _HINGE = 2, 3
_PLANE, _HEIGHTS, _SPHERE, _CAPSULE = 0, 1, 2, 3


def read_arm(model_file: Path, flange: str, feed: str | None = None) -> Manipulator:
    """Return the arm in an MJCF or URDF file, MCS: the model's world; `flange` names the body that carries guide and
    block, `feed` the joint that feeds the wire, if there is one.

    Joints that the flange hangs on are the arm's; others stay at 0. Guide and frame lie on the flange's axes until they
    are calibrated. Speeds, play and stiffness are as of the built-in arms. Raises UnusableInputError for a file that is
    not a serial arm with limited joints, SetUpError without MuJoCo.
    """
    mujoco = import_mujoco("an arm from a model file")
    read_bounded(model_file, MAX_TEXT_BYTES, UnusableInputError, "give an MJCF or URDF file")
    try:
        model = mujoco.MjModel.from_xml_path(str(model_file))
    except ValueError as error:
        raise UnusableInputError(f"{model_file.name} is not a model that MuJoCo reads: {str(error)[:300]}") from error
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, flange)
    if body < 0:
        names = ", ".join(model.body(k).name for k in range(1, model.nbody))
        raise UnusableInputError(f"{model_file.name} has no body {flange!r}; it has {names}")
    chain = _joints_to(model, body)
    if feed is not None:
        chain.append(_named_feed(mujoco, model, feed))
    for joint in chain:
        if model.jnt_type[joint] not in (_HINGE, _SLIDE):
            raise UnusableInputError(
                f"joint {model.joint(joint).name!r} neither rotates about nor moves along one axis"
            )
        if not model.jnt_limited[joint]:
            raise UnusableInputError(
                f"joint {model.joint(joint).name!r} has no limits; state them in {model_file.name}"
            )
    if not chain:
        raise UnusableInputError(f"no joint moves the body {flange!r} of {model_file.name}")
    return _arm(model, data, body, chain, has_feed=feed is not None)


def _arm(model: Any, data: Any, flange: int, chain: list[int], *, has_feed: bool) -> Manipulator:
    rotary = model.jnt_type[chain] == _HINGE
    axis, anchor = data.xaxis[chain], data.xanchor[chain] * _M
    axes = np.where(rotary[:, None], np.hstack([axis, np.cross(anchor, axis)]), np.hstack([0 * axis, axis]))
    limits = model.jnt_range[chain] * np.where(rotary, 1.0, _M)[:, None]
    turned = Rotation.from_quat(data.xquat[flange], scalar_first=True)
    home = RigidTransform.from_components(data.xpos[flange] * _M, turned)
    speed = np.where(rotary, ARM_SPEED_RAD_S, SLIDE_SPEED_MM_S)
    return Manipulator(
        joints=tuple(model.joint(joint).name or f"joint {k + 1}" for k, joint in enumerate(chain)),
        axes=axes,
        has_feed=has_feed,
        T_mcs_flange_home=home,
        T_flange_tool=RigidTransform.identity(),
        T_flange_cfcs=RigidTransform.identity(),
        lower=limits[:, 0],
        upper=limits[:, 1],
        speed=speed,
        acceleration=10 * speed,
        resolution=np.where(rotary, RESOLUTION_RAD, RESOLUTION_MM),
        backlash=np.where(rotary, ARM_PLAY_RAD, SLIDE_PLAY_MM),
        stiffness=np.where(rotary, ARM_STIFFNESS, SLIDE_STIFFNESS),
        column_stiffness=np.inf,
        parts=_parts(model, data, chain, home),
        guide_mm=0.0 if has_feed else GUIDE_MM,
    ).with_mounts(RigidTransform.identity(), RigidTransform.identity())


def _joints_to(model: Any, body: int) -> list[int]:
    """Return the joints between the world and a body, from the world."""
    chain: list[int] = []
    while body > 0:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        chain = [*range(first, first + count), *chain]
        body = int(model.body_parentid[body])
    return chain


def _named_feed(mujoco: Any, model: Any, feed: str) -> int:
    joint = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, feed))
    if joint < 0 or model.jnt_type[joint] != _SLIDE:
        raise UnusableInputError(f"the feed {feed!r} is not a joint of the model that moves straight")
    return joint


def _parts(model: Any, data: Any, chain: list[int], home: RigidTransform) -> tuple[Capsule, ...]:
    """Return a capsule about each geometry that takes part in collisions, or about all where none does."""
    solid = np.flatnonzero((model.geom_contype | model.geom_conaffinity) > 0)
    parts = []
    for geom in (solid if len(solid) else np.arange(model.ngeom)).tolist():
        if model.geom_type[geom] in (_PLANE, _HEIGHTS):
            continue
        body = int(model.geom_bodyid[geom])
        carried = _joints_to(model, body)
        centre, half = model.geom_aabb[geom, :3] * _M, model.geom_aabb[geom, 3:] * _M
        long = int(np.argmax(half))
        round_ = model.geom_type[geom] in (_CAPSULE, _SPHERE)
        across = np.delete(half, long)
        radius = float(across.max() if round_ else np.hypot(*across))
        reach = np.eye(3)[long] * max(float(half[long]) - (radius if round_ else 0.0), 0.0)
        pose = RigidTransform.from_components(
            data.geom_xpos[geom] * _M, Rotation.from_matrix(data.geom_xmat[geom].reshape(3, 3))
        )
        ends = home.inv().apply(pose.apply(np.stack([centre - reach, centre + reach])))
        moved = sum(joint in carried for joint in chain)
        parts.append(Capsule(model.body(body).name or "base", moved, ends, radius))
    return tuple(parts)
