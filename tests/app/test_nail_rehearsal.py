"""A hole of the app's simulated patient, without a page: planned, and not sent to a robot known by encoders alone."""

import asyncio
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from sightline.app.plan.holes import with_nail
from sightline.app.session.rehearsing import Patient
from sightline.app.session.session import Session
from sightline.app.session.worker import WorkerProcess
from sightline.case.journal import Case, Kind
from sightline.case.views import NAMES
from sightline.errors import RobotRefusedError
from sightline.frame import Frame
from sightline.rehearsal.patient import NAILED
from sightline.rehearsal.rehearsal import Rehearsal

SEED, FRAME = 2, "block60"  # as `sightline demo --procedure distal-interlocking`
KIND = "distal-interlocking:distal"
PATIENCE_S = 300.0  # of a busy machine
CLICK_PX = 0.5  # s.d. of a click, as the page assumes it


@pytest.fixture(scope="module")
def worker() -> Iterator[WorkerProcess]:
    made = WorkerProcess()
    yield made
    made.close()


async def _until(there: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not there():
        assert time.monotonic() < end
        await asyncio.sleep(0.02)


def _place(session: Session, name: str, uv_px: np.ndarray) -> None:
    """Place a mark at pixels (2, 2), a row for each image."""
    planning = session.planning
    mark = planning.decisions.mark(name)
    for image, at in zip(NAMES, uv_px.tolist(), strict=True):
        mark = mark.placed(image, (at[0], at[1]), free=True)
    planning.edit(planning.decisions.with_mark(name, mark))


async def _planned(session: Session, patient: Rehearsal) -> None:
    planning = session.planning
    await planning.start()
    assert planning.implanted == patient.nail and planning.decisions.kind == KIND
    asked = patient.asked(patient.generator("picks"), CLICK_PX)[0]
    assert asked.nail is not None and asked.landmarks_uv_px is not None
    planning.confirm_side("right")
    planning.confirm_serial("none")
    planning.edit(with_nail(planning.decisions, asked.nail))
    for k, name in enumerate(asked.landmark_names):
        _place(session, f"landmark-{name}", asked.landmarks_uv_px[:, k])
    await _until(lambda: planning.nail.found is not None)
    assert session.readiness.can_send, session.readiness.verdict


@pytest.mark.slow  # images are rendered and calibrated
def test_encoders_alone_do_not_hit_a_hole_and_the_refusal_says_what_helps(
    worker: WorkerProcess, tmp_path: Path
) -> None:
    """Fails for a robot beside a hip, and for an app that sends a plan its robot cannot keep. With the robot's wire
    clicked the same plan is sent: `test_nail_walk.py` drills both holes."""
    patient = Rehearsal.draw(SEED, Frame.load(FRAME), procedure=NAILED)

    async def work() -> None:
        session = Session.open(tmp_path, None, Patient(SEED, FRAME, procedure=NAILED), worker)
        await _planned(session, patient)
        await session.drilling.start_robot(fast=True)
        known = session.planning.planned
        assert known is not None
        with pytest.raises(RobotRefusedError, match="Click tip and middle of the robot's wire"):
            await session.drilling.send(known)
        await session.close()

    asyncio.run(work())
    with Case.open(tmp_path, read_only=True) as case:
        assert case.entries(Kind.SENT) == []
