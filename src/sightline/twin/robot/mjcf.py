"""An arm as a MuJoCo model (MJCF): drives, play and springs behind the encoders, masses. SI units inside."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import SetUpError
from sightline.robot.kinematics.manipulator import Manipulator

M = 1e-3  # a millimetre
STEP_S = 0.001
# Values of the machine, as in `Build`, [ours] unless computed.
DRIVE_HZ = 80.0  # bandwidth of a drive's position loop, critically damped
SPRING_DAMPING = 0.1  # of critical damping, from bolted joints and grease in the gears
MAX_PHASE = 1.5  # rad of a spring's oscillation per time step; beyond 2 it is unstable [calc]
HARD_STOP = (2.0, float(np.deg2rad(0.5)))  # distance beyond a soft limit: mm, rad
# Of arms that hold a guide, by their number of joints: each link's mass, kg [src: Universal Robots, "DH Parameters for
# calculations of kinematics and dynamics"; src: franka_description, fr3/inertials.yaml], and each motor's inertia at
# its joint, kg m² [ours; src: Drake, reflected inertia of the FR3]. The guide with a frame weighs HELD_KG [ours].
LINKS_KG = {6: (3.761, 8.058, 2.846, 1.37, 1.3, 0.365), 7: (2.927, 2.936, 2.245, 2.616, 2.327, 1.817, 0.627)}
MOTORS_KG_M2 = {6: (0.6, 0.6, 0.6, 0.2, 0.2, 0.2), 7: (0.606, 0.606, 0.462, 0.462, 0.206, 0.206, 0.206)}
LINK_MM, HELD_KG, HELD_MM, HELD_AT_MM = 100.0, 3.0, 250.0, (0.0, 130.0, 130.0)
# Torque, N m, with which such an arm resists beyond gravity, for each joint from the base [ours]: as a collaborative
# arm it gives way, to 39 to 56 N across the guide's mouth at a hip [calc].
YIELDS_N_M = {6: (30.0, 30.0, 26.0, 16.0, 14.0, 5.5), 7: (32.0, 30.0, 32.0, 26.0, 13.0, 14.0, 5.5)}


@dataclass(frozen=True)
class Weight:
    """A box of uniform density. `at_mm`: its centre in MCS at q = 0; `size_mm`: its edges along MCS."""

    kg: float
    at_mm: tuple[float, float, float]
    size_mm: tuple[float, float, float]


@dataclass(frozen=True)
class Build:
    """Masses and drives of an arm; by default of the manipulator: machined aluminium, a surgical drill, a frame of
    acrylic plates.

    `weights`: of each joint's own link; `frame`: on the flange; `drive_inertia`: of a motor at its joint, kg and kg m²;
    `drive_force`: maximum of a drive, N and N m; with `carries_itself` beyond what gravity takes, which the arm's own
    controller adds. `gravity` m/s², MCS.
    """

    weights: tuple[Weight, ...] = (
        Weight(12.0, (120.0, 0.0, 300.0), (120.0, 160.0, 200.0)),
        Weight(6.0, (200.0, 0.0, 300.0), (100.0, 120.0, 120.0)),
        Weight(3.0, (250.0, 0.0, 300.0), (90.0, 90.0, 140.0)),
        Weight(3.0, (300.0, 0.0, 290.0), (260.0, 80.0, 60.0)),
        Weight(2.0, (280.0, 0.0, 260.0), (180.0, 60.0, 60.0)),
    )
    frame: Weight = Weight(3.0, (480.0, 0.0, 380.0), (300.0, 200.0, 250.0))
    drive_inertia: tuple[float, ...] = (60.0, 40.0, 1.0, 1.0, 10.0)
    drive_force: tuple[float, ...] = (1000.0, 400.0, 60.0, 60.0, 200.0)
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    carries_itself: bool = False

    @staticmethod
    def of(robot: Manipulator) -> "Build":
        """Return what the twin has for an arm: the manipulator's, or for six or seven joints without a feed that of a
        collaborative arm. Raises SetUpError for others."""
        if robot.has_feed:
            return Build()
        if robot.count not in LINKS_KG:
            raise SetUpError(f"the twin has no masses for an arm of {robot.count} joints without a feed; give a Build")
        home, kg = robot.T_mcs_flange_home, LINKS_KG[robot.count]
        links = [_box(mass, home.apply(part.ends_mm)) for mass, part in zip(kg, robot.parts, strict=False)]
        held = Weight(HELD_KG, _triple(home.apply(HELD_AT_MM)), (HELD_MM, HELD_MM, HELD_MM))
        motors, force = MOTORS_KG_M2[robot.count], YIELDS_N_M[robot.count]
        return Build(tuple(links), held, motors, force, carries_itself=True)


def _box(kg: float, ends_mm: np.ndarray) -> Weight:
    """Return a box around a link's axis (2, 3)."""
    return Weight(kg, _triple(ends_mm.mean(axis=0)), _triple(np.abs(ends_mm[1] - ends_mm[0]) + LINK_MM))


def _triple(xyz: Sequence[float] | np.ndarray) -> tuple[float, float, float]:
    x, y, z = map(float, xyz)
    return x, y, z


def mjcf(robot: Manipulator, build: Build) -> str:
    """Return the model. The frames of all bodies coincide with MCS at q = 0, so each joint is its screw axis unchanged.

    Joints: `lift` and so on are measured by the encoders, `lift-behind` and so on are not; `column` is the bending of a
    column, which an arm on a rigid base has not.
    Sites: `flange`, `cfcs`, `tool`. Raises SetUpError for springs that are too stiff for the time step.
    """
    home = robot.T_mcs_flange_home
    sites = [""] * robot.count
    sites[robot.arm_joints - 1] = _site("flange", home) + _site("cfcs", home * robot.T_flange_cfcs)
    sites[-1] += _site("tool", home * robot.T_flange_tool)
    inertia = _carried(robot, build)
    _check_stiffness(robot, build, inertia)
    bodies = ""
    for joint in reversed(range(robot.count)):
        held = (build.frame,) if joint == robot.arm_joints - 1 else ()
        load, own = _inertial(build.weights[joint], *held), _joint(robot, build, joint, inertia[joint])
        bodies = f'<body name="{robot.joints[joint]}-link">{load}{own}{sites[joint]}{bodies}</body>'
    bends = ""
    if np.isfinite(robot.column_stiffness):  # its damping is for the mass that it carries at its top
        column = robot.column_stiffness / M
        damping = 2 * SPRING_DAMPING * float(np.sqrt(column * inertia[0]))
        bends = f'<joint name="column" type="slide" axis="1 0 0" stiffness="{column!r}" damping="{damping!r}"/>'
    return f"""<mujoco model="manipulator">
<compiler angle="radian"/>
<option timestep="{STEP_S}" integrator="implicitfast" gravity="{_row(build.gravity)}">
<flag contact="disable"/></option>
<worldbody><body name="column"><inertial pos="0 0 0.2" mass="20" diaginertia="1 1 1"/>
{bends}
{bodies}</body></worldbody>
<tendon>{"".join(_play(robot, joint) for joint in range(robot.count))}</tendon>
<actuator>{"".join(_drives(robot, build, inertia))}</actuator>
</mujoco>"""


def units(robot: Manipulator) -> np.ndarray:
    """SI units (n,) per unit of each joint."""
    return np.where(robot.rotary, 1.0, M)


def _check_stiffness(robot: Manipulator, build: Build, inertia: list[float]) -> None:
    for joint, load in enumerate(inertia):
        reduced = 1 / (1 / load + 1 / build.drive_inertia[joint])
        phase = np.sqrt(_spring(robot, joint) / reduced) * STEP_S
        if phase > MAX_PHASE:
            raise SetUpError(
                f"the {robot.joints[joint]}'s spring of {robot.stiffness[joint]:g} oscillates by {phase:.1f} rad per "
                f"time step (limit {MAX_PHASE:g}): make the spring softer or its load heavier"
            )


def _spring(robot: Manipulator, joint: int) -> float:
    """Return the stiffness of a joint in N/m, or N m/rad."""
    return float(robot.stiffness[joint]) * (M if robot.rotary[joint] else 1 / M)


def _carried(robot: Manipulator, build: Build) -> list[float]:
    """Return the mass, kg, or inertia, kg m², that each joint moves at q = 0, without its drive."""
    carried = []
    for joint in range(robot.count):
        loads = [*build.weights[joint:], *([build.frame] if joint < robot.arm_joints else [])]
        if not robot.rotary[joint]:
            carried.append(sum(load.kg for load in loads))
            continue
        axis, moment = robot.axes[joint, :3], robot.axes[joint, 3:]
        arm = [np.linalg.norm(np.cross(np.array(load.at_mm) - np.cross(axis, moment), axis)) * M for load in loads]
        carried.append(float(sum(load.kg * a**2 for load, a in zip(loads, arm, strict=True))))
    return carried


def _joint(robot: Manipulator, build: Build, joint: int, inertia: float) -> str:
    axis = robot.axes[joint]
    turning, unit = bool(robot.rotary[joint]), units(robot)[joint]
    direction = axis[:3] if turning else axis[3:]
    place = np.cross(axis[:3], axis[3:]) * M
    form = f'type="{"hinge" if turning else "slide"}" axis="{_row(direction)}" pos="{_row(place)}"'
    stop = HARD_STOP[turning]
    low, high = (robot.lower[joint] - stop) * unit, (robot.upper[joint] + stop) * unit
    force = build.drive_force[joint]
    damping = 2 * SPRING_DAMPING * np.sqrt(_spring(robot, joint) * inertia)
    limits = f'limited="true" range="{_row((low, high))}"'
    limits += f' actuatorfrclimited="true" actuatorfrcrange="{_row((-force, force))}"'
    return (
        f'<joint name="{robot.joints[joint]}" {form} {limits} armature="{build.drive_inertia[joint]!r}"/>'
        f'<joint name="{robot.joints[joint]}-behind" {form} damping="{float(damping)!r}"/>'
    )


def _play(robot: Manipulator, joint: int) -> str:
    """Return a spring with a dead band: within its play the joint is free."""
    name, half = robot.joints[joint], float(robot.backlash[joint]) / 2 * units(robot)[joint]
    band = f'stiffness="{_spring(robot, joint)!r}" springlength="{_row((-half, half))}"'
    return f'<fixed name="{name}-play" {band}><joint joint="{name}-behind" coef="1"/></fixed>'


def _drives(robot: Manipulator, build: Build, inertia: list[float]) -> list[str]:
    """Return for each joint a loop on the integral of the commanded velocity, then for each a loop on the velocity."""
    pace, reach = 2 * np.pi * DRIVE_HZ, 10.0  # `reach` has no effect: the plant keeps the reference near the joint
    mass = [drive + load for drive, load in zip(build.drive_inertia, inertia, strict=True)]
    place = [
        f'<intvelocity joint="{joint}" kp="{float(kg * pace**2)!r}" actrange="{_row((-reach, reach))}"/>'
        for joint, kg in zip(robot.joints, mass, strict=True)
    ]
    return place + [
        f'<velocity joint="{joint}" kv="{float(2 * kg * pace)!r}"/>'
        for joint, kg in zip(robot.joints, mass, strict=True)
    ]


def _site(name: str, pose: RigidTransform) -> str:
    x, y, z, w = pose.rotation.as_quat()
    return f'<site name="{name}" pos="{_row(pose.translation * M)}" quat="{_row((w, x, y, z))}"/>'


def _inertial(*loads: Weight) -> str:
    """Return the combined inertia of several boxes."""
    kg = sum(load.kg for load in loads)
    at = np.array([load.at_mm for load in loads]) * M
    mass = np.array([load.kg for load in loads])
    middle = mass @ at / kg
    full = np.zeros((3, 3))
    for load, place in zip(loads, at, strict=True):
        edge2, arm = (np.array(load.size_mm) * M) ** 2, place - middle
        full += load.kg * (np.diag(edge2.sum() - edge2) / 12 + arm @ arm * np.eye(3) - np.outer(arm, arm))
    six = full[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return f'<inertial pos="{_row(middle)}" mass="{kg!r}" fullinertia="{_row(six)}"/>'


def _row(numbers) -> str:
    """Format numbers for MJCF with all digits."""
    return " ".join(repr(float(number)) for number in numbers)
