"""Shots while drilling, without a page: a block on the arm and on the patient, plates, and what a person is told."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.app.drilling import ASIDE_MM, measure, place, plan_and_send, take_shot, truth, until, wait_for
from tests.app.hands import SEED

from sightline.app.panels import shots as panel
from sightline.app.session.jobs import Jobs, WorkerProcess
from sightline.app.session.planning import Planning
from sightline.app.session.rehearsing import Patient
from sightline.app.session.sent import ZeroSource
from sightline.app.session.session import Session
from sightline.app.session.shots import Shots
from sightline.app.tab.placing import ProcedureStep
from sightline.case.journal import Case, Kind
from sightline.case.views import NAMES, SHOT_NAMES
from sightline.common.checks import Check, failed
from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.frame import Frame
from sightline.imaging import Radiograph, write_dicom
from sightline.planning.check.shot import ALIGNED, PAUSED
from sightline.planning.points.results import Verdict
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.robot.control.states import State

_IN_LATERAL = np.array([[0.0, 0.0], [0.0, 1.0]])  # along the patient in the second of two images
MOVED_PX = 9.0  # a movement along the patient between two images, which both show


@pytest.fixture
def waiting(tmp_path: Path) -> Iterator[tuple[Planning, Any]]:
    """Planning with a Γ frame, and a robot that waits in its guide."""
    with Case.create(tmp_path) as case:
        now = SimpleNamespace(state=ALIGNED, lost=False, activity="")
        nobody: Any = None
        yield (
            Planning(case, "gamma", nobody, Jobs()),
            SimpleNamespace(now=now, held=None, session=None, changed="", by_hand=False),
        )


def test_plates_are_measured_once_a_person_says_that_they_left_the_arm(waiting: tuple[Planning, Any]) -> None:
    """Fails for a statement that a restart forgets, for one that outlives the images that it was made on, and for one
    that is made while images are taken."""
    planning, drilling = waiting
    shots = Shots(planning, drilling)
    assert not shots.on_patient and not shots.state
    planning.jobs.working = "taking the shot"
    with pytest.raises(UnusableInputError, match="wait: taking the shot is not done yet"):
        shots.state_on_patient(fixed=True)
    planning.jobs.working = ""
    assert not shots.on_patient
    shots.state_on_patient(fixed=True)
    assert shots.state == ALIGNED
    assert Shots(planning, drilling).state == ALIGNED
    shots.state_on_patient(fixed=False)
    assert not shots.state
    shots.state_on_patient(fixed=True)
    planning.edit(planning.decisions.with_image("pa", planning.case.last + 1, same_pixels=False))
    assert not shots.state and not Shots(planning, drilling).on_patient


@pytest.mark.parametrize(
    ("shots", "words"),
    [
        ({"found": ("STOP", "wire ahead")}, ("no-go", "STOP", "wire ahead.")),
        ({"found": ("GO", "")}, ("go", "GO", "The wire is on the plan")),
        ({"objection": "The shot says STOP: so"}, ("no-go", "STOP", "The shot says STOP: so")),
        ({"lacks_landmarks": True}, ("incomplete", "INCOMPLETE", "Find 3 landmarks of the plan or more")),
        ({"measuring": True}, ("incomplete", "INCOMPLETE", "Measuring the wire")),
        ({}, ("incomplete", "INCOMPLETE", "Place the points that are asked for")),
    ],
)
def test_a_shot_stands_in_the_place_of_the_plans_verdict(shots: dict[str, Any], words: tuple[str, ...]) -> None:
    """Fails for a page that keeps a GO on top of a shot's STOP."""
    known: dict[str, Any] = {"shown": ALIGNED, "found": None, "objection": "", "refused": ""}
    known |= {"lacks_landmarks": False, "measuring": False, **shots}
    if known["found"]:
        decision, name = known["found"]
        checks = (Check(name, False, None, None, "", f"{name}."),) if name else ()
        known["found"] = SimpleNamespace(decision=decision, verdict=Verdict(checks))
    planning = SimpleNamespace(seen=lambda _: None, landmarks=())
    session = SimpleNamespace(
        shots=SimpleNamespace(**known), drilling=SimpleNamespace(now=SimpleNamespace(state=ALIGNED))
    )
    tab: Any = SimpleNamespace(step=ProcedureStep.DRILL, session=session, planning=planning)
    html = panel.verdict_html(tab)
    assert all(word in html for word in words)
    tab.step = ProcedureStep.PLAN
    assert not panel.verdict_html(tab)


def _names(shots: Shots) -> list[str]:
    """The checks of the shot that failed."""
    assert shots.found is not None, shots.refused
    return [one.name for one in failed(shots.found.verdict.checks)]


async def _without_beads(session: Session, folder: Path) -> None:
    """Two images without a frame: nothing is measured, and a STOP of before stands."""
    planning, shots = session.planning, session.shots
    noise = np.random.default_rng(3).integers(9000, 9200, (512, 512)).astype(np.uint16)
    for name in NAMES:
        data = write_dicom(Radiograph(noise, 65535.0), folder / f"{name}.dcm", "right").read_bytes()
        await planning.take(data, ".dcm", image=f"shot-{name}")
    await until(lambda: all(one is not None and bool(one.refused) for one in map(planning.seen, SHOT_NAMES)))
    shots.update()
    assert shots.found is None
    with pytest.raises(RobotRefusedError, match="The shot says STOP: "):
        await session.drilling.drill(State.ALIGNED)


@pytest.mark.slow  # images are rendered and calibrated, and a wire is drilled
def test_a_block_measures_both_shots_on_the_arm_and_on_the_patient(worker: WorkerProcess, tmp_path: Path) -> None:
    """On the patient the block was moved by 2° and 3 mm per axis. Fails for a shot that believes the encoders of a
    frame that left the arm, for one that measures with two landmarks, for a drill that goes on after STOP, and for a
    STOP that images without beads end."""
    patient = Rehearsal.draw(SEED, Frame.load("block60"))

    async def work() -> None:
        session = Session.open(tmp_path / "case", "block60", Patient(SEED, "block60"), worker)
        drilling, shots = session.drilling, session.shots
        await plan_and_send(session, patient)
        with pytest.raises(RobotRefusedError, match="while the robot waits"):
            await shots.take_rehearsed()
        await drilling.align()
        await wait_for(session, ALIGNED)
        true = await take_shot(session, patient, ALIGNED)
        await measure(session, truth(patient, true, ASIDE_MM))
        assert shots.found is not None and shots.found.decision == "STOP" and "wire ahead" in _names(shots)
        with pytest.raises(RobotRefusedError, match="The shot says STOP: "):
            await drilling.drill(State.ALIGNED)
        await _without_beads(session, tmp_path)
        shots.state_on_patient(fixed=True)
        shots.update()
        assert not shots.shown and shots.found is None  # images of before do not count
        good = truth(patient, await take_shot(session, patient, ALIGNED))
        *_, last = [name for name in good if name.startswith("landmark-")]
        place(session, {name: uv for name, uv in good.items() if name != last})
        shots.update()
        assert shots.lacks_landmarks and shots.found is None and not shots.refused
        lateral = {name: uv + MOVED_PX * _IN_LATERAL for name, uv in good.items() if "landmark" in name}
        await measure(session, {**good, **lateral})  # the patient moved against the frame, between the two images
        assert shots.found.decision == "STOP" and {"check shot residuals", "check shot outlier"} & set(_names(shots))
        await measure(session, good)  # three landmarks of 0.5 px do not tell the line well enough for GO
        assert shots.found.decision == "INCOMPLETE" and _names(shots) == ["check shot error"]
        shots.state_on_patient(fixed=False)
        await drilling.drill(State.ALIGNED)
        await wait_for(session, PAUSED)
        robot = drilling.session
        assert robot is not None and not shots.shown and shots.found is None
        tip_mm = (await robot.simulated_wire()).axis_mm[1]
        await measure(session, truth(patient, await take_shot(session, patient, PAUSED)))
        found = shots.found
        assert found is not None and found.decision == "GO", _names(shots)
        entry, end = patient.hip.wire_mm
        depth_mm = (tip_mm - entry) @ (end - entry) / np.linalg.norm(end - entry)
        assert abs(found.depth_mm - depth_mm) < 3 * found.depth_sd_mm
        await shots.send_depth()
        await until(lambda: drilling.now is not None and ZeroSource.SHOT in drilling.now.zero)
        await drilling.drill(State.PAUSED)
        assert session.planning.drilled is not None
        await session.close()

    asyncio.run(work())
    with Case.open(tmp_path / "case", read_only=True) as case:
        kept = [one.content for one in case.entries(Kind.SHOT)]
        assert [one["decision"] for one in kept] == ["STOP", "STOP", "INCOMPLETE", "GO"]
        assert [one["asked"]["movement"] is None for one in kept] == [False, True, True, False]
        (told,) = [one.content["to"] for one in case.entries(Kind.CHANGED) if one.content["what"] == "second shot"]
        assert told["depth_mm"] == kept[-1]["depth_mm"]
