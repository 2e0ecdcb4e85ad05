"""Sending and checking without a robot or a page: what fails leaves nothing that looks like success."""

import asyncio
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.app.given import marked
from tests.planning import bone
from tests.planning.standin import stand_in

from sightline.app import texts
from sightline.app.panels import steps
from sightline.app.plan.decisions import Decisions, Display, as_fitted
from sightline.app.plan.marks import END, ENTRY, marks_of
from sightline.app.plan.planner import drawn_head, planned
from sightline.app.session import drilling_workflow as module
from sightline.app.session.drilling_workflow import DrillingWorkflow
from sightline.app.session.jobs import Jobs
from sightline.app.session.planning import Planning
from sightline.app.session.sent import SentPlan, restored
from sightline.app.session.verifying import Verifying
from sightline.case.journal import Actor, Case, Kind
from sightline.errors import CaseError, LinkError, RobotRefusedError, UnusableInputError, WireRefusedError
from sightline.frame import Frame
from sightline.planning import PROCEDURES, kind

LANDMARK = "landmark-lesser-trochanter"


class _Planning(Planning):
    """Of a plan that was sent before."""

    def __init__(self, case: Any, known: Any) -> None:
        self.case, self.jobs, self.known, self.frame = case, Jobs(), known, Frame.load("gamma")
        self.all_sent, self.all_drilled = {known.decisions.kind: SentPlan(known, datetime.now(UTC))}, {}
        self.lacking_in = {}

    @property
    def decisions(self) -> Any:
        return self.known.decisions

    @property
    def planned(self) -> Any:
        return self.known

    def seen(self, image: str) -> Any:
        return SimpleNamespace(view=None)

    def write_picks(self, decisions: Decisions) -> None: ...


def _drilling(monkeypatch: pytest.MonkeyPatch, send: Any, record: Any) -> tuple[DrillingWorkflow, _Planning]:
    """A plan was sent, and another is confirmed."""
    stub = SimpleNamespace(number=1, q=(), entry_error_95_mm=0.5, end_error_95_mm=0.5, document=dict)
    for name in ("entry_of", "record_planned", "_depth_limit", "plan_input"):
        monkeypatch.setattr(module, name, lambda *_, **__: stub)
    decisions = Decisions(images={"pa": 1, "lateral": 2}, side="right", serial="1")
    plan = SimpleNamespace(trajectory=stub, kind=kind("hip-screw"))
    known: Any = SimpleNamespace(plan=plan, decisions=decisions, views=(), bone=None)
    case: Any = SimpleNamespace(number="C", last=1, record=record)
    planning: Any = _Planning(case, known)
    age: Any = SimpleNamespace(now_s=1.0)
    ready: Any = SimpleNamespace(can_send=True)
    made = DrillingWorkflow(planning, age, ready)
    session: Any = SimpleNamespace(now=SimpleNamespace(lost=False), target_for=lambda *_: stub, send=send)
    made.session, made.held = session, planning.sent
    return made, planning


async def _taken(*_: Any) -> None: ...


async def _lost(*_: Any) -> None:
    raise LinkError("no answer")


def _full(*_: Any, **__: Any) -> None:
    raise CaseError("the disk is full")


@pytest.mark.parametrize(("send", "record"), [(_lost, lambda *_, **__: None), (_taken, _full)])
def test_a_plan_that_the_robot_may_hold_gets_no_order_meant_for_the_one_before(
    monkeypatch: pytest.MonkeyPatch, send: Any, record: Any
) -> None:
    drilling, planning = _drilling(monkeypatch, send, record)
    assert planning.sent_is_current
    with pytest.raises((LinkError, CaseError)):
        asyncio.run(drilling.send(planning.known))
    assert not planning.sent_is_current
    with pytest.raises(RobotRefusedError, match="Send the plan again"):
        asyncio.run(drilling.align())


def _drawn(decisions: Decisions) -> Decisions:
    """Three clicks on the head's rim, and a landmark, in both images."""
    shown, turns = bone.views(), np.array([0.4, 2.3, 4.6])
    rims = np.stack([bone.rim(view, turns) for view in shown], axis=1)
    uv = {LANDMARK: np.stack([view.project(bone.LESSER_MM[None])[0] for view in shown])}
    return marked(decisions, uv | {f"head-{k + 1}": at for k, at in enumerate(rims)})


def _moved(decisions: Decisions, name: str, image: str) -> Decisions:
    return decisions.with_mark(name, decisions.mark(name).placed(image, (500.0, 500.0)))


_ANOTHER: Any = "another fit"


def _fitted(decisions: Decisions) -> Decisions:
    head = drawn_head(decisions)
    assert head is not None
    return replace(decisions, fitted_head=as_fitted(head, {}))


@pytest.mark.parametrize(
    ("change", "current"),
    [
        (_fitted, False),
        (lambda now: replace(now, borders=True), False),
        (lambda now: replace(now, fitted_shaft=_ANOTHER), False),
        (lambda now: replace(now, fitted_neck=_ANOTHER), False),
        (lambda now: _moved(now, "head-2", "lateral"), False),
        (lambda now: now.with_mark("head-1", None), False),
        (lambda now: _moved(now, "neck-1", "pa"), False),
        (lambda now: _moved(now, LANDMARK, "pa"), False),
        (lambda now: _moved(now, LANDMARK, "check-pa"), True),  # found again after drilling
        (lambda now: _moved(now, LANDMARK, "shot-lateral"), True),
        (lambda now: replace(now, display={"pa": Display(90)}), True),
        (lambda now: replace(now, snapping=False), True),
    ],
)
def test_the_robot_does_not_drill_once_verdict_or_depth_limit_could_be_others(
    monkeypatch: pytest.MonkeyPatch, change: Callable[[Decisions], Decisions], current: bool
) -> None:
    """The depth limit is counted from the head as it was when the plan was sent."""
    drilling, planning = _drilling(monkeypatch, _taken, lambda *_, **__: None)
    aligned: list[bool] = []

    async def align() -> None:
        aligned.append(True)

    robot: Any = SimpleNamespace(now=SimpleNamespace(lost=False), align=align)
    drilling.session = robot
    decisions = _drawn(planning.decisions)
    planning.known.decisions = decisions
    known: Any = SimpleNamespace(plan=planning.known.plan, decisions=decisions)
    drilling.held = planning.all_sent[decisions.kind] = SentPlan(known, datetime.now(UTC))
    asyncio.run(drilling.align())
    planning.known.decisions = change(decisions)
    if current:
        asyncio.run(drilling.align())
        assert len(aligned) == 2
    else:
        with pytest.raises(RobotRefusedError, match="Send the plan again"):
            asyncio.run(drilling.align())
        planning.known.decisions = decisions  # undone
        asyncio.run(drilling.align())


def test_a_plan_of_a_procedure_whose_file_changed_is_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    drilling, planning = _drilling(monkeypatch, _taken, lambda *_, **__: None)
    planning.known.plan.kind = kind("free-wire")  # what the decisions' key named when the plan was made
    with pytest.raises(RobotRefusedError, match="the plan changed after you confirmed it"):
        asyncio.run(drilling.send(planning.known))
    assert not planning.sent_is_current


def test_a_check_shot_that_is_refused_is_recorded_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report repeats the last entry, which must not be that of the shot before."""
    planning: Any = SimpleNamespace(
        jobs=Jobs(), decisions=SimpleNamespace(kind="hip-screw"), all_drilled={}, all_sent={"hip-screw": None}
    )
    planning.kinds = ("hip-screw",)
    verifying, recorded, said = Verifying(planning), [], []
    session: Any = SimpleNamespace(planning=planning, verifying=verifying)
    asked: Any = SimpleNamespace(key=("new",), seen=[None], kind="hip-screw")

    async def not_found(*_: Any) -> None:
        said.append(steps._verify(session)[1])
        raise WireRefusedError("no wire is seen")

    async def updated() -> None:
        verifying.update()
        await asyncio.sleep(0.0)

    monkeypatch.setattr(verifying, "_requests", lambda: [asked])
    monkeypatch.setattr(verifying, "_found", not_found)
    monkeypatch.setattr(verifying, "_record", lambda _, found: recorded.append(found))
    asyncio.run(updated())
    assert said == [texts.SHOT_MEASURING]  # fails where the page asks for the images that it is looking at
    assert recorded == [verifying.refused] and steps._verify(session)[1] == verifying.refused
    assert "no wire is seen" in verifying.refused


VIEWS = (stand_in("pa", 0.4, 0.3), stand_in("lateral", -0.2, 0.3))


@pytest.fixture
def sent_case(tmp_path: Path) -> Iterator[tuple[Case, Decisions]]:
    """A case whose plan was sent before the program ended."""
    wire = bone.pixels(list(VIEWS))["wire"]
    places = {name: [uv[k] for uv in wire] for k, name in enumerate((ENTRY, END))}
    decisions = marked(Decisions(images={"pa": 1, "lateral": 2}), places)
    plan = planned(decisions, VIEWS).plan
    assert plan is not None
    case = Case.create(tmp_path)
    case.record(
        Kind.SENT, {"decisions": decisions.document(), "trajectory": plan.trajectory.document()}, by=Actor.SURGEON
    )
    yield case, decisions
    case.close()


def test_a_plan_that_was_sent_is_taken_up_again_after_a_restart(sent_case: tuple[Case, Decisions]) -> None:
    case, decisions = sent_case
    sent, drilled = restored(case, decisions, VIEWS)["hip-screw"]
    assert sent.holds_for(decisions) and drilled is None
    assert not sent.holds_for(decisions.with_mark(END, None))
    assert restored(case, decisions.with_image("pa", 3, same_pixels=True), VIEWS) == {}


def test_a_plan_that_comes_out_otherwise_is_not(sent_case: tuple[Case, Decisions]) -> None:
    case, decisions = sent_case
    moved = (stand_in("pa", 0.41, 0.3), VIEWS[1])
    with pytest.raises(UnusableInputError, match="Send the plan again"):
        restored(case, decisions, moved)


def test_a_plan_that_was_sent_by_another_file_of_its_procedure_is_not(sent_case: tuple[Case, Decisions]) -> None:
    case, decisions = sent_case
    sent = case.latest(Kind.SENT)
    assert sent is not None
    for fingerprint in (kind("hip-screw").fingerprint, "hip-screw#0123456789abcdef"):
        case.record(Kind.SENT, {**sent.content, "procedure": fingerprint}, by=Actor.SURGEON)
        if fingerprint == kind("hip-screw").fingerprint:
            assert restored(case, decisions, VIEWS)
            continue
        with pytest.raises(UnusableInputError, match="Send the plan again"):
            restored(case, decisions, VIEWS)


@pytest.mark.parametrize("key", sorted(PROCEDURES))
def test_a_page_asks_for_what_each_procedure_names(key: str) -> None:
    marks = marks_of(key)
    names = [one.name for one in marks]
    assert names[:2] == [ENTRY, END] and len(set(names)) == len(names)
    known = PROCEDURES[key]
    assert {one.of for one in marks} >= {one.key for one in known.landmarks}
    assert {one.of for one in marks if one.group == "aid"} == {one.key for one in known.aids}
