"""`sightline robot drive --case`: shots given while the robot waits, measured against the plan, recorded and obeyed.

The images show the block and soft tissue. Wire and landmarks are picked, with noise, where the robot holds the wire.
"""

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from tests.cli.picked import picks_file, place
from tests.cli.picked import wire as wire_picks
from tests.cli.test_robot import run as robot
from tests.cli.test_robot import written
from tests.planning.test_drill_shot import drawn
from tests.robot.rig import END_MM, ENTRY_MM

from sightline.case.interop.plan_file import PlanFile
from sightline.case.journal import Case, Kind
from sightline.case.replay import ReplayOutcome, replay
from sightline.case.views import CHECK_NAMES
from sightline.cli.robot.drive import _show, _target
from sightline.frame import Frame
from sightline.imaging import write_dicom
from sightline.planning.check.shot import ALIGNED, PAUSED
from sightline.rehearsal.operation import SimulatedTheatre, registered
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.robot.kinematics.designs import FEED, YAW
from sightline.robot.kinematics.target import RobotTarget
from sightline.robot.plant import Reading
from sightline.studies.scenes import VIEWS
from sightline.twin import Scene, SetUp, draw_setup, render
from sightline.twin.objects.things import BoneMotion, SoftTissue, draw_motion, frame_scene
from sightline.twin.scenes.specimens import tagged

BLOCK = Frame.load("block60")
PICK_PX = 0.2
MARKS_MM = np.array([[-19.3, -12.6, 9.2], [14.7, 21.8, -11.3], [17.6, -18.9, 15.8]])
SHORT_MM = {ALIGNED: -20.0, PAUSED: float(np.linalg.norm(END_MM - ENTRY_MM)) - 10.0}  # depth of the tip


def imaged(rng: np.random.Generator, setup: SetUp, folder: Path, name: str) -> list[Path]:
    """Write an image of each view, of the frame in soft tissue."""
    scene = frame_scene(setup.true_frame) + Scene(tissue=SoftTissue().around(setup.hip_mm))
    images = {view: tagged(setup, view, render(setup, view, scene, rng)) for view in VIEWS}
    return [write_dicom(image, folder / f"{name}-{view}.dcm") for view, image in images.items()]


@dataclass(frozen=True, eq=False)
class Planned:
    """A GO plan in a case, made on `setup`; `target`: what the simulated robot will be sent."""

    folder: Path
    setup: SetUp
    wire_mm: np.ndarray
    marks_mm: np.ndarray
    target: RobotTarget

    def shot(
        self, state: str, off_mm: np.ndarray | None = None, *, marks: int = 3, on_patient: Frame | None = None
    ) -> str:
        """Return what a person answers: images, and a file of landmarks and of points on a wire `off_mm` aside.

        `on_patient`: the frame in the images, where no encoder knows it; else the block on its mount.
        """
        moved, line, setup, files = self._imaged(state, on_patient)
        rng = np.random.default_rng([8, state == PAUSED])
        line, found = moved.apply(line + (0.0 if off_mm is None else off_mm)), moved.apply(self.marks_mm)

        def picked(on: SetUp, xyz: np.ndarray) -> np.ndarray:
            uv = np.stack([on.views[name].project(xyz) for name in VIEWS])
            return uv + PICK_PX * rng.standard_normal(uv.shape)

        both = zip(picked(self.setup, self.marks_mm).swapaxes(0, 1), picked(setup, found).swapaxes(0, 1), strict=True)
        landmarks = [dict(zip((*VIEWS, *CHECK_NAMES), np.concatenate(pixels).tolist(), strict=True)) for pixels in both]
        points = dict(zip(CHECK_NAMES, picked(setup, line).tolist(), strict=True))
        picks = picks_file(self.folder, landmarks=landmarks[:marks], wire_points=points, pick_sd_px=PICK_PX)
        return " ".join(map(str, (*files, picks))) + "\n"

    @cache  # noqa: B019 - lives as long as the module's tests
    def _imaged(self, state: str, on_patient: Frame | None) -> tuple[RigidTransform, np.ndarray, SetUp, list[Path]]:
        """Return the motion of the block, points of the wire where the encoders have it, set-up and images: the same
        for any wire and picks."""
        rng = np.random.default_rng([7, state == PAUSED])
        stood = self.target.registration
        q = self.target.q.copy()
        q[FEED] += SHORT_MM[state]
        tip = stood.T_mcs_cfcs.inv() * stood.robot.manipulator.T_mcs_tool(q)
        along = tip.rotation.apply([0.0, 0.0, 1.0])
        line = tip.translation - np.linspace(45.0, 0.0, 15)[:, None] * along
        moved: RigidTransform = stood.robot.frame_moved(stood.q, q, self.wire_mm.mean(axis=0))[0]
        if on_patient is not None:
            moved = draw_motion(rng, self.wire_mm.mean(axis=0), BoneMotion(15.0, 0.2))
        setup = drawn(rng, moved.apply(np.concatenate([line, self.marks_mm])), on_patient or BLOCK)
        name = state if on_patient is None else f"{state}-on-patient"
        return moved, line, setup, imaged(rng, setup, self.folder, name)


@pytest.fixture(scope="module")
def planned(run, few_pixels: None, tmp_path_factory: pytest.TempPathFactory) -> Planned:
    folder, rng = tmp_path_factory.mktemp("drive"), np.random.default_rng(3)
    hip = draw_setup(np.random.default_rng(0), BLOCK).hip_mm
    wire, marks = np.stack([ENTRY_MM, END_MM]) + hip, MARKS_MM + hip
    setup = drawn(rng, np.concatenate([wire, marks]))

    landmarks, wires = [place(setup, mark) for mark in marks], {"wire": wire_picks(setup, wire)}
    picks = picks_file(folder, wires=wires, landmarks=landmarks, pick_sd_px=0.2)
    given = ["plan", *imaged(rng, setup, folder, "plan"), "--frame", "block60", "--procedure", "free-wire"]
    given += ["--side", "right", "--picks", picks]
    ran = run(*given, "--out", folder / "plan", "--case", folder / "case")
    assert ran.code == 0, ran.err
    theatre, plan = SimulatedTheatre.in_air("right", "simulated", BLOCK), PlanFile.read(folder / "plan")
    target = _target(plan, "plan", "simulated", registered(theatre.robot, theatre.wire.imaged, 0.0))
    return Planned(folder, setup, wire, marks, target)


def drive(planned: Planned, say: str, *more: str):
    given = ("--frame", "block60", "--case", planned.folder / "case", "--json", *more)
    done = robot("drive", planned.folder / "plan", *given, say=say)
    done.told = json.loads(done.stdout[done.stdout.index("{") :]) if "{" in done.stdout else None
    done.said = " ".join(done.stderr.split())
    return done


def shots(planned: Planned) -> list:
    with Case.open(planned.folder / "case", read_only=True) as case:
        return case.entries(Kind.SHOT)


@pytest.mark.slow
def test_both_shots_say_go_are_recorded_and_the_depth_moves_the_robot_s_end(planned: Planned) -> None:
    """At the pause the images show the tip 0.6 mm deeper than the encoders do: the robot drills by that less."""
    along = (planned.wire_mm[1] - planned.wire_mm[0]) / np.linalg.norm(planned.wire_mm[1] - planned.wire_mm[0])
    before, deeper = len(shots(planned)), 0.6 * along
    done = drive(planned, f"y\ny\n{planned.shot(ALIGNED)}y\n{planned.shot(PAUSED, deeper)}y\none.dcm\n'open\n")
    assert done.exit_code == 4, done.output
    assert (done.told["state"], done.told["verified"], done.told["check_shot"]) == ("DONE", False, None)
    assert "check shot: not measured: give the files of two images" in done.said
    assert "check shot: not measured: a quotation mark is left open" in done.said
    told = done.told["shots"]
    assert {state: one["decision"] for state, one in told.items()} == {ALIGNED: "GO", PAUSED: "GO"}
    assert told[PAUSED]["depth_mm"] == pytest.approx(SHORT_MM[PAUSED] + 0.6, abs=4 * told[PAUSED]["depth_sd_mm"])
    weight = 0.5**2 / (0.5**2 + told[PAUSED]["depth_sd_mm"] ** 2)  # of the shot beside the plan
    short = (np.array(done.told["tip_mm"]) - planned.wire_mm[1]) @ along
    assert short == pytest.approx(-0.6 * weight, abs=0.35)  # the plan's own error is in it
    assert short < -0.2
    kept = shots(planned)[before:]
    assert [one.content["state"] for one in kept] == [ALIGNED, PAUSED]
    with Case.open(planned.folder / "case", read_only=True) as case:
        again = [one.outcome for one in replay(case) if one.entry.kind is Kind.SHOT]
    assert set(again) == {ReplayOutcome.SAME}


@pytest.mark.slow
def test_a_guide_beside_its_plan_stops_the_robot_before_it_drills(planned: Planned) -> None:
    before = len(shots(planned))
    done = drive(planned, f"y\ny\n{planned.shot(ALIGNED, np.array([0.0, 0.0, 3.0]))}y\ny\n")
    assert done.exit_code == 3
    assert "ALIGNED: STOP: " in done.said and "the shot at ALIGNED says STOP: " in done.stdout
    assert [one.content["decision"] for one in shots(planned)[before:]] == ["STOP"]


@pytest.mark.slow
def test_a_frame_on_the_patient_shows_the_guide_and_needs_landmarks(planned: Planned) -> None:
    """Another block, anywhere: with two landmarks nothing is measured, with three a guide 3 mm aside is a STOP."""
    other, before = Frame.load("block40"), len(shots(planned))
    aside = np.array([0.0, 0.0, 3.0])
    few, good, bad = (
        planned.shot(ALIGNED, marks=2, on_patient=other),
        planned.shot(ALIGNED, on_patient=other),
        planned.shot(PAUSED, aside, on_patient=other),
    )
    done = drive(planned, f"y\ny\n{few}{good}y\n{bad}y\n", "--patient-frame", "block40")
    assert done.exit_code == 3, done.output
    assert "leave the frame on the patient" in done.said
    assert "ALIGNED: not measured: find 3 landmarks of the bone or more in all four images, not 2" in done.said
    assert "ALIGNED: GO" in done.said and "PAUSED: STOP: " in done.said
    kept = [one.content for one in shots(planned)[before:]]
    assert [one["decision"] for one in kept] == ["GO", "STOP"]  # without its landmarks a shot was not taken
    with Case.open(planned.folder / "case", read_only=True) as case:
        again = [one.outcome for one in replay(case) if one.entry.kind is Kind.SHOT]
    assert set(again) == {ReplayOutcome.SAME}


@pytest.mark.slow
def test_an_incomplete_shot_is_asked_for_again_and_without_one_the_person_decides(planned: Planned) -> None:
    done = drive(planned, f"y\ny\n{planned.shot(ALIGNED, marks=0)}nowhere.dcm none.dcm\n\nn\n")
    assert done.exit_code == 0, done.output
    assert "ALIGNED: INCOMPLETE" in done.said
    assert "ALIGNED: not measured" in done.said
    assert "ALIGNED: no shot was given; the decision is yours" in done.said
    assert done.told["state"] == "STOP"


@pytest.mark.slow
def test_without_a_case_or_with_another_s_plan_no_shot_is_measured(planned: Planned, tmp_path: Path) -> None:
    document = json.loads((planned.folder / "plan" / "plan.json").read_text())
    document["trajectory"]["end_mm"][0] += 0.5
    other = written(tmp_path / "plan.json", **{key: one for key, one in document.items() if key != "digest"})
    refused = robot("drive", other, "--frame", "block60", "--case", planned.folder / "case", say="y\n")
    assert refused.exit_code == 3
    assert "the case does not hold this plan" in " ".join(refused.stderr.split())
    done = robot("drive", planned.folder / "plan", "--frame", "block60", say="y\ny\nn\n")
    assert "ALIGNED: the shot is not measured: give --case" in " ".join(done.stderr.split())


def test_a_frame_on_the_patient_serves_measured_shots_only(tmp_path: Path) -> None:
    done = robot("drive", written(tmp_path / "plan.json"), "--patient-frame", "block40", say="y\nn\n")
    assert done.exit_code == 2
    assert "give --case too" in " ".join(done.stderr.split())


def test_with_a_frame_that_turned_away_it_says_so(tmp_path: Path) -> None:
    """A plan without a block: no shot is asked for while it drills."""
    done = robot("drive", written(tmp_path / "plan.json"), say="y\nn\n")
    assert done.exit_code == 0, done.output
    assert "ALIGNED: This shot cannot be measured: the frame has turned away" in " ".join(done.stderr.split())


@pytest.fixture(scope="module")
def rehearsed(run, worked, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a plan on the images of the demo's patient and its case."""
    folder = tmp_path_factory.mktemp("rehearsed")
    images = [worked.demo / f"demo_{view}.dcm" for view in VIEWS]
    entry, end = (
        " ".join(f"{view}:{u},{v}" for view, (u, v) in zip(VIEWS, worked.wire_px[:, k].tolist(), strict=True))
        for k in range(2)
    )
    given = ("--procedure", "free-wire", "--side", "right", "--entry", entry, "--end", end)
    ran = run("plan", *images, *given, "--out", folder / "plan", "--case", folder / "case")
    assert ran.code == 0, ran.err
    return folder


@pytest.mark.slow
def test_the_check_shot_judges_where_the_robot_says_all_is_right(run, rehearsed: Path, monkeypatch) -> None:
    """An encoder that slips after the images shows the robot at its target, and the wire lies millimetres aside."""
    theatre = Rehearsal.theatre

    def slips(self: Rehearsal) -> SimulatedTheatre:
        made = theatre(self)
        sample = made.plant._sample

        def read(*given: bool) -> Reading:
            reading = sample(*given)
            return replace(reading, encoders=reading.encoders + np.deg2rad(0.5) * (np.arange(5) == YAW))

        made.plant._sample = read
        return made

    monkeypatch.setattr(Rehearsal, "theatre", slips)
    done = robot("drive", rehearsed / "plan", "--rehearse", "9", "--yes", "--case", rehearsed / "case", "--json")
    assert done.exit_code == 3, done.output
    told = json.loads(done.stdout)
    assert told["state"] == "DONE"
    assert told["verified"] is False
    assert told["check_shot"]["landmarks"] == 3
    off = told["check_shot"]["deviation"]["tip_mm"]
    true_off = np.linalg.norm(told["true_wire_mm"][1] - np.array(told["end_mm"]))
    assert off == pytest.approx(true_off, abs=0.5)
    assert off > 3.0
    report = run("case", "report", rehearsed / "case", "--out", rehearsed / "report")
    assert report.code == 0, report.err
    page = (rehearsed / "report" / "report.html").read_text()
    assert ">NOT CONFIRMED: " in page and ">CONFIRMED: " not in page


@pytest.mark.parametrize(("serial", "words"), [("none", "side right, frame without a serial"), ("SN-7", "frame SN-7")])
def test_frame_and_open_hole_are_told_before_anything_moves(serial, words) -> None:
    told: list[str] = []
    target = dict.fromkeys(("length_mm", "entry_error_95_mm", "end_error_95_mm"), 1.0)
    target |= dict.fromkeys(("entry_mm", "end_mm"), np.zeros(3))
    identity = SimpleNamespace(side="right", frame_serial=serial)
    output = SimpleNamespace(table=lambda *_: None, say=told.append)
    _show(output, SimpleNamespace(**target, identity=identity), SimpleNamespace(simulated=True, open_hole_mm=3.0))
    assert told[0].endswith(words) and "this hole was drilled to 3.0 mm before" in told[1]


@pytest.mark.slow
def test_a_wire_without_a_check_shot_is_not_verified(run, rehearsed: Path) -> None:
    """By the last line, the exit code and the report; with --yes too, which gives no images."""
    for given, why in (
        ((), "not verified: no check shot shows where the wire lies; give --case"),
        (("--case", rehearsed / "case"), "not verified: --yes gives no check images"),
    ):
        done = robot("drive", rehearsed / "plan", "--yes", *given)
        assert done.exit_code == 4, done.output
        assert done.stdout.splitlines()[-1].startswith(why)
    assert run("case", "report", rehearsed / "case", "--out", rehearsed / "report").code == 0
    page = (rehearsed / "report" / "report.html").read_text()
    assert ">NOT VERIFIED: " in page
    assert "no check shot was measured" in page
