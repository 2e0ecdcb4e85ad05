"""Shots while drilling beside a block, without a page: a session, its robot in a process of its own, and a person."""

import asyncio
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
from tests.app.hands import SEED

from sightline.app.plan.marks import GUIDE, SHOT_NAMES
from sightline.app.session.rehearsing import Patient
from sightline.app.session.session import Session
from sightline.app.session.worker import WorkerProcess
from sightline.app.session.zero import ZeroSource
from sightline.case.journal import Case, Kind
from sightline.case.replay import ReplayOutcome, replay
from sightline.case.views import NAMES
from sightline.errors import RobotRefusedError
from sightline.frame import Frame
from sightline.planning.drill_shot import ALIGNED, PAUSED
from sightline.rehearsal.check_images import CheckImages
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.robot.control.states import State

PATIENCE_S = 120.0  # of a busy machine
ASIDE_MM = np.array([0.0, 0.0, 4.3])  # across the wire, beyond every limit
Places = Mapping[str, np.ndarray]  # by mark: pixels (2, 2), a row for each image


@pytest.fixture(scope="module")
def worker() -> Iterator[WorkerProcess]:
    made = WorkerProcess()
    yield made
    made.close()


def _place(session: Session, places: Places, images: tuple[str, ...]) -> None:
    decisions = session.planning.decisions
    for name, uv in places.items():
        mark = decisions.mark(name)
        for image, at in zip(images, uv.tolist(), strict=True):
            mark = mark.placed(image, (at[0], at[1]), free=True)
        decisions = decisions.with_mark(name, mark)
    session.planning.edit(decisions)


async def _until(there: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not there():
        assert time.monotonic() < end
        await asyncio.sleep(0.02)


async def _planned(session: Session, patient: Rehearsal) -> None:
    planning = session.planning
    await planning.start()
    wire, rim = patient.pixels(patient.hip.wire_mm), patient.head_rim
    places = {"entry": wire[:, 0], "end": wire[:, 1]} | {f"head-{k + 1}": rim[:, k] for k in range(3)}
    named = zip(patient.landmark_keys, patient.landmarks.values(), strict=True)
    _place(session, places | {f"landmark-{key}": uv for key, uv in named}, NAMES)
    planning.confirm_side("right")
    planning.confirm_serial("none")
    known = planning.planned
    assert session.readiness.can_send and known is not None, session.readiness.verdict
    await session.drilling.start_robot(fast=True)
    await session.drilling.send(known)


async def _wait_for(session: Session, state: str) -> None:
    def there() -> bool:
        now = session.drilling.now
        return now is not None and now.state == state and not now.activity

    await _until(there)


async def _taken(session: Session, patient: Rehearsal, state: str) -> CheckImages:
    """The shot that the page has, with its truth."""
    robot, shots = session.drilling.session, session.shots
    assert robot is not None
    wire, q = await robot.simulated_wire(), await robot.joints()
    await shots.take_rehearsed()
    await _until(lambda: shots.shown == state and session.planning.views(SHOT_NAMES) is not None)
    return patient.drilling_images(wire, q, state)


def _truth(patient: Rehearsal, true: CheckImages, aside_mm: np.ndarray | float = 0.0) -> Places:
    """The shot's landmarks and, in its guide, points on the wire, or `aside_mm` (3,) beside it."""

    def pixels(xyz_mm: np.ndarray) -> np.ndarray:
        return np.stack([true.setup.views[name].project(xyz_mm[None])[0] for name in NAMES])

    named = zip(patient.landmark_keys, patient.landmarks, strict=True)
    places = {f"landmark-{key}": pixels(true.landmarks_mm[name]) for key, name in named}
    if true.picked_mm is not None:
        along = np.linspace(0.0, 1.0, len(GUIDE))[:, None]
        line = (1 - along) * true.picked_mm[0] + along * true.picked_mm[-1]
        places |= {spec.name: pixels(xyz + aside_mm) for spec, xyz in zip(GUIDE, line, strict=True)}
    return places


async def _measured(session: Session, places: Places) -> None:
    shots = session.shots
    _place(session, places, SHOT_NAMES)
    asyncio.get_running_loop().call_soon(shots.update)
    await asyncio.sleep(0.05)
    await _until(lambda: shots.found is not None or bool(shots.refused))
    assert shots.found is not None, shots.refused


@pytest.mark.slow  # images are rendered and calibrated, and a wire is drilled
def test_both_shots_are_measured_and_the_depth_is_sent(worker: WorkerProcess, tmp_path: Path) -> None:
    patient = Rehearsal.draw(SEED, Frame.load("block60"))

    async def work() -> None:
        session = Session.open(tmp_path, "block60", Patient(SEED, "block60"), worker)
        drilling, shots = session.drilling, session.shots
        await _planned(session, patient)
        with pytest.raises(RobotRefusedError, match="while the robot waits"):
            await shots.take_rehearsed()
        await drilling.align()
        await _wait_for(session, ALIGNED)
        true = await _taken(session, patient, ALIGNED)
        await _measured(session, _truth(patient, true, ASIDE_MM))
        assert shots.found is not None and shots.found.decision == "STOP"
        with pytest.raises(RobotRefusedError, match="The shot says STOP"):
            await drilling.drill(State.ALIGNED)
        await _measured(session, _truth(patient, true))
        assert shots.found is not None and shots.found.decision == "GO", shots.found.verdict
        await drilling.drill(State.ALIGNED)
        await _wait_for(session, PAUSED)
        assert not shots.shown and shots.found is None  # the images of before show another moment
        await _measured(session, _truth(patient, await _taken(session, patient, PAUSED)))
        assert shots.found is not None and shots.found.decision == "GO", shots.found.verdict
        now = drilling.now
        assert now is not None and now.depth_mm is not None and abs(shots.found.depth_mm - now.depth_mm) < 2.0
        await shots.send_depth()
        await _until(lambda: drilling.now is not None and ZeroSource.SHOT in drilling.now.zero)
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
