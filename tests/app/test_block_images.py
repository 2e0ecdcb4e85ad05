"""A case with a block at work without a page: images named by a person, planned on together, and a third image."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.app.block import LANDMARKS, clicks, drawn, in_plane, load, place
from tests.three import BLOCK

from sightline.app.drawing import shapes
from sightline.app.panels.steps import StepStatus, steps
from sightline.app.plan.planner import plan_input
from sightline.app.session.seen import entry_of
from sightline.app.session.session import Session
from sightline.app.session.worker import WorkerProcess
from sightline.app.tab.placing import Placing, ProcedureStep
from sightline.case.journal import Actor, Case
from sightline.case.replay import ReplayOutcome, replay
from sightline.case.stages import keep_frame, record_acquired, record_changed, record_planned
from sightline.case.views import NAMES, OBLIQUE
from sightline.twin import SetUp
from sightline.twin.xray.setup import BEAMS


@pytest.fixture(scope="module")
def three() -> SetUp:
    return drawn()


@pytest.fixture(scope="module")
def worker() -> Iterator[WorkerProcess]:
    made = WorkerProcess()
    yield made
    made.close()


@pytest.fixture(scope="module")
def folder(three: SetUp, worker: WorkerProcess, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("block")
    load(three, folder, worker, {})
    return folder


def movement(session: Session):
    known = session.planning.planned
    assert known is not None and known.plan is not None, known and known.refused
    return next(check for check in known.plan.verdict.checks if check.name == "movement")


@pytest.mark.slow
def test_two_images_of_a_block_are_planned_on_and_a_third_shows_a_movement(
    folder: Path, three: SetUp, worker: WorkerProcess
) -> None:
    async def work() -> None:
        session = Session.open(folder / "case", None, None, worker)
        planning = session.planning
        await planning.start()
        views = planning.views()
        assert views is not None and len({view.adjustment for view in views}) == 1  # adjusted together
        assert steps(session)[1].status is StepStatus.DONE, steps(session)[1].reason
        shift = in_plane(three)

        place(session, clicks(three, shift), NAMES)
        assert movement(session).passed
        assert await planning.take((folder / "oblique.dcm").read_bytes(), ".dcm", image=OBLIQUE) == OBLIQUE
        assert planning.names == (*NAMES, OBLIQUE)
        assert movement(session).figure is None  # a new image has no marks: not tested
        goal = Placing(planning, session.shots).goal(ProcedureStep.PLAN)
        assert goal is not None and (goal.image, goal.spec.name) == (OBLIQUE, LANDMARKS[0])
        assert planning.planned is not None
        crosses = {one["title"].split(":")[0]: one["points"][0] for one in shapes.expected(planning.planned)}
        at = three.views[OBLIQUE].project(three.hip_mm + shift)[0]
        assert len(crosses) == 5 and np.linalg.norm(np.subtract(list(crosses.values()), at), axis=1).max() < 400.0

        place(session, clicks(three, shift), tuple(BEAMS))
        assert not movement(session).passed
        assert movement(session).sentence.startswith("The bone seems to have moved between the 3 images")
        place(session, clicks(three), tuple(BEAMS))
        assert movement(session).passed
        known = planning.planned
        assert known is not None and known.plan is not None and shapes.wire(known, OBLIQUE)
        seen = [planning.seen(name) for name in planning.names]
        entries = [entry_of(planning.case, one) for one in seen if one is not None]
        record_planned(planning.case, entries, plan_input(planning.decisions, 3), known.plan, by=Actor.SURGEON)
        planning.case.close()

    asyncio.run(work())
    with Case.open(folder / "case", read_only=True) as case:
        found = [one for one in replay(case) if one.outcome is not ReplayOutcome.RECORDED]
        assert {one.outcome for one in found} == {ReplayOutcome.SAME}, found
        assert len(found) == 13


@pytest.mark.slow
def test_an_image_in_both_slots_is_refused_and_images_from_elsewhere_are_named_by_their_angles(
    folder: Path, three: SetUp, worker: WorkerProcess, tmp_path: Path
) -> None:
    async def work() -> None:
        session = Session.open(tmp_path / "twice", "block60", None, worker)
        planning = session.planning
        data = (folder / "pa.dcm").read_bytes()
        for name in NAMES:
            await planning.take(data, ".dcm", image=name)
        place(session, clicks(three), tuple(BEAMS))
        assert planning.planned is not None and planning.planned.plan is None
        assert any("given twice" in why for why in planning.planned.refused.values())
        planning.case.close()
        case = Case.create(tmp_path / "sent")
        record_changed(case, "frame", keep_frame(case, BLOCK), by=Actor.APP)
        for name in ("oblique", "lateral", "pa"):
            record_acquired(case, (folder / f"{name}.dcm").read_bytes(), ".dcm", by=Actor.RECEIVER)
        case.close()
        session = Session.open(tmp_path / "sent", None, None, worker)
        await session.planning.start()
        assert dict(session.planning.decisions.images) == {"oblique": 2, "lateral": 3, "pa": 4}
        session.planning.case.close()

    asyncio.run(work())
