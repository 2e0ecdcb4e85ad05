"""The whole way of two holes on the app's simulated patient, without a page: planned, drilled one after the other,
each checked."""

import asyncio
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from sightline.app.plan.holes import with_nail
from sightline.app.plan.marks import CHECK_NAMES
from sightline.app.plan.robot_wire import ROBOT_WIRE
from sightline.app.session.rehearsing import Patient
from sightline.app.session.session import Session
from sightline.app.session.worker import WorkerProcess
from sightline.case.journal import Case, Kind
from sightline.case.replay import ReplayOutcome, replay
from sightline.case.views import NAMES
from sightline.errors import RobotRefusedError
from sightline.frame import Frame
from sightline.rehearsal.check_images import CheckImages
from sightline.rehearsal.patient import NAILED
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.robot.control.states import State

SEED, FRAME = 2, "block60"  # as `sightline demo --procedure distal-interlocking`
KINDS = ("distal-interlocking:distal", "distal-interlocking:proximal")
PATIENCE_S = 300.0  # of a busy machine
CLICK_PX = 0.5  # s.d. of a click, as the page assumes it
MOST_RETAKES = 2
LIMIT_MM = 0.5  # a drill of 4 mm in a hole of 5 mm


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


def _place(session: Session, name: str, images: tuple[str, ...], uv_px: np.ndarray) -> None:
    planning = session.planning
    mark = planning.decisions.mark(name)
    for image, at in zip(images, uv_px.tolist(), strict=True):
        mark = mark.placed(image, (at[0], at[1]), free=True)
    planning.edit(planning.decisions.with_mark(name, mark))


async def _planned(session: Session, patient: Rehearsal) -> None:
    planning = session.planning
    await planning.start()
    assert planning.implanted == patient.nail and planning.decisions.kind == KINDS[0]
    asked = patient.asked(patient.generator("picks"), CLICK_PX)[0]
    assert asked.nail is not None and asked.landmarks_uv_px is not None
    planning.confirm_side("right")
    planning.confirm_serial("none")
    planning.edit(with_nail(planning.decisions, asked.nail))
    for k, name in enumerate(asked.landmark_names):
        _place(session, f"landmark-{name}", NAMES, asked.landmarks_uv_px[:, k])
    await _until(lambda: planning.nail.found is not None)
    assert session.readiness.can_send, session.readiness.verdict


async def _wait_for(session: Session, state: State) -> None:
    def there() -> bool:
        now = session.drilling.now
        return now is not None and not now.activity and now.state == state.value

    await _until(there)


async def _drilled(session: Session, kind: str) -> None:
    planning, drilling = session.planning, session.drilling
    planning.choose_kind(kind)
    known = planning.planned
    assert known is not None and known.plan is not None and known.plan.kind.key == kind
    await drilling.send(known)
    await drilling.align()
    for state in (State.ALIGNED, State.PAUSED):
        await _wait_for(session, state)
        await drilling.drill(state)
    robot = drilling.session
    assert robot is not None and planning.drilled is not None
    await robot.retract()
    await _wait_for(session, State.PLANNING)


async def _checked(session: Session, patient: Rehearsal, before: tuple[str, ...], retake: int = 0) -> CheckImages:
    """Take the check images, find the landmarks again, and return what they truly show.

    A drill's tip may be refused in images of one place of the C-arm: then they are taken again, as the refusal says.
    """
    planning, verifying = session.planning, session.verifying
    kind = planning.decisions.kind
    await verifying.take_rehearsed()
    await _until(lambda: planning.views(CHECK_NAMES) is not None)
    axes = {key: planning.all_drilled[one].wire.axis_mm for one, key in zip(before, ("distal",), strict=False)}
    drilled = planning.all_drilled[kind]
    true = patient.check_images(drilled.wire, "proximal" if before else "distal", axes, retake=retake)
    for key, name in zip(patient.landmark_keys, patient.landmarks, strict=True):
        at = [true.setup.views[view].project(true.landmarks_mm[name][None])[0] for view in NAMES]
        _place(session, f"landmark-{key}", CHECK_NAMES, np.array(at))
    asyncio.get_running_loop().call_soon(verifying.update)
    await asyncio.sleep(0.05)
    await _until(lambda: (verifying.shot is not None and not planning.jobs.working) or bool(verifying.refused))
    if "take the image again" in verifying.refused and retake < MOST_RETAKES:
        return await _checked(session, patient, before, retake + 1)
    return true


def _off_mm(session: Session) -> np.ndarray:
    """The true distances of the drill's axis from both ends of the plan that was sent, mm."""
    planning = session.planning
    assert planning.drilled is not None and planning.sent is not None
    start, tip = planning.drilled.wire.axis_mm
    along = (tip - start) / np.linalg.norm(tip - start)
    off = planning.sent.plan.trajectory.points.xyz_mm - start
    return np.linalg.norm(off - np.outer(off @ along, along), axis=1)


@pytest.mark.slow  # images are rendered and calibrated, and two holes are drilled
def test_both_holes_of_the_simulated_patient_are_drilled_and_checked(worker: WorkerProcess, tmp_path: Path) -> None:
    """By encoders alone the robot refuses a hole. Fails for a robot beside a hip, for a drill that touches a wall, and
    for a check shot that is wrong by more than it states."""
    patient = Rehearsal.draw(SEED, Frame.load(FRAME), procedure=NAILED)
    noise_px = CLICK_PX * np.random.default_rng(5).standard_normal((len(ROBOT_WIRE), 2, 2))

    async def work() -> None:
        session = Session.open(tmp_path, None, Patient(SEED, FRAME, procedure=NAILED), worker)
        planning, drilling, verifying = session.planning, session.drilling, session.verifying
        await _planned(session, patient)
        await drilling.start_robot(fast=True)
        known, wire_mm = planning.planned, patient.robot_wire_mm
        assert known is not None and wire_mm is not None
        with pytest.raises(RobotRefusedError, match="Click tip and middle of the robot's wire"):
            await drilling.send(known)
        uv_px = patient.pixels(wire_mm)
        uv_px[1, 0] = 0.8 * uv_px[1, 0] + 0.2 * uv_px[1, 1]  # another point of the wire than in the first image
        for spec, uv in zip(ROBOT_WIRE, uv_px.swapaxes(0, 1) + noise_px, strict=True):
            _place(session, spec.name, NAMES, uv)
        for n, kind in enumerate(KINDS):
            await _drilled(session, kind)
            off_mm = _off_mm(session)
            assert (off_mm < LIMIT_MM).all()
            await _checked(session, patient, KINDS[:n])
            shot = verifying.shot
            assert shot is not None and shot.passed, verifying.refused
            assert abs(shot.entry_deviation_mm - off_mm[0]) < shot.entry_error_95_mm
        await session.close()

    asyncio.run(work())
    with Case.open(tmp_path, read_only=True) as case:
        assert len(case.entries(Kind.DRILLED)) == len(KINDS)
        assert [one.content["registered_by"] for one in case.entries(Kind.SENT)] == ["images"] * len(KINDS)
        again = [one for one in replay(case) if one.outcome is not ReplayOutcome.RECORDED]
        assert all(one.passed for one in again), [(one.entry.kind, one.said, one.reason) for one in again]
