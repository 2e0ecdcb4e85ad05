"""A session whose simulated robot drills, without a page: a plan is sent, shots are taken, a person knows the truth."""

import asyncio
import time
from collections.abc import Callable, Mapping

import numpy as np
from tests.worked import unrendered

from sightline.app.plan.marks import GUIDE
from sightline.app.session.session import Session
from sightline.case.views import NAMES, SHOT_NAMES
from sightline.rehearsal.patient import CheckImages
from sightline.rehearsal.rehearsal import Rehearsal

PATIENCE_S = 120.0  # of a busy machine
ASIDE_MM = np.array([0.0, 0.0, 4.3])  # across the wire, beyond every limit
Places = Mapping[str, np.ndarray]  # by mark: pixels (2, 2), a row for each image


def place(session: Session, places: Places, images: tuple[str, ...] = SHOT_NAMES) -> None:
    """Place marks in both of two images."""
    decisions = session.planning.decisions
    for name, uv in places.items():
        mark = decisions.mark(name)
        for image, at in zip(images, uv.tolist(), strict=True):
            mark = mark.placed(image, (at[0], at[1]), free=True)
        decisions = decisions.with_mark(name, mark)
    session.planning.edit(decisions)


async def until(there: Callable[[], bool]) -> None:
    """Wait until something is so."""
    end = time.monotonic() + PATIENCE_S
    while not there():
        assert time.monotonic() < end
        await asyncio.sleep(0.02)


async def plan_and_send(session: Session, patient: Rehearsal) -> None:
    """Plan the true wire of a hip, with its landmarks and its head, start the robot and send the plan."""
    planning = session.planning
    await planning.start()
    wire, rim = patient.pixels(patient.hip.wire_mm), patient.head_rim
    places = {"entry": wire[:, 0], "end": wire[:, 1]} | {f"head-{k + 1}": rim[:, k] for k in range(3)}
    for key in ("neck", "shaft"):
        uv = np.array(patient.aids_px[key])
        places |= {f"{key}-{k + 1}": uv[:, k] for k in range(2)}
    named = zip(patient.landmark_keys, patient.landmarks.values(), strict=True)
    place(session, places | {f"landmark-{key}": uv for key, uv in named}, NAMES)
    cortex = patient.aids_px["cortex"][0]
    assert cortex is not None
    place(session, {"cortex-1": cortex}, NAMES[:1])
    planning.decide(side="right")
    planning.confirm_serial("none")
    known = planning.planned
    assert session.readiness.can_send and known is not None, session.readiness.verdict
    await session.drilling.start_robot(fast=True)
    await session.drilling.send(known)


async def wait_for(session: Session, state: str) -> None:
    """Wait until the robot waits in a state."""

    def there() -> bool:
        now = session.drilling.now
        return now is not None and now.state == state and not now.activity

    await until(there)


async def take_shot(session: Session, patient: Rehearsal, state: str) -> CheckImages:
    """Take the page's shot; return it with its truth, which the patient draws again."""
    robot, shots = session.drilling.session, session.shots
    assert robot is not None
    await wait_for(session, state)  # it may still be asked for its joints
    wire, q = await robot.simulated_wire(), await robot.joints()
    await shots.take_rehearsed()
    await until(lambda: shots.shown == state and session.planning.views(SHOT_NAMES) is not None)
    return unrendered(patient.drilling_images, wire, q, state, on_patient=shots.on_patient)


def truth(patient: Rehearsal, true: CheckImages, aside_mm: np.ndarray | float = 0.0) -> Places:
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


async def measure(session: Session, places: Places) -> None:
    """Place marks in the shot, and wait until it is measured."""
    shots = session.shots
    place(session, places)
    asyncio.get_running_loop().call_soon(shots.update)
    await asyncio.sleep(0.05)
    await until(lambda: shots.found is not None or bool(shots.refused))
    assert shots.found is not None, shots.refused
