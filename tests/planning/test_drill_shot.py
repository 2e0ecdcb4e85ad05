"""Shots while drilling: errors and decisions against truth, for a block that moved with the arm; bad shots."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from tests.planning.shots import Wire
from tests.planning.test_check_shot import MARK_PX, MARKS, PLAN, shows, wire_in

import sightline as sl
from sightline.calibration import BeadView
from sightline.common.checks import Limits, failed
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.frame import Frame
from sightline.planning import Plan, kind, plan
from sightline.planning.check.adjustment import on_patient
from sightline.planning.check.shot import ALIGNED, PAUSED, DrillShot, Landmarks, drill_shot
from sightline.planning.check.wires import Beforehand
from sightline.studies.scenes import VIEWS, measure
from sightline.twin import SetUp, draw_setup
from sightline.twin.objects.things import BoneMotion, draw_motion

BLOCK = Frame.load("block60")
LENGTH_MM = float(np.linalg.norm(PLAN[1] - PLAN[0]))
FROM_MM = {ALIGNED: (-58.0, -20.0), PAUSED: (-20.0, LENGTH_MM - 10.0)}  # the wire that the images show, and its tip
# By which the block's place is not what encoders say, s.d.: rad about the plan's middle, mm there.
ENCODERS_SD = np.array([6e-4] * 3 + [0.13] * 3)


@dataclass(frozen=True, eq=False)
class Taken:
    """A plan, two images while drilling, and the true deviation (5,) of the wire in the axes of the plan."""

    made: Plan
    before: list[BeadView]
    after: list[BeadView]
    wires: list[Wire]
    landmarks: Landmarks
    known: Beforehand
    tip_mm: float
    line_mm: np.ndarray
    planned_mm: np.ndarray

    def shot(self, **others) -> DrillShot:
        given = vars(self) | others
        return drill_shot(
            replace(self.made.to_check(self.before), limits=Limits()),
            given["after"],
            given["wires"],
            tip_mm=given["tip_mm"],
            known=given["known"],
            landmarks=given["landmarks"],
        )

    def error(self, shot: DrillShot) -> np.ndarray:
        """(7,): deviations stated less true ones: entry, tip, depth, end. The plan is what its picks show."""
        (start, tip), planned = self.line_mm, self.planned_mm
        along = (planned[1] - planned[0]) / LENGTH_MM
        way = (tip - start) / ((tip - start) @ along)
        entry, end = (start + way * ((at - start) @ along) for at in planned)
        depth = (tip - planned[0]) @ along
        scale = LENGTH_MM / self.made.trajectory.length_mm  # the expected tip lies on the picks' line
        short = (tip - planned[1]) @ along - scale * self.tip_mm + LENGTH_MM
        off = [entry - planned[0], tip - planned[0] - depth * along, end - planned[1]]
        true = [shot.wire.across @ one for one in off]
        stated = np.concatenate([shot.wire.deviation_mm, shot.end_mm])
        return stated - np.concatenate([*true[:2], [short], true[2]])


def drawn(rng: np.random.Generator, xyz: np.ndarray, frame: Frame = BLOCK) -> SetUp:
    while True:
        setup = draw_setup(rng, frame)
        if shows(setup, xyz):
            return setup


def taken(
    seed: int, state: str, off_mm: float = 0.3, bone: BoneMotion | None = None, frame: Frame | None = None
) -> Taken:
    """Draw a shot of a wire that lies off its plan by `off_mm` per axis at entry and end.

    `frame`: fixed to the patient in the shot, anywhere: encoders do not know where. Without it the plan's block.
    """
    rng = np.random.default_rng([seed, state == PAUSED])
    hip = draw_setup(np.random.default_rng(0), BLOCK).hip_mm
    points, marks = PLAN + hip, MARKS + hip
    along = (points[1] - points[0]) / LENGTH_MM
    middle = points.mean(axis=0)
    ends = points + rng.normal(0.0, off_mm, (2, 3))
    line = ends[0] + np.outer(np.array(FROM_MM[state]) / LENGTH_MM, ends[1] - ends[0])
    arm = draw_motion(rng, middle, BoneMotion(4.0, np.deg2rad(3.0)) if frame is None else BoneMotion(20.0, 0.3))
    at = arm.apply(middle)
    unseen = draw_motion(rng, at, bone or BoneMotion())
    size = ENCODERS_SD * rng.standard_normal(6)
    rotation = Rotation.from_rotvec(size[:3])
    motion = RigidTransform.from_components(at + size[3:] - rotation.apply(at), rotation) * unseen * arm
    first = drawn(rng, np.concatenate([points, marks]))
    shown = motion.apply(np.concatenate([line[1:], marks]))
    second = replace(drawn(rng, shown), true_frame=first.true_frame) if frame is None else drawn(rng, shown, frame)
    views = []
    for setup, held in ((first, BLOCK), (second, frame or BLOCK)):
        seen = measure(rng, setup, 0.05)
        views.append([sl.calibrate(seen[name], held, view=name) for name in VIEWS])
    picks = np.array([first.views[name].project(points) for name in VIEWS])
    found = (
        np.array([setup.views[name].project(xyz) for name in VIEWS]) + MARK_PX * rng.standard_normal((2, len(marks), 2))
        for setup, xyz in ((first, marks), (second, motion.apply(marks)))
    )
    curve = motion.apply(line[0] + np.linspace(0.0, 1.0, 101)[:, None] * (line[1] - line[0]))
    landmarks, straight = Landmarks(*found, MARK_PX), state == ALIGNED
    moved = Beforehand(arm, np.diag(ENCODERS_SD**2), straight=straight)
    return Taken(
        plan(views[0], picks[:, 0], picks[:, 1], procedure=kind("free-wire")),
        *views,
        [wire_in(rng, second, name, curve) for name in VIEWS],
        landmarks,
        moved if frame is None else on_patient((views[0], views[1]), landmarks, straight=straight),
        float((line[1] - points[0]) @ along),
        line,
        points,
    )


def scatter(state: str, count: int, frame: Frame | None = None, **others) -> tuple[np.ndarray, np.ndarray]:
    """Return chi-squares (count,) of the five deviations, and depth errors over their s.d. (count,)."""
    squares, depths = [], []
    for seed in range(count):
        one = taken(500 + seed, state, frame=frame)
        shot = one.shot(**others)
        error = one.error(shot)
        squares.append(error[:5] @ np.linalg.solve(shot.wire.covariance_mm2, error[:5]))
        depths.append(error[4] / shot.depth_sd_mm)
    return np.array(squares), np.array(depths)


@pytest.mark.slow
@pytest.mark.parametrize(("state", "marked", "frame"), [(ALIGNED, False, None), (PAUSED, True, "block40")])
def test_errors_are_those_stated(state, marked, frame):
    """Without landmarks, where only encoders and a leg assumed still tell where the bone is, and with
    another block on the patient, of which shared errors of the frame would be wrong."""
    on_patient = None if frame is None else Frame.load(frame)
    squares, depths = scatter(state, 12, on_patient, **({} if marked else {"landmarks": Landmarks()}))
    # Mean of 12 chi-squares of 5 degrees of freedom over 5: 1 ± 0.18; rms of 12 normal numbers: 1 ± 0.2.
    assert 0.55 < squares.mean() / 5 < 1.5
    assert 0.55 < np.sqrt((depths**2).mean()) < 1.45


def test_another_frame_on_the_patient_goes_and_stops_and_needs_landmarks_and_a_person_who_says_so():
    one, off = (taken(5, PAUSED, off, frame=Frame.load("block40")) for off in (0.3, 2.5))
    shot = one.shot()
    assert shot.decision == "GO", [check.sentence for check in failed(shot.verdict.checks)]
    assert np.linalg.norm(one.error(shot)[5:]) < 1.5 * shot.end_error_95_mm
    assert off.shot().decision == "STOP"
    two = Landmarks(one.landmarks.planned_uv_px[:, :2], one.landmarks.checked_uv_px[:, :2], MARK_PX)
    with pytest.raises(UnusableInputError, match="find 3 landmarks of the bone or more in all four images, not 2"):
        on_patient((one.before, one.after), two, straight=False)
    with pytest.raises(ReconstructionRefusedError, match="whose coordinates differ"):
        one.shot(known=replace(one.known, by_landmarks=False))


@pytest.fixture(scope="module")
def aligned() -> Taken:
    return taken(1, ALIGNED)


@pytest.fixture(scope="module")
def paused() -> Taken:
    return taken(2, PAUSED)


@pytest.mark.parametrize("state", [ALIGNED, PAUSED])
def test_a_wire_within_its_limits_goes_and_its_depth_is_measured(state, aligned, paused):
    one = aligned if state == ALIGNED else paused
    shot = one.shot()
    assert (shot.state, shot.decision) == (state, "GO"), [check.sentence for check in failed(shot.verdict.checks)]
    assert shot.depth_mm == pytest.approx(one.tip_mm, abs=4 * shot.depth_sd_mm)
    assert 0.02 < shot.depth_sd_mm < 0.2
    names = {check.name for check in shot.verdict.checks}
    assert {"wire entry", "wire ahead", "wire direction", "wire depth"} <= names
    assert "wire tip" not in names
    document = shot.document()
    assert (document["state"], document["decision"]) == (state, "GO")


def test_the_end_ahead_is_that_of_the_line_drilled_on(aligned, paused):
    for one in (aligned, paused):
        shot = one.shot()
        assert np.linalg.norm(one.error(shot)[5:]) < 1.5 * shot.end_error_95_mm
        assert np.linalg.norm(shot.end_mm - one.error(shot)[5:]) > 0.1  # the wire is off its plan


def test_a_block_that_moved_on_its_mount_is_tied_to_the_bone_by_landmarks_alone(paused):
    """3 mm on the mount: landmarks make up for it. Without them the shot never says GO."""
    moved = replace(paused.known, movement=RigidTransform.from_translation([3.0, 0.0, 0.0]) * paused.known.movement)
    same, other = paused.shot(), paused.shot(known=moved)
    np.testing.assert_allclose(other.wire.deviation_mm, same.wire.deviation_mm, atol=0.02)
    assert paused.shot(known=moved, landmarks=Landmarks()).decision != "GO"
    assert paused.shot(landmarks=Landmarks()).decision == "INCOMPLETE"


def test_a_wire_off_its_plan_stops():
    shot = taken(3, PAUSED, off_mm=2.5).shot()
    assert shot.decision == "STOP"
    assert {"wire entry", "wire ahead"} & {check.name for check in failed(shot.verdict.checks)}


def test_an_image_of_another_moment_stops(paused):
    """The wire was fed on by 5 mm after the robot's depth was read, or before it."""
    for late_mm in (-5.0, 5.0):
        shot = paused.shot(tip_mm=paused.tip_mm + late_mm)
        assert shot.decision == "STOP"
        assert "wire depth" in {check.name for check in failed(shot.verdict.checks)}


def test_an_image_of_each_moment_is_refused_or_stops(aligned, paused):
    mixed = [paused.after[0], aligned.after[1]], [paused.wires[0], aligned.wires[1]]
    try:
        shot = paused.shot(after=mixed[0], wires=mixed[1])
    except ReconstructionRefusedError:
        return
    assert shot.decision == "STOP"


def test_a_bent_wire_in_its_guide_stops(aligned):
    """2 mm of bow over the 38 mm shown: the tip's direction is not the guide's."""
    wires = []
    for wire in aligned.wires:
        way = wire.tip_uv_px - wire.uv_px[0]
        share = (wire.uv_px - wire.uv_px[0]) @ way / (way @ way)
        across = np.array([-way[1], way[0]]) / np.linalg.norm(way)
        wires.append(replace(wire, uv_px=wire.uv_px + (4 * 8.0 * share * (1 - share))[:, None] * across))
    shot = aligned.shot(wires=wires)
    assert shot.decision == "STOP"
    assert "check shot residuals" in {check.name for check in failed(shot.verdict.checks)}


def test_a_tip_at_the_entry_is_refused(paused):
    """No line to the end follows from it, and the robot's state of no motion is a tip at zero."""
    with pytest.raises(UnusableInputError, match="take the shot before it or deeper"):
        paused.shot(tip_mm=0.0)
