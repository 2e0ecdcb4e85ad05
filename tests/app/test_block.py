"""A case with a block: images named by a person, planned on together, and a third image that shows a movement."""

import asyncio
from pathlib import Path

import numpy as np
import pytest
from tests.three import BLOCK, POINTS_MM, draw_three, three_files
from tests.worked import Worked

from sightline.app.drawing import shapes
from sightline.app.panels.steps import StepStatus, steps
from sightline.app.plan.marks import END, ENTRY, marks_of
from sightline.app.plan.planner import plan_input
from sightline.app.session.jobs import WorkerProcess
from sightline.app.session.seen import entry_of
from sightline.app.session.session import Session
from sightline.app.tab.placing import Placing, ProcedureStep
from sightline.case.journal import Actor, Case
from sightline.case.replay import ReplayOutcome, replay
from sightline.case.stages import keep_frame, record_acquired, record_changed, record_planned
from sightline.case.views import NAMES, OBLIQUE
from sightline.common.checks import CheckCode
from sightline.twin import SetUp
from sightline.twin.xray.setup import BEAMS

LANDMARKS = [spec.name for spec in marks_of("hip-screw") if spec.group == "landmark"]
PICK_PX = 0.5


@pytest.fixture(scope="module")
def three() -> SetUp:
    """A set-up with three views."""
    return draw_three(np.random.default_rng(31), "flat-panel-0.3")[0]


@pytest.fixture(scope="module")
def files(three: SetUp, worked: Worked) -> dict[str, bytes]:
    return {name: file.read_bytes() for name, file in three_files(worked.folder, three).items()}


def _in_plane(three: SetUp) -> np.ndarray:
    """A shift of 2 mm (3,) in the plane of the first two beams, which no pair of images shows."""
    first, second = (three.views[name].detector.normal for name in NAMES)
    across = np.cross(first, second)
    shift = second - first
    shift = shift - across * (shift @ across) / (across @ across)
    return 2.0 * shift / np.linalg.norm(shift)


def _place(session: Session, three: SetUp, images: tuple[str, ...], shift_mm: np.ndarray | float = 0.0) -> None:
    """Click with half a pixel of noise: the wire in PA and lateral, landmarks in all; the bone shifts after the first
    image."""
    rng, decisions = np.random.default_rng(33), session.planning.decisions
    for k, image in enumerate(BEAMS):
        uv = three.views[image].project(three.hip_mm + POINTS_MM + (k > 0) * shift_mm)
        uv = uv + rng.normal(0.0, PICK_PX, uv.shape)
        for name, (u, v) in zip((ENTRY, END, *LANDMARKS), uv.tolist(), strict=True):
            if image in images and (image in NAMES or name in LANDMARKS):
                decisions = decisions.with_mark(name, decisions.mark(name).placed(image, (u, v), free=True))
    session.planning.edit(decisions)


def _movement(session: Session):
    known = session.planning.planned
    assert known is not None and known.plan is not None, known and known.refused
    return next(check for check in known.plan.verdict.checks if check.code is CheckCode.MOVEMENT)


@pytest.mark.slow  # three images are rendered and calibrated
def test_two_images_of_a_block_are_planned_on_and_a_third_shows_a_movement(
    files: dict[str, bytes], three: SetUp, worker: WorkerProcess, tmp_path: Path
) -> None:
    async def work() -> None:
        session = Session.open(tmp_path, "block60", None, worker)
        planning, shift = session.planning, _in_plane(three)
        await planning.start()
        await planning.take(files["pa"], ".dcm", image="pa")
        await planning.take(files["pa"], ".dcm", image="lateral")
        _place(session, three, tuple(BEAMS))
        assert planning.planned is not None and planning.planned.plan is None
        assert any("given twice" in why for why in planning.planned.refused.values())
        await planning.take(files["lateral"], ".dcm", image="lateral")
        views = planning.views()
        assert views is not None and len({view.adjustment for view in views}) == 1  # adjusted together
        assert steps(session)[1].status is StepStatus.DONE, steps(session)[1].reason
        _place(session, three, NAMES, shift)
        assert _movement(session).passed
        assert await planning.take(files[OBLIQUE], ".dcm", image=OBLIQUE) == OBLIQUE
        assert planning.names == (*NAMES, OBLIQUE)
        assert _movement(session).figure is None  # a new image has no marks: not tested
        goal = Placing(session).goal(ProcedureStep.PLAN)
        assert goal is not None and (goal.image, goal.spec.name) == (OBLIQUE, LANDMARKS[0])
        crosses = {one["title"].split(":")[0]: one["points"][0] for one in shapes.expected(planning.planned)}
        at = three.views[OBLIQUE].project(three.hip_mm + shift)[0]
        assert len(crosses) == 5 and np.linalg.norm(np.subtract(list(crosses.values()), at), axis=1).max() < 400.0
        _place(session, three, tuple(BEAMS), shift)
        assert not _movement(session).passed
        assert _movement(session).sentence.startswith("The bone seems to have moved between the 3 images")
        _place(session, three, tuple(BEAMS))
        assert _movement(session).passed
        known = planning.planned
        assert known is not None and known.plan is not None and shapes.wire(known, OBLIQUE)
        seen = [planning.seen(name) for name in planning.names]
        entries = [entry_of(planning.case, one) for one in seen if one is not None]
        record_planned(planning.case, entries, plan_input(planning.decisions, 3), known.plan, by=Actor.SURGEON)
        planning.case.close()

    asyncio.run(work())
    with Case.open(tmp_path, read_only=True) as case:
        found = [one for one in replay(case) if one.outcome is not ReplayOutcome.RECORDED]
        assert {one.outcome for one in found} == {ReplayOutcome.SAME}, found


@pytest.mark.slow  # three images are calibrated
def test_images_from_elsewhere_are_named_by_their_angles(
    files: dict[str, bytes], worker: WorkerProcess, tmp_path: Path
) -> None:
    with Case.create(tmp_path) as case:
        record_changed(case, "frame", keep_frame(case, BLOCK), by=Actor.APP)
        for name in ("oblique", "lateral", "pa"):
            record_acquired(case, files[name], ".dcm", by=Actor.RECEIVER)

    async def work() -> None:
        session = Session.open(tmp_path, None, None, worker)
        await session.planning.start()
        assert dict(session.planning.decisions.images) == {"oblique": 2, "lateral": 3, "pa": 4}
        session.planning.case.close()

    asyncio.run(work())
