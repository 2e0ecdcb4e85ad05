"""Sending and checking without a robot or a page: what fails leaves nothing that looks like success."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from sightline.app.work import drilling as module
from sightline.app.work.drilling import Drilling
from sightline.app.work.verifying import Verifying
from sightline.errors import CaseError, LinkError, RobotRefusedError, WireRefusedError


def _drilling(monkeypatch: pytest.MonkeyPatch, send: Any, record: Any) -> tuple[Drilling, Any]:
    """Before a plan that was sent, another is confirmed."""
    stub = SimpleNamespace(number=1, q=(), entry_error_95_mm=0.5, end_error_95_mm=0.5, document=dict)
    for name in ("entry_of", "record_planned", "_depth_limit", "asked"):
        monkeypatch.setattr(module, name, lambda *_, **__: stub)
    decisions = SimpleNamespace(
        images={"pa": 1, "lateral": 2}, side="right", serial="1", kind="hip-screw", mirrored={}, document=dict
    )
    known: Any = SimpleNamespace(plan=SimpleNamespace(trajectory=stub), decisions=decisions)
    case = SimpleNamespace(number="C", last=1, record=record)
    procedure: Any = SimpleNamespace(
        planned=known,
        go=True,
        can_send=True,
        age_s=1.0,
        decisions=decisions,
        case=case,
        seen=lambda name: stub,
        notify=lambda: None,
    )
    made = Drilling(procedure)
    session: Any = SimpleNamespace(now=SimpleNamespace(lost=False), aimed=lambda *_: stub, send=send)
    made.session, made.sent = session, SimpleNamespace(decisions=decisions)  # pyright: ignore[reportAttributeAccessIssue]
    return made, known


async def _taken(*_: Any) -> None: ...


async def _lost(*_: Any) -> None:
    raise LinkError("no answer")


def _full(*_: Any, **__: Any) -> None:
    raise CaseError("the disk is full")


@pytest.mark.parametrize(("send", "record"), [(_lost, lambda *_, **__: None), (_taken, _full)])
def test_a_plan_that_the_robot_may_hold_gets_no_order_meant_for_the_one_before(
    monkeypatch: pytest.MonkeyPatch, send: Any, record: Any
) -> None:
    drilling, known = _drilling(monkeypatch, send, record)
    with pytest.raises((LinkError, CaseError)):
        asyncio.run(drilling.send(known))
    assert not drilling.current
    with pytest.raises(RobotRefusedError, match="send it again"):
        asyncio.run(drilling.align())


def test_a_check_shot_that_is_refused_is_recorded_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report repeats the last word; it must not be that of the shot before."""
    procedure: Any = SimpleNamespace(notify=lambda: None)
    verifying, recorded = Verifying(procedure), []
    asked: Any = SimpleNamespace(key=("new",), seen=[None])

    async def not_found(*_: Any) -> None:
        raise WireRefusedError("no wire is seen")

    monkeypatch.setattr(verifying, "_asked", lambda: asked)
    monkeypatch.setattr(verifying, "_found", not_found)
    monkeypatch.setattr(verifying, "_record", lambda _, found: recorded.append(found))
    asyncio.run(verifying.measure())
    assert recorded == [verifying.refused]
    assert "no wire is seen" in verifying.refused
