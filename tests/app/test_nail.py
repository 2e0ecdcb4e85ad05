"""The holes of a nail in the app, without a page: what is asked for, planned, searched again, and refused."""

import asyncio
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmarks.scenes.nails import seen
from scipy.spatial.transform import RigidTransform
from tests.app.given import mark, marked
from tests.planning.test_hole import camera_matrix
from tests.planning.test_two_holes import ERRORS, KNOWN, NAIL, SIGHTS, VIEWS

from sightline.app.drawing import shapes
from sightline.app.panels import steps, verify
from sightline.app.plan.decisions import Decisions
from sightline.app.plan.marks import NAIL_EDGES, hole_mark
from sightline.app.plan.planner import NAIL as STROKES
from sightline.app.plan.planner import HolesFound, nail_drawn, of_wire, picks_of, plan_input, planned, with_nail
from sightline.app.session.jobs import Jobs
from sightline.app.session.seen import NailInImages
from sightline.app.tab.placing import ProcedureStep, _goals
from sightline.calibration import view_from_matrix
from sightline.case.views import NAMES
from sightline.imaging import Radiograph
from sightline.planning import Hole, Nail, WirePicks, fit_hole, plan_wires
from sightline.planning.procedures.procedure import document_of

KEYS = ("distal", "proximal")
KINDS = tuple(f"distal-interlocking:{key}" for key in KEYS)
MIDDLES = dict(zip(KEYS, NAIL.holes[::-1, 0], strict=True))


@pytest.fixture(scope="module")
def holes() -> dict[str, Hole]:
    rng = np.random.default_rng(5)
    return {key: fit_hole(VIEWS, seen(rng, NAIL, SIGHTS, n), KNOWN) for n, key in ((1, "distal"), (0, "proximal"))}


def _decided(keys: tuple[str, ...] = KEYS, **given: Any) -> Decisions:
    """The strokes drawn, these holes clicked, and two landmarks."""
    rng = np.random.default_rng(6)
    decisions = Decisions(
        **{"images": {"pa": 1, "lateral": 2}, "kind": KINDS[0], "side": "right", "nail": KNOWN, **given}
    )
    places: dict[str, Any] = {spec.name: rng.uniform(100.0, 900.0, (2, 2)) for spec in NAIL_EDGES}
    landmarks = NAIL.placed(np.array([[0.0, 0.0, 40.0], [0.0, -20.0, 14.0]]))
    clicked = {hole_mark(key): MIDDLES[key] for key in keys}
    clicked |= {f"landmark-{name}": at for name, at in zip(("nail-tip", "lateral-epicondyle"), landmarks, strict=True)}
    places |= {name: [view.project(at[None])[0] for view in VIEWS] for name, at in clicked.items()}
    return marked(decisions, places)


def _found(decisions: Decisions, holes: dict[str, Hole], **given: Any) -> HolesFound:
    drawn: Any = nail_drawn(decisions)
    return HolesFound(drawn, tuple(VIEWS), (), holes=holes, **given)  # type: ignore[arg-type]


def test_a_chosen_nail_is_asked_for_by_strokes_and_clicks_image_by_image() -> None:
    decisions = replace(Decisions(kind=KINDS[0]), nail=KNOWN)
    edges = [spec.name for spec in NAIL_EDGES]
    asked = [goal.spec.name for goal in _goals([s for s in decisions.specs if s.group == "nail"], NAMES)]
    assert asked == 2 * [*edges, "hole-distal", "hole-proximal"] and len(edges) == 4
    assert {spec.group for spec in decisions.specs} == {"nail", "landmark"}
    assert {spec.group for spec in replace(decisions, nail=None).specs} == {"wire", "landmark", "aid"}
    assert {spec.group for spec in replace(decisions, kind="hip-screw").specs} == {"wire", "landmark", "aid"}
    assert nail_drawn(decisions) is None and nail_drawn(replace(_decided(), nail=None)) is None


def test_strokes_and_clicks_are_kept_in_their_order_and_with_the_case() -> None:
    decisions = _decided(("proximal",))
    again = Decisions.of(decisions.document())
    assert again == decisions and again.nail == KNOWN
    drawn = nail_drawn(again)
    assert drawn is not None and drawn.strokes_px.shape == (2, 2, 2, 2) and list(drawn.clicks_px) == ["proximal"]
    for k, image in enumerate(NAMES):
        for n, spec in enumerate(NAIL_EDGES):
            assert tuple(drawn.strokes_px[k, n // 2, n % 2]) == decisions.mark(spec.name).at(image)
    assert with_nail(Decisions(kind=KINDS[0]), drawn).marks.items() <= decisions.marks.items()
    assert of_wire(with_nail(Decisions(kind=KINDS[0]), drawn), KINDS[1]) == of_wire(decisions, KINDS[1])
    picked = picks_of(decisions, NAMES).nail
    assert picked is not None
    in_file = picked.drawn(())
    assert in_file.nail == drawn.nail and np.array_equal(in_file.strokes_px, drawn.strokes_px)
    assert np.array_equal(in_file.clicks_px["proximal"], drawn.clicks_px["proximal"])
    old = decisions.document()
    del old["nail"]
    assert Decisions.of(old).nail is None
    assert nail_drawn(decisions.with_image("lateral", 3, same_pixels=False)) is None


def test_the_plan_is_that_of_the_command_line_on_the_same_holes(holes: dict[str, Hole]) -> None:
    decisions = _decided()
    known = planned(decisions, VIEWS, _found(decisions, holes))  # type: ignore[arg-type]
    asked = plan_input(decisions, 2)
    assert asked.landmarks_uv_px is not None and asked.nail is not None and asked.others is not None
    wanted = plan_wires(
        VIEWS,
        {key: WirePicks.of_hole(hole, VIEWS) for key, hole in holes.items()},
        procedure=document_of("distal-interlocking"),
        side="right",
        landmarks_uv_px=asked.landmarks_uv_px,
        landmark_names=asked.landmark_names,
    )
    assert known.verdict is not None and known.verdict.state == wanted.verdict.state == "go"
    for kind, key in zip(KINDS, KEYS, strict=True):
        np.testing.assert_array_equal(known.plans[kind].trajectory.entry_mm, wanted.plans[key].trajectory.entry_mm)
        assert known.plans[kind].hole is not None
    np.testing.assert_array_equal(asked.entry_uv_px, asked.nail.clicks_px["distal"])
    np.testing.assert_array_equal(asked.others["proximal"].end_uv_px, asked.nail.clicks_px["proximal"])
    assert plan_input(decisions, 2, KINDS[1]).of_wire("distal").kind == KINDS[0]
    other = planned(replace(decisions, kind=KINDS[1]), VIEWS, _found(decisions, holes))  # type: ignore[arg-type]
    assert other.plan is not None and other.plan.kind.key == KINDS[1]


def test_one_hole_alone_is_incomplete_and_no_hole_is_no_plan(holes: dict[str, Hole]) -> None:
    decisions = _decided(("distal",))
    known = planned(decisions, VIEWS, _found(decisions, {"distal": holes["distal"]}))  # type: ignore[arg-type]
    assert known.plan is not None and known.verdict is not None and known.verdict.state == "incomplete"
    assert "proximal hole" in " ".join(check.sentence for check in known.verdict.unmade)
    for found in (None, _found(_decided(()), {})):
        none = planned(decisions, VIEWS, found)  # type: ignore[arg-type]
        assert none.plan is None and none.verdict is None and not none.refused


def test_holes_that_may_be_confused_are_refused_with_a_sentence(holes: dict[str, Hole]) -> None:
    """How: tests/planning/test_two_holes.py."""
    decisions = _decided(side="left")
    known = planned(decisions, VIEWS, _found(decisions, holes))  # type: ignore[arg-type]
    assert known.plan is None and known.verdict is None and "the holes are exchanged" in known.refused["plan"]


def test_without_a_side_and_with_a_refused_hole_there_is_no_plan(holes: dict[str, Hole]) -> None:
    decisions = _decided()
    unsure = planned(replace(decisions, side=None), VIEWS, _found(decisions, holes))  # type: ignore[arg-type]
    assert unsure.verdict is None and "give the side of the patient" in unsure.refused["plan"]
    found = _found(decisions, {"distal": holes["distal"]}, refused={"hole-proximal": "one rim alone"})
    refused = planned(decisions, VIEWS, found)  # type: ignore[arg-type]
    assert refused.verdict is None and refused.refused == {"hole-proximal": "one rim alone"}


def test_views_less_than_20_degrees_apart_and_images_without_a_nail_are_refused() -> None:
    drawn: Any = nail_drawn(_decided())
    dark: Any = [Radiograph(np.full((1024, 1024), 900, dtype=np.uint16), white=1000)] * 2
    near: Any = [VIEWS[0], view_from_matrix(camera_matrix(-100.0), ERRORS, "lateral")]
    refused = HolesFound.find(drawn, near, dark)
    assert "at least 20° is needed" in refused.refused[STROKES] and not refused.holes
    views: Any = VIEWS
    empty = HolesFound.find(drawn, views, dark)
    assert "no edge of a nail lies along a stroke" in empty.refused[STROKES] and empty.nail is None
    assert empty.is_of(drawn, views) and not empty.is_of(drawn, near) and not empty.is_of(None, views)
    moved = replace(drawn, clicks_px={"distal": drawn.clicks_px["distal"] + 0.1})
    assert not empty.is_of(moved, views)
    known = planned(_decided(), views, empty)
    assert known.verdict is None and shapes.nail_found(known, "pa") == []


def test_a_search_runs_beside_the_page_again_after_a_change_and_not_after_a_defect(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn: list[Any] = [nail_drawn(_decided())]
    searched: list[Any] = []

    def find(now: Any, views: Any, images: Any, before: Any) -> HolesFound:
        searched.append(now)
        if len(searched) == 1:
            drawn[0] = replace(now, nail=Nail(12.0))  # changed while it is searched
        if len(searched) == 3:
            raise ZeroDivisionError
        return HolesFound(now, views, images)

    monkeypatch.setattr(HolesFound, "find", find)

    async def work() -> None:
        jobs = Jobs()
        nail = NailInImages(lambda: (drawn[0], (), ()), jobs)
        jobs.listeners.append(nail.update)
        jobs.notify()
        assert nail.searching and nail.found is None
        jobs.notify()  # one search at a time
        while nail.searching or nail.found is None:
            await asyncio.sleep(0.001)
        assert len(searched) == 2 and nail.found.drawn is drawn[0]
        drawn[0] = nail_drawn(_decided(("distal",)))
        jobs.notify()
        while nail.searching:
            await asyncio.sleep(0.001)
        jobs.notify()
        assert len(searched) == 3 and nail.found is not None
        assert "something in Sightline failed (ZeroDivisionError)" in nail.found.refused[STROKES]

    asyncio.run(work())


def test_a_sent_hole_holds_until_its_own_marks_change() -> None:
    decisions = _decided()
    moved = decisions.with_mark("hole-proximal", mark(np.array([[1.0, 2.0], [3.0, 4.0]])))
    assert of_wire(moved, KINDS[0]) == of_wire(decisions, KINDS[0])
    assert of_wire(moved, KINDS[1]) != of_wire(decisions, KINDS[1])
    edge = decisions.with_mark(NAIL_EDGES[2].name, mark(np.array([[1.0, 2.0], [3.0, 4.0]])))
    for other in (edge, replace(decisions, nail=Nail(12.0)), replace(decisions, nail=None)):
        assert of_wire(other, KINDS[0]) != of_wire(decisions, KINDS[0])


def test_a_drilled_hole_is_judged_at_both_holes_and_its_arrow_begins_at_the_planned_tip(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Fails where a drill that is planned 15 mm past its far hole looks 15 mm off."""
    path = SimpleNamespace(entry_mm=np.zeros(3), end_mm=np.array([0.0, 0.0, 60.0]), direction=np.array([0.0, 0.0, 1.0]))
    plan = SimpleNamespace(trajectory=path, kind=SimpleNamespace(limits=SimpleNamespace(beyond_mm=15.0)))
    off = dict.fromkeys(("entry_deviation_mm", "tip_deviation_mm", "angle_rad", "entry_error_95_mm"), 0.1)
    off |= dict.fromkeys(("tip_error_95_mm", "direction_error_95_rad"), 0.1)
    ends = {"entry_mm": path.entry_mm, "tip_mm": np.array([0.0, 0.1, 75.0]), "movement": RigidTransform.identity()}
    shot = SimpleNamespace(at_holes=True, passed=True, checks=(), **off, **ends)
    verifying = SimpleNamespace(refused="", shot=shot, shots={KINDS[0]: shot})
    planning = SimpleNamespace(all_sent={KINDS[0]: SimpleNamespace(plan=plan)}, views=lambda _: VIEWS)
    session: Any = SimpleNamespace(verifying=verifying, planning=planning)
    for name, shown in (("put", str), ("table", lambda _, rows, **__: str(rows))):
        monkeypatch.setattr(verify, name, lambda *given, shown=shown, **more: told.append(shown(*given, **more)))
    monkeypatch.setattr(verify, "missing_again", lambda _: ())
    monkeypatch.setattr(shapes, "deviations", lambda _, planned, *__: planned[1].tolist())
    told: list[str] = []
    verify._result(SimpleNamespace(planning=planning, session=session))  # type: ignore[arg-type]
    assert "Judged at both holes of the nail" in told[0] and "tip, not judged" in told[1]
    assert shapes._deviations_there(session, KINDS[0], "check-pa") == [0.0, 0.0, 75.0]
    shot.at_holes = False
    verify._result(SimpleNamespace(planning=planning, session=session))  # type: ignore[arg-type]
    assert "holes" not in told[2] and "not judged" not in told[3]


def test_after_a_drilled_hole_the_page_leads_to_drilling_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[Any] = []
    order = SimpleNamespace(keys=KEYS)
    planning: Any = SimpleNamespace(drilling_order=order, kinds=KINDS, all_drilled={KINDS[0]: 1}, decisions=_decided())

    async def choose(decisions: Decisions) -> None:
        chosen.append(decisions.kind)

    buttons: list[tuple[Any, ...]] = []
    tab: Any = SimpleNamespace(planning=planning, step=ProcedureStep.VERIFY, choose=choose, go_to=chosen.append)
    monkeypatch.setattr(steps, "action", lambda text, follow, **_: buttons.append((text, follow)))
    steps.build_next_wire(tab)
    ((text, follow),) = buttons
    asyncio.run(follow())
    assert "proximal" in text and chosen == [KINDS[1], ProcedureStep.DRILL]
    planning.all_drilled[KINDS[1]] = 2
    assert steps.next_wire(tab) is None
