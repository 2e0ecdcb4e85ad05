"""Shots while drilling beside a block, without a page: a session, its robot in a process of its own, and a person."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.app.drilling import ASIDE_MM, measure, plan_and_send, take_shot, truth, until, wait_for
from tests.app.hands import SEED

from sightline.app.session.rehearsing import Patient
from sightline.app.session.sent import ZeroSource
from sightline.app.session.session import Session
from sightline.app.session.worker import WorkerProcess
from sightline.case.journal import Case, Kind
from sightline.case.replay import ReplayOutcome, replay
from sightline.errors import RobotRefusedError
from sightline.frame import Frame
from sightline.planning.check.drill_shot import ALIGNED, PAUSED
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.robot.control.states import State


@pytest.fixture(scope="module")
def worker() -> Iterator[WorkerProcess]:
    made = WorkerProcess()
    yield made
    made.close()


@pytest.mark.slow  # images are rendered and calibrated, and a wire is drilled
def test_both_shots_are_measured_and_the_depth_is_sent(worker: WorkerProcess, tmp_path: Path) -> None:
    patient = Rehearsal.draw(SEED, Frame.load("block60"))

    async def work() -> None:
        session = Session.open(tmp_path, "block60", Patient(SEED, "block60"), worker)
        drilling, shots = session.drilling, session.shots
        await plan_and_send(session, patient)
        with pytest.raises(RobotRefusedError, match="while the robot waits"):
            await shots.take_rehearsed()
        await drilling.align()
        await wait_for(session, ALIGNED)
        true = await take_shot(session, patient, ALIGNED)
        await measure(session, truth(patient, true, ASIDE_MM))
        assert shots.found is not None and shots.found.decision == "STOP"
        with pytest.raises(RobotRefusedError, match="The shot says STOP"):
            await drilling.drill(State.ALIGNED)
        await measure(session, truth(patient, true))
        assert shots.found is not None and shots.found.decision == "GO", shots.found.verdict
        await drilling.drill(State.ALIGNED)
        await wait_for(session, PAUSED)
        assert not shots.shown and shots.found is None  # the images of before show another moment
        await measure(session, truth(patient, await take_shot(session, patient, PAUSED)))
        assert shots.found is not None and shots.found.decision == "GO", shots.found.verdict
        now = drilling.now
        assert now is not None and now.depth_mm is not None and abs(shots.found.depth_mm - now.depth_mm) < 2.0
        await shots.send_depth()
        await until(lambda: drilling.now is not None and ZeroSource.SHOT in drilling.now.zero)
        await drilling.drill(State.PAUSED)
        assert session.planning.drilled is not None
        await session.close()
        session.planning.case.close()

    asyncio.run(work())
    with Case.open(tmp_path, read_only=True) as case:
        kept = [one.content["decision"] for one in case.entries(Kind.SHOT)]
        assert kept[:2] == ["STOP", "GO"] and kept[-1] == "GO"
        again = [one for one in replay(case) if one.outcome is not ReplayOutcome.RECORDED]
        assert all(one.passed for one in again), [(one.entry.kind, one.said, one.reason) for one in again]
