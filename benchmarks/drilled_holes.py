"""Both distal holes of a nail drilled by the robot: 300 holes with `block30` on the drill guide.

Edges as points (scenes/nails.py), both holes in one plan, the robot registered by its own wire in the same images; the
second hole is planned on the same images again. Targets and refusals are the robot's own functions. The arm's play and
deflection are drawn from what its calibration states, the drill is the twin's `Wire` in a bone's shaft: no link, no
real time. A drill passes if it touches neither wall of the nail: 4 mm in holes of 5 mm leave 0.5 mm.
"""

from collections import Counter
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

import sightline as sl
from benchmarks.harness import Refusal, Rows, spread, trials
from benchmarks.scenes.blocks import BEAD_PX
from benchmarks.scenes.nails import Sight, seen
from sightline.calibration import CalibratedView
from sightline.errors import RefusedError
from sightline.frame import Frame
from sightline.planning import Nail, WirePicks, WirePlans, fit_hole, plan_wires
from sightline.rehearsal.operation import SHOWN_FEED_MM, calibrated_robot, drawn_robot, registered, shown_wire_mm
from sightline.robot.kinematics.calibrated import CalibratedRobot
from sightline.robot.kinematics.manipulator import FEED, Manipulator, imaging_yaw
from sightline.robot.kinematics.target import PlanIdentity, RobotTarget, robot_target
from sightline.studies.scenes import calibrated_views, measure
from sightline.twin import SetUp, draw_setup
from sightline.twin.anatomy.nailed_femur import CORTEX_MM, SPACING_MM, DistalNail
from sightline.twin.objects.volumes import Volume
from sightline.twin.robot.drilling import Bone, Wire

NAILS = 150  # of two holes each
HALF_ANGLE_DEG = 16.0  # of the views of a block, to either side of the hole: both see through it
SIDE, PICK_PX, DRILL_MM = "right", 0.5, 4.0
MIN_PASSED = 0.97
# The leg lies across the drill at the images: the drill points from lateral and cranial at 45° in the frame's axes.
DRILL = np.array([-1.0, -1.0, 0.0]) / np.sqrt(2.0)
NAIL_ALONG = np.array([-1.0, 1.0, 0.0]) / np.sqrt(2.0)  # caudal
SHOWN_BEHIND_MM = (40.0, 0.0)  # points of the robot's own wire that are picked, behind its tip
SLEEVE_MM, VOXEL_MM, STEP_MM, STEP_S = 5.0, 0.75, 0.1, 0.1  # the sleeve's distance from the bone; 1 mm/s
CASES = (("block30", "images"), ("block30", "encoders"), ("gamma", "encoders"))


def drilled(quick: bool) -> Rows:
    """Return the rows; the first case is judged."""
    rows, number = Rows("drilled holes"), NAILS // 10 if quick else NAILS
    results = trials(_trial, product(CASES, range(number)))
    for k, (frame, by) in enumerate(CASES):
        of_case = results[k * number : (k + 1) * number]
        holes = [hole for pair in of_case for hole in ([pair] * 2 if isinstance(pair, Refusal) else pair)]
        done = np.array([hole for hole in holes if not isinstance(hole, Refusal)]).reshape(-1, 2)
        reasons = Counter(str(hole).split(":")[0] for hole in holes if isinstance(hole, Refusal)).most_common()
        name = f"{len(holes)} holes, {frame}, registered by {by}"
        why = ", ".join(f"{count} {reason}" for reason, count in reasons)
        rows.add(f"{name}: refused", f"{len(holes) - len(done)} of {len(holes)}: {why}")
        if len(done):
            passed = int((done[:, 0] > 0).sum())
            asked, met = (f">= {MIN_PASSED:.0%}", passed >= MIN_PASSED * len(done)) if k == 0 else ("", None)
            what = "drills of 4 mm that touch neither wall of holes of 5 mm, of the accepted"
            rows.add(f"{name}: {what}", f"{passed} of {len(done)}", asked, met)
            rows.add(f"{name}: drill off the hole's axis, median / 95 %", spread(done[:, 1], "mm"))
    return rows


def known_nail(nail: DistalNail) -> Nail:
    """Return what the software is told of a nail: its nominal sizes."""
    return Nail(round(nail.diameter_mm), round(nail.hole_diameter_mm), nail.bore_mm, nail.material)


def _trial(case: tuple[tuple[str, str], int]) -> list[tuple[float, float] | Refusal]:
    """Return for both holes of a nail what is left between the drill and the walls, mm, and how far it is off the axis
    at the nail's surfaces; or why it was refused."""
    (frame, by), seed = case
    rng = np.random.default_rng([seed, 23, len(frame)])
    setup, views = _views(rng, Frame.load(frame))
    nail = _nail(rng, setup)
    plans = _planned(rng, setup, views, nail)
    arm = _Arm.draw(rng, setup)
    known = arm.corrected(rng, setup, views) if by == "images" else arm.known
    holes: list[tuple[float, float] | Refusal] = []
    for number, key in ((1, "distal"), (0, "proximal")):
        plan = plans.plans[key]
        identity = PlanIdentity(f"bench:{key}", SIDE, "1", plan.verdict.go, plan.kind.key)
        points, registration = plan.trajectory.points, registered(known, arm.imaged, 0.0)
        try:
            target = robot_target(identity, points.xyz_mm, points.budget_mm2, registration, plan.kind.limits)
            target.refuse_unfit(0.0)
        except RefusedError as refused:
            error = "error beyond 0.5 mm" if "error" in str(refused) else "out of reach"
            holes.append(Refusal(error if plan.verdict.go else "NO-GO"))
        else:
            holes.append(_against(arm.drilled_mm(rng, target, nail), nail, number))
    return holes


@dataclass(frozen=True, eq=False)
class _Arm:
    """The robot as calibrated, the true one, its encoders at the images (5,), and there the frame's true pose in MCS
    and the robot's own wire (2, 3), CFCS."""

    known: CalibratedRobot
    true: Manipulator
    imaged: np.ndarray
    T_mcs_cfcs: RigidTransform
    wire_mm: np.ndarray

    @staticmethod
    def draw(rng: np.random.Generator, setup: SetUp) -> "_Arm":
        known = calibrated_robot(SIDE, setup.frame)
        true, imaged = drawn_robot(known, imaging_yaw(SIDE), rng, 0.0 if setup.frame.solid is None else SHOWN_FEED_MM)
        joints = imaged + _play(rng, known)
        pose = true.T_mcs_flange(joints) * _bent(rng, known) * true.T_flange_cfcs
        return _Arm(known, true, imaged, pose, shown_wire_mm(true, joints, SHOWN_BEHIND_MM))

    def corrected(self, rng: np.random.Generator, setup: SetUp, views: list[CalibratedView]) -> CalibratedRobot:
        """Return the robot corrected by picks of its own wire in the images."""
        uv = np.stack([view.project(self.wire_mm) for view in setup.views.values()])
        covariance = np.broadcast_to(PICK_PX**2 * np.eye(2), (*uv.shape, 2))
        points = sl.reconstruct(views, uv + PICK_PX * rng.standard_normal(uv.shape), covariance)
        assert points.joint_covariance_mm2 is not None
        return self.known.with_wire_seen(self.imaged, points.xyz_mm, points.joint_covariance_mm2)

    def drilled_mm(self, rng: np.random.Generator, target: RobotTarget, nail: DistalNail) -> np.ndarray:
        """Return two points (2, 3), CFCS, of the drill once its tip is beyond the nail."""
        joints = target.q + _play(rng, self.known)
        flange = self.T_mcs_cfcs.inv() * self.true.T_mcs_flange(joints) * _bent(rng, self.known)
        tool = flange * self.true.T_flange_tool * RigidTransform.from_translation([0.0, 0.0, joints[FEED]])
        axes, tip, wire = tool.rotation.as_matrix().T, tool.translation, Wire(_shaft(nail), DRILL_MM)
        mouth = -CORTEX_MM[0] - SLEEVE_MM  # of the sleeve, before the lateral cortex
        for feed in np.arange(mouth, nail.diameter_mm + 3.0, STEP_MM):
            wire.step(tip + feed * axes[2], axes, feed - mouth, True, STEP_S)
        assert wire.entry_mm is not None
        return np.stack([wire.entry_mm, wire.tip_mm])


def _play(rng: np.random.Generator, robot: CalibratedRobot) -> np.ndarray:
    """Return errors of the joints (5,) from resolution and play, both uniform."""
    manipulator = robot.manipulator
    return (manipulator.resolution * rng.uniform(-1, 1, 5) + manipulator.backlash * rng.uniform(-1, 1, 5)) / 2


def _bent(rng: np.random.Generator, robot: CalibratedRobot) -> RigidTransform:
    return RigidTransform.from_exp_coords(robot.compliance_sd * rng.standard_normal(6))


def _views(rng: np.random.Generator, frame: Frame) -> tuple[SetUp, list[CalibratedView]]:
    """Draw a set-up and its calibrated views; those of a block look along the drill, from 16° to either side of it."""
    turns, beams = {"pa": -np.radians(HALF_ANGLE_DEG), "lateral": np.radians(HALF_ANGLE_DEG)}, None
    if frame.solid is not None:
        beams = {name: Rotation.from_rotvec(turn * NAIL_ALONG).apply(DRILL) for name, turn in turns.items()}
    setup = draw_setup(rng, frame, views=beams)
    return setup, calibrated_views(setup, measure(rng, setup, BEAD_PX))


def _nail(rng: np.random.Generator, setup: SetUp) -> DistalNail:
    """Draw a nail at the hip's place, its holes about along the drill. Sizes differ by 0.04 mm, 1 s.d."""
    along = Rotation.from_rotvec(rng.uniform(-0.09, 0.09, 3)).apply(NAIL_ALONG)
    axis = DRILL - (DRILL @ along) * along
    axis = Rotation.from_rotvec(rng.uniform(-0.1, 0.1) * along).apply(axis / np.linalg.norm(axis))
    made = 2 * Nail().sd_mm * rng.standard_normal(2)
    return DistalNail(
        setup.hip_mm + rng.uniform(-10.0, 10.0, 3) - SPACING_MM / 2 * along,
        along,
        axis,
        diameter_mm=float(rng.choice([10.0, 11.0, 12.0])) + made[0],
        hole_diameter_mm=5.0 + made[1],
        bend=float(np.deg2rad(rng.uniform(0.0, 2.0))),
        bend_angle=float(rng.uniform(-np.pi, np.pi)),
    )


def _planned(rng: np.random.Generator, setup: SetUp, views: list[CalibratedView], nail: DistalNail) -> WirePlans:
    """Return the plan of both holes; the nail's tip and a point beside it are picked as landmarks."""
    sights = {name: Sight(view.focal_point_mm, view.project) for name, view in setup.views.items()}
    lens = setup.frame.solid is not None
    holes = {
        key: fit_hole(views, seen(rng, nail, sights, number, lens=lens), known_nail(nail))
        for number, key in ((1, "distal"), (0, "proximal"))
    }
    marks = nail.placed(np.array([[0.0, 0.0, 40.0], [4.0, 0.0, 14.0]]))
    uv = np.stack([sight.project(marks) for sight in sights.values()])
    return plan_wires(
        views,
        {key: WirePicks.of_hole(hole, views) for key, hole in holes.items()},
        procedure="distal-interlocking",
        side=SIDE,
        landmarks_uv_px=uv + PICK_PX * rng.standard_normal(uv.shape),
    )


def _shaft(nail: DistalNail) -> Bone:
    """Return the femur's shaft around both holes, a tube, in CFCS."""
    axes, (outer, inner) = np.vstack([np.linalg.svd(nail.along[None])[2][1:], nail.along]), CORTEX_MM
    side = np.arange(-outer - 3.0, outer + 3.0, VOXEL_MM)
    radius = np.hypot(*np.meshgrid(side, side, indexing="ij"))
    share = np.clip((outer - radius) / VOXEL_MM + 0.5, 0, 1) * np.clip((radius - inner) / VOXEL_MM + 0.5, 0, 1)
    values = np.repeat(share[:, :, None], round((SPACING_MM + 20.0) / VOXEL_MM), axis=2)
    origin = nail.hole_mm + side[0] * axes[0] + side[0] * axes[1] - 10.0 * axes[2]
    return Bone((Volume(values, origin, np.full(3, VOXEL_MM), axes),), RigidTransform.identity())


def _against(line_mm: np.ndarray, nail: DistalNail, number: int) -> tuple[float, float]:
    point, axis = nail.holes[number]
    along = line_mm[1] - line_mm[0]
    along /= np.linalg.norm(along)
    ends = point + nail.diameter_mm / 2 * np.array([[-1.0], [1.0]]) * axis
    off = float(np.linalg.norm(np.cross(ends - line_mm[0], along), axis=1).max())
    drill = DRILL_MM / 2 / abs(float(along @ axis))  # an oblique drill's section is an ellipse
    return float(nail.hole_diameter_mm / 2 - drill - off), off
