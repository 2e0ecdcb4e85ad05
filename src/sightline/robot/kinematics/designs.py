"""Built-in arms: the manipulator of docs/robot.md, and a six-axis and a seven-axis arm that hold a drill guide."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import UnusableInputError
from sightline.robot.kinematics.manipulator import Capsule, Manipulator

# The manipulator [ours]: ball screws and geared rotations. The axes of yaw and pitch intersect in WRIST_MM at q = 0,
# MCS; in flange coordinates the tip at q = 0, ahead of the wrist and below it, and the hip, on the wire's axis and
# 150 mm ahead of the retracted tip.
JOINTS = ("lift", "traverse", "yaw", "pitch", "feed")
LIFT, TRAVERSE, YAW, PITCH, FEED = range(5)
WRIST_MM, TIP_MM, HIP_MM = (250.0, 0.0, 300.0), (0.0, -40.0, 250.0), (0.0, -40.0, 400.0)
WIRE_YAW_RAD = float(np.deg2rad(45.0))  # a wire of 135° to the shaft, seen from the robot beside the patient [paper]
# Flange axes at q = 0: z along the wire (MCS +X), y up, x along MCS +Y.
AHEAD = Rotation.from_matrix(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
# As drawn in docs/robot.md, flange coordinates: z along the wire, y up [ours]. The drill's body ends 200 mm behind the
# tip, the length of the wire [paper].
PARTS = (
    Capsule("column", 0, np.array([[0.0, -600.0, -220.0], [0.0, 200.0, -220.0]]), 80.0),
    Capsule("arm", 2, np.array([[0.0, 0.0, -200.0], [0.0, 0.0, 0.0]]), 60.0),
    Capsule("slide", FEED, np.array([[0.0, -40.0, -120.0], [0.0, -40.0, 120.0]]), 45.0),
    Capsule("drill", FEED + 1, np.array([[0.0, -40.0, -110.0], [0.0, -40.0, -40.0]]), 35.0),
    Capsule("chuck", FEED + 1, np.array([[0.0, -40.0, -40.0], [0.0, -40.0, 55.0]]), 15.0),
)

# Denavit-Hartenberg parameters in mm: standard ones (d, a, alpha) of the UR5e [src: Universal Robots, "DH Parameters
# for calculations of kinematics and dynamics"]; modified ones (a, alpha, d; the first two before the joint) of the
# Franka Research 3 [src: mujoco_menagerie, franka_fr3/fr3.xml], with its joint limits [src: franka_description,
# fr3/joint_limits.yaml]. The UR5e's joints turn by 360° to each side, its elbow by 180° [src:
# Universal_Robots_ROS2_Description, ur5e/joint_limits.yaml]; here all by UR5E_LIMIT_RAD, for drapes and cables [ours].
UR5E_DH = (
    (162.5, 0.0, np.pi / 2),
    (0.0, -425.0, 0.0),
    (0.0, -392.2, 0.0),
    (133.3, 0.0, np.pi / 2),
    (99.7, 0.0, -np.pi / 2),
    (99.6, 0.0, 0.0),
)
UR5E_LIMIT_RAD = np.pi
# Of the UR5e's links, how far they lie from the line between their joints' frames, along the axis of their own joint,
# mm: upper arm and forearm are mounted beside it [src: the same, ur5e/physical_parameters.yaml].
UR5E_ASIDE_MM = (0.0, 138.0, 7.0, 0.0, 0.0, 0.0)
FR3_DH = (
    (0.0, 0.0, 333.0),
    (0.0, -np.pi / 2, 0.0),
    (0.0, np.pi / 2, 316.0),
    (82.5, np.pi / 2, 0.0),
    (-82.5, -np.pi / 2, 384.0),
    (0.0, np.pi / 2, 0.0),
    (88.0, np.pi / 2, 0.0),
)
FR3_FLANGE_MM = 107.0
FR3_LOWER_RAD = (-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159)
FR3_UPPER_RAD = (2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159)
# Of both: speed in a theatre, a tenth of what they can do [ours]; play for a repeatability of 0.03 mm, 1 s.d., at a
# reach of 850 mm [src: data sheet of the UR5e]; stiffness behind encoders at the gears' output, N mm/rad [ours], the
# last three joints softer: 20 N across the guide's mouth move it by 0.2 to 0.4 mm [calc].
ARM_SPEED_RAD_S, ARM_PLAY_RAD, ARM_STIFFNESS, WRIST_STIFFNESS = np.deg2rad(15.0), 1.2e-4, 1.5e8, 2e7
LINK_RADIUS_MM = 60.0
# Mouth of the guide, flange coordinates, and the hip on its axis, so that the guide is held near its place at the
# images [ours]. The guide is beside the flange, so that a drill goes through it; GUIDE_MM is its length [ours].
MOUTH_MM, GUIDED_HIP_MM, GUIDE_MM = (0.0, -60.0, 240.0), (0.0, -60.0, 330.0), 120.0


def imaging_yaw(side: str) -> float:
    """Return the yaw, rad, at which the frame on its nominal mount is level and square to the patient."""
    return WIRE_YAW_RAD if side == "right" else -WIRE_YAW_RAD


def nominal_manipulator(
    side: str = "right", hip_mm: ArrayLike = (0.0, 0.0, 0.0), yaw_rad: float | None = None
) -> Manipulator:
    """Return the manipulator as designed, with a frame mounted for a hip of the patient's `side`.

    `hip_mm` (3,), CFCS: where the hip lies, at the origin of a Γ frame, beside a block. The robot stands beside the
    patient: +X medial, +Z anterior. The mount rotates the frame relative to the wire, so that its beams are level and
    upright at `yaw_rad`, by default that of a typical wire.
    """
    wrist = np.array(WRIST_MM)
    home = RigidTransform.from_components(wrist, AHEAD)
    up, sideways, ahead = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    axes = np.zeros((5, 6))
    axes[LIFT, 3:], axes[TRAVERSE, 3:], axes[FEED, 3:] = up, sideways, ahead
    for joint, axis in ((YAW, up), (PITCH, -sideways)):
        axes[joint] = np.concatenate([axis, np.cross(wrist, axis)])
    return Manipulator(
        joints=JOINTS,
        axes=axes,
        has_feed=True,
        T_mcs_flange_home=home,
        T_flange_tool=RigidTransform.from_translation(TIP_MM),
        T_flange_cfcs=_frame_mount(HIP_MM, side, hip_mm, yaw_rad),
        lower=_per_joint(-100.0, -60.0, -45.0, 0.0),
        upper=_per_joint(100.0, 60.0, 45.0, 250.0),
        speed=_per_joint(20.0, 10.0, 10.0, 20.0),
        acceleration=_per_joint(800.0, 400.0, 400.0, 800.0),  # from full speed to rest in 25 ms
        resolution=_per_joint(0.005, 360 / 2**17, 360 / 2**17, 0.005),
        backlash=_per_joint(0.01, 0.05, 0.05, 0.01),  # yaw and pitch as in the accuracy trial
        stiffness=np.array([2e3, 2e3, 5e7, 5e7, 1e3]),
        column_stiffness=1e3,
        parts=PARTS,
    )


def six_axis(side: str = "right", hip_mm: ArrayLike = (0.0, 0.0, 0.0), yaw_rad: float | None = None) -> Manipulator:
    """Return a six-axis arm that holds a drill guide, with the kinematics of a UR5e; arguments as of
    `nominal_manipulator`. MCS is its base; the flange's x and y are turned as the manipulator's."""
    links = [_link((a, 0.0, d), alpha) for d, a, alpha in UR5E_DH]
    limits, mount = np.full(6, UR5E_LIMIT_RAD), _frame_mount(GUIDED_HIP_MM, side, hip_mm, yaw_rad)
    return _guiding(links, RigidTransform.identity(), -limits, limits, mount, aside_mm=UR5E_ASIDE_MM)


def seven_axis(side: str = "right", hip_mm: ArrayLike = (0.0, 0.0, 0.0), yaw_rad: float | None = None) -> Manipulator:
    """Return a seven-axis arm that holds a drill guide, with the kinematics of a Franka Research 3; arguments as of
    `nominal_manipulator`."""
    first, *links = [_link((a, -d * np.sin(alpha), d * np.cos(alpha)), alpha) for a, alpha, d in FR3_DH]
    links.append(RigidTransform.from_translation([0.0, 0.0, FR3_FLANGE_MM]))
    lower, upper = np.array(FR3_LOWER_RAD), np.array(FR3_UPPER_RAD)
    mount = _frame_mount(GUIDED_HIP_MM, side, hip_mm, yaw_rad)
    return _guiding(links, first, lower, upper, mount, aside_mm=np.zeros(7))


Design = Literal["manipulator", "six-axis", "seven-axis"]
DESIGNS: dict[Design, Callable[..., Manipulator]] = {
    "manipulator": nominal_manipulator,
    "six-axis": six_axis,
    "seven-axis": seven_axis,
}


def _guiding(
    links: Sequence[RigidTransform],
    first: RigidTransform,
    lower: np.ndarray,
    upper: np.ndarray,
    mount: RigidTransform,
    *,
    aside_mm: ArrayLike,
) -> Manipulator:
    """Return an arm of rotary joints about the z axes of their frames at q = 0, from the pose of the `first` and the
    `links` from each to the next, the last one to the flange. `aside_mm`: as UR5E_ASIDE_MM."""
    frames = [first]
    for link in links:
        frames.append(frames[-1] * link)
    home, count = frames[-1], len(links)
    axes = np.array(
        [[*(z := frame.rotation.as_matrix()[:, 2]), *np.cross(frame.translation, z)] for frame in frames[:-1]]
    )
    lines = zip(pairwise(frames), axes[:, :3], np.asarray(aside_mm), strict=True)
    ends = [home.inv().apply(np.array([a.translation, b.translation]) + off * z) for (a, b), z, off in lines]
    parts = [Capsule(f"link {k + 1}", k + 1, end, LINK_RADIUS_MM) for k, end in enumerate(ends)]
    parts += [
        Capsule(f"joint {k + 2}", k + 1, np.array([a[1], b[0]]), LINK_RADIUS_MM)
        for k, (a, b) in enumerate(pairwise(ends))
        if np.linalg.norm(b[0] - a[1]) > LINK_RADIUS_MM
    ]
    every = np.ones(count)
    return Manipulator(
        joints=tuple(f"joint {k + 1}" for k in range(count)),
        axes=axes,
        has_feed=False,
        T_mcs_flange_home=home,
        T_flange_tool=RigidTransform.from_translation(MOUTH_MM),
        T_flange_cfcs=mount,
        lower=lower,
        upper=upper,
        speed=ARM_SPEED_RAD_S * every,
        acceleration=10 * ARM_SPEED_RAD_S * every,
        resolution=2 * np.pi / 2**19 * every,
        backlash=ARM_PLAY_RAD * every,
        stiffness=np.where(np.arange(count) < count - 3, ARM_STIFFNESS, WRIST_STIFFNESS),
        column_stiffness=np.inf,
        parts=tuple(parts),  # the guide is meant to touch the patient
        guide_mm=GUIDE_MM,
    )


def _link(translation_mm: ArrayLike, alpha_rad: float) -> RigidTransform:
    return RigidTransform.from_components(translation_mm, Rotation.from_rotvec([alpha_rad, 0.0, 0.0]))


def _frame_mount(ahead_mm: ArrayLike, side: str, hip_mm: ArrayLike, yaw_rad: float | None) -> RigidTransform:
    """Return the frame on a flange whose z axis lies along the wire, y up at the images: the hip lies `ahead_mm` (3,)
    in flange coordinates."""
    if side not in ("right", "left"):
        raise UnusableInputError(f"a hip's side is 'right' or 'left', not {side!r}")
    yaw = imaging_yaw(side) if yaw_rad is None else yaw_rad
    upright = Rotation.from_rotvec([0.0, 0.0, np.pi])  # CFCS in MCS: +X lateral, +Z up
    mount = (Rotation.from_rotvec([0.0, 0.0, yaw]) * AHEAD).inv() * upright
    return RigidTransform.from_components(np.asarray(ahead_mm) - mount.apply(hip_mm), mount)


def _per_joint(slide: float, yaw_deg: float, pitch_deg: float, feed: float) -> np.ndarray:
    """Return values per joint (5,): lift and traverse alike; degrees converted to rad."""
    return np.array([slide, slide, np.deg2rad(yaw_deg), np.deg2rad(pitch_deg), feed])
