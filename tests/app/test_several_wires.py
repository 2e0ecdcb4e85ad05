"""Several wires in the app, without a page: each keeps its points, and all are planned, sent and verified together."""

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from tests.app.given import mark
from tests.planning.bone import views
from tests.planning.test_wires import KEYS, WIRES_MM
from tests.worked import Worked

from sightline.app.drawing import shapes
from sightline.app.plan.decisions import Decisions, Mark
from sightline.app.plan.marks import END, ENTRY
from sightline.app.plan.planner import plan_input, planned, wires_placed
from sightline.app.session import rehearsing
from sightline.app.session.drilling_workflow import DrillingWorkflow
from sightline.app.session.jobs import Jobs
from sightline.app.session.planning import Planning
from sightline.app.session.rehearsing import Patient
from sightline.app.session.sent import SentPlan, restored
from sightline.app.tab.views import Views
from sightline.case.journal import Actor, Case, Kind
from sightline.errors import RobotRefusedError, SightlineError
from sightline.frame import Frame

KINDS = tuple(f"cannulated-hip-screws:{key}" for key in KEYS)
VIEWS: Any = tuple(views())
RELATIONS = {"parallel", "spacing", "inverted triangle"}


def _ends(wire_mm: np.ndarray) -> dict[str, Mark]:
    uv = [view.project(wire_mm) for view in VIEWS]
    return {name: mark([at[k] for at in uv]) for k, name in enumerate((ENTRY, END))}


def _decided(count: int = 3, current: int = 0) -> Decisions:
    """The first wires placed, one of them current."""
    decisions = Decisions(images={"pa": 1, "lateral": 2}, kind=KINDS[current], side="right", serial="1")
    for kind, wire in list(zip(KINDS, WIRES_MM, strict=True))[:count]:
        decisions = decisions.with_ends(kind, _ends(wire))
    return decisions


def test_each_wire_keeps_its_points_whichever_is_current() -> None:
    decisions = _decided()
    for kind in (KINDS[2], KINDS[0], KINDS[1]):
        decisions = decisions.with_kind(kind)
        assert decisions.marks == decisions.ends(kind)
        for other, wire in zip(KINDS, WIRES_MM, strict=True):
            assert decisions.ends(other) == _ends(wire)
    assert Decisions.of(decisions.document()) == decisions
    without = decisions.with_image("lateral", 3, same_pixels=False)
    assert [set(without.ends(kind)[END].places) for kind in KINDS] == [{"pa"}] * 3
    old = decisions.document()
    del old["wires"]
    assert not Decisions.of(old).wires


def test_another_procedure_begins_with_the_points_of_the_current_wire() -> None:
    decisions = _decided(current=1)
    hip = decisions.with_kind("hip-screw")
    assert hip.ends("hip-screw") == _ends(WIRES_MM[1])
    back = hip.with_mark(END, None).with_kind(KINDS[1])
    assert [back.ends(kind) for kind in KINDS] == [_ends(wire) for wire in WIRES_MM]


@pytest.mark.parametrize("current", [0, 2])
def test_relations_are_judged_and_the_current_wire_is_the_same_as_alone(current: int) -> None:
    known = planned(_decided(current=current), VIEWS)
    assert known.plan is not None and known.verdict is not None and tuple(known.plans) == KINDS
    assert known.plan.kind.key == KINDS[current]
    relations = [check for check in known.verdict.checks if check.name in RELATIONS]
    assert {check.name for check in relations} == RELATIONS and all(check.passed for check in relations)
    np.testing.assert_allclose(known.plan.trajectory.points.xyz_mm, WIRES_MM[current], atol=1e-6)
    styles = [one["style"] for one in shapes.wire(known, "pa")]
    assert styles == ["plan"] * 2 + ["implant", "thread", "corridor", "wire"]


def test_with_wires_missing_the_plan_is_incomplete_and_names_them() -> None:
    known = planned(_decided(2, current=2), VIEWS)
    assert known.plan is None and set(known.plans) == set(KINDS[:2])
    assert (
        known.verdict is not None
        and not known.verdict.go
        and "all wires" in {check.name for check in known.verdict.unmade}
    )
    asked = plan_input(_decided(2), 2)
    assert set(asked.others or {}) == {KEYS[1]} and asked.kind == KINDS[0]
    assert planned(_decided(0), VIEWS).verdict is None
    assert plan_input(Decisions(marks=_ends(WIRES_MM[0])), 2).others is None


def test_the_others_are_proposed_beside_the_lowest_but_never_over_a_drilled_one() -> None:
    known = planned(_decided(1, current=2), VIEWS)
    decisions = known.with_others_proposed()
    assert wires_placed(decisions) == list(KINDS) and decisions.kind == KINDS[2]
    assert not decisions.ends(KINDS[1])[END].free
    verdict = planned(decisions, VIEWS).verdict
    assert verdict is not None and all(check.passed for check in verdict.checks if check.name in RELATIONS)
    kept = planned(_decided(2), VIEWS).with_others_proposed([KINDS[1]])
    assert kept.ends(KINDS[1]) == _ends(WIRES_MM[1]) and KINDS[2] in wires_placed(kept)
    with pytest.raises(SightlineError, match="inferior wire first"):
        planned(Decisions(kind=KINDS[1], marks=_ends(WIRES_MM[1])), VIEWS).with_others_proposed()


@pytest.fixture
def planning(tmp_path: Path) -> Iterator[Planning]:
    """Three wires planned; the plan of the first was sent."""
    made: Any = _Planning.__new__(_Planning)
    made.case, made.jobs, made.frame = Case.create(tmp_path), Jobs(), Frame.load("gamma")
    made.now, made.all_sent, made.all_drilled = _decided(), {}, {}
    made.send()
    yield made
    made.case.close()


class _Planning(Planning):
    now: Decisions

    @property
    def decisions(self) -> Decisions:
        return self.now

    def send(self) -> None:
        known = planned(self.now, VIEWS)
        assert known.plan is not None
        content = {"decisions": self.now.document(), "trajectory": known.plan.trajectory.document()}
        entry = self.case.record(Kind.SENT, content, by=Actor.SURGEON)
        self.all_sent[self.now.kind] = SentPlan(known, entry.at, entry.number)


def test_the_robot_obeys_only_for_the_wire_whose_plan_it_holds(planning: Any) -> None:
    drilling: Any = DrillingWorkflow(planning, None, None)  # type: ignore[arg-type]
    drilling.session = _Session()
    with pytest.raises(RobotRefusedError, match="Send the plan again"):
        asyncio.run(drilling.align())  # nothing was sent since the robot was started
    drilling.held = planning.sent
    asyncio.run(drilling.align())
    planning.now = planning.now.with_kind(KINDS[1])
    with pytest.raises(RobotRefusedError, match="holds the plan of the inferior wire"):
        asyncio.run(drilling.align())
    planning.now = planning.now.with_ends(KINDS[1], {})  # another wire's points may change meanwhile
    planning.now = planning.now.with_kind(KINDS[0])
    asyncio.run(drilling.align())
    planning.now = planning.now.with_mark(END, None)
    with pytest.raises(RobotRefusedError, match="Send the plan again"):
        asyncio.run(drilling.align())


class _Session:
    now = SimpleNamespace(lost=False)

    async def align(self) -> None: ...


def test_what_was_sent_and_drilled_is_restored_for_each_wire(planning: Any) -> None:
    case, first = planning.case, planning.all_sent[KINDS[0]]
    drilled = case.record(Kind.DRILLED, {"record": {}}, by=Actor.ROBOT)
    planning.now = planning.now.with_kind(KINDS[2])
    planning.send()
    again = restored(case, planning.now.with_kind(KINDS[1]), VIEWS)
    assert set(again) == {KINDS[0], KINDS[2]}
    assert again[KINDS[0]][0].number == first.number < drilled.number < again[KINDS[2]][0].number
    assert all(sent.holds_for(planning.now) for sent, _ in again.values())
    moved = planning.now.with_ends(KINDS[0], {})
    assert not again[KINDS[0]][0].holds_for(moved) and again[KINDS[2]][0].holds_for(moved)


def test_images_of_the_newest_wire_show_the_others_too(worked: Worked, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rehearsing, "rehearsal_of", lambda _: worked.rehearsal)
    drilled = [replace(worked.drilled, wire_mm=worked.drilled.wire_mm + k) for k in range(2)]
    texts = {kind: one.text() for kind, one in zip(KINDS[:2], drilled, strict=True)}
    rehearsal, newest, key, before_mm = rehearsing._in_bone(Patient(1), texts)
    assert (rehearsal.procedure, newest.text(), key) == ("cannulated-hip-screws", drilled[1].text(), KEYS[1])
    assert list(before_mm) == [KEYS[0]] and np.array_equal(before_mm[KEYS[0]], drilled[0].axis_mm)


def test_over_a_check_image_stand_the_numbers_of_the_current_wire_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails where those of another wire could be read as its own; its arrows stay, with their titles."""
    arrow = {"shape": "arrow", "points": [], "style": "deviation", "label": "tip 0.22 ± 0.34 mm off", "title": "tip"}
    monkeypatch.setattr(shapes, "_deviations_there", lambda *_: [dict(arrow)])
    monkeypatch.setattr(shapes, "_planned_there", lambda *_: [])
    wire = SimpleNamespace(uv_px=np.zeros((2, 2)), tip_uv_px=np.zeros(2))
    verifying = SimpleNamespace(found={kind: {"check-pa": wire} for kind in KINDS}, shots={})
    decisions = SimpleNamespace(kind=KINDS[1])
    session: Any = SimpleNamespace(verifying=verifying, planning=SimpleNamespace(all_sent={}, decisions=decisions))
    arrows = [one for one in shapes.found(session, "check-pa") if one["shape"] == "arrow"]
    assert [one.get("label") for one in arrows] == [None, arrow["label"], None]
    assert {one["title"] for one in arrows} == {"tip"}


@pytest.mark.parametrize(
    ("beyond_mm", "depth_mm", "shown_mm"), [(0.0, 900.0, 0.0), (15.0, 900.0, 15.0), (15.0, None, 6.0)]
)
def test_a_drill_that_passes_its_end_point_is_filled_to_where_it_is(
    beyond_mm: float, depth_mm: float | None, shown_mm: float
) -> None:
    """Fails where the fill ends at the far hole while the drill goes on; never past the planned depth."""
    known = planned(_decided(1), VIEWS)
    assert known.plan is not None
    path = known.plan.trajectory
    kind: Any = SimpleNamespace(limits=SimpleNamespace(beyond_mm=beyond_mm))
    told: Any = SimpleNamespace(plan=SimpleNamespace(trajectory=path, kind=kind), views=known.views)
    depth_mm = path.length_mm + shown_mm if depth_mm is None else depth_mm
    (line,) = shapes.drilled(told, "pa", depth_mm)
    there = VIEWS[0].project((path.end_mm + shown_mm * path.direction)[None])[0]
    np.testing.assert_allclose(line["points"][-1], there, atol=1e-6)


@pytest.mark.parametrize(
    ("record_mm", "now", "shown_mm"),
    [
        (None, None, None),
        (None, (41.0, False), 41.0),
        (None, (41.0, False, "the plan of another wire"), None),  # fails where that wire's depth is filled in this one
        (None, (41.0, True), None),  # fails where the last depth of a lost robot is shown as if it were now
        ([0.0, 88.0, 98.5], (-20.0, False), 98.5),  # fails where the wire in the bone vanishes as the robot retracts
        ([0.0, 88.0, 98.5], None, 98.5),
    ],
)
def test_the_drilled_wire_is_filled_to_its_depth(
    record_mm: list[float] | None, now: tuple[Any, ...] | None, shown_mm: float | None
) -> None:
    record = None if record_mm is None else SimpleNamespace(record=SimpleNamespace(depth_mm=np.array(record_mm)))
    told = None if now is None else SimpleNamespace(depth_mm=now[0], lost=now[1])
    held = "this plan" if now is None or len(now) < 3 else now[2]
    session: Any = SimpleNamespace(
        drilling=SimpleNamespace(now=told, held=held), planning=SimpleNamespace(drilled=record, sent="this plan")
    )
    assert Views(session, cast(Any, None))._drilled_mm() == shown_mm


def test_the_drilled_wire_stays_on_the_plan_that_was_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails where it vanishes, or moves, with a change of the plan; other images show it no more."""
    drawn: list[object] = []
    monkeypatch.setattr(shapes, "drilled", lambda known, *_: drawn.append(known) or [])
    sent = SimpleNamespace(planned=SimpleNamespace(decisions=Decisions(images={"pa": 1, "lateral": 2})))
    planning = SimpleNamespace(sent=sent, drilled=None, planned="another plan", decisions=None)
    drilling = SimpleNamespace(now=SimpleNamespace(depth_mm=12.0, lost=False), held=sent)
    session: Any = SimpleNamespace(drilling=drilling, planning=planning)
    for number in (1, 3):
        planning.decisions = Decisions(images={"pa": number, "lateral": 2})
        Views(session, cast(Any, None))._filled("pa")
    assert drawn == [sent.planned]
