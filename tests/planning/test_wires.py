"""Plans of several wires: relations with their errors, and wrong plans that must not be GO."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sightline.common.checks import failed
from sightline.common.geometry.lines import across, unit
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.planning import (
    Axis,
    Plan,
    WireLines,
    WirePicks,
    WirePlans,
    plan,
    plan_wires,
    propose_others,
    reconstruct,
)
from sightline.planning.bone.directions import ANTERIOR, caudal
from sightline.planning.procedures import Procedure
from sightline.planning.procedures.document import ProcedureDocument
from sightline.planning.procedures.procedure import copy_text, document_from_json
from sightline.planning.verdict.relations import angle_rad, judge_relations, spacing_mm

from . import bone
from .bone import END_MM, ENTRY_MM, curve_once, views
from .standin import estimates, stand_in
from .test_wire_in_neck import neck_borders

KEYS = ("inferior", "anterior", "posterior")
ALONG = unit(END_MM - ENTRY_MM)
UP = unit(across(-caudal("right"), ALONG))
FRONT = unit(across(across(ANTERIOR, ALONG), UP))
# Off the inferior wire: above and in front, above and behind, mm.
OFF_MM = np.array([0.0 * UP, 9.3 * UP + 7.1 * FRONT, 10.2 * UP - 6.7 * FRONT])
WIRES_MM = np.array([ENTRY_MM - 5.0 * UP, END_MM - 5.0 * UP]) + OFF_MM[:, None]


def _document(change: dict[str, Any] | None = None, *, of_bone: bool = False) -> ProcedureDocument:
    """The shipped file of three wires, with changed relations by name; without the checks of the bone."""
    given = json.loads(copy_text("cannulated-hip-screws", "mine"))
    for relation in given["relations"]:
        relation.update((change or {}).get(relation["relation"], {}))
    given["checks"] = given["checks"] if of_bone else []
    return document_from_json(json.dumps(given))


def _picks(wires_mm: np.ndarray) -> dict[str, WirePicks]:
    uv = np.array([[view.project(wire) for view in views()] for wire in wires_mm])  # (wire, view, end, (u, v))
    return {key: WirePicks(one[:, 0], one[:, 1]) for key, one in zip(KEYS, uv, strict=False)}


def _planned(wires_mm: np.ndarray, document: ProcedureDocument | None = None, side: str | None = "right") -> WirePlans:
    return _planned_of(_picks(wires_mm), document, side=side)


def _planned_of(picks: dict[str, WirePicks], document: ProcedureDocument | None = None, **given: Any) -> WirePlans:
    given = {"procedure": document or _document(), "side": "right", "curve": lambda *_: curve_once()} | given
    return plan_wires(views(), picks, **given)


def _failed(made: WirePlans) -> set[str]:
    return {check.name for check in failed(made.verdict.checks)}


def test_three_parallel_wires_are_go_and_each_is_the_plan_of_its_wire_alone():
    made = _planned(WIRES_MM)
    assert made.verdict.state == "go", made.verdict.summary()
    assert {check.name for check in made.relations} == {"parallel", "spacing", "inverted triangle"}
    for key, picks in _picks(WIRES_MM).items():
        wire = Procedure.of(_document(), key)
        once = {"curve": lambda *_: curve_once()}
        alone = plan(views(), picks.entry_uv_px, picks.end_uv_px, procedure=wire, side="right", **once)
        np.testing.assert_array_equal(alone.trajectory.points.xyz_mm, made.plans[key].trajectory.points.xyz_mm)
        np.testing.assert_array_equal(alone.trajectory.covariance_mm2, made.plans[key].trajectory.covariance_mm2)
        assert (*alone.verdict.checks, *made.relations) == made.plans[key].verdict.checks
        assert any("are not checked" in said for said in alone.sentences())
        assert not any("are not checked" in said for said in made.plans[key].sentences())


def _not_parallel() -> np.ndarray:
    """The posterior wire's end off by the limit of 1° and three times the bound of the error."""
    bound_deg = next(check.figure for check in _planned(WIRES_MM).relations if check.name == "parallel")
    wires = WIRES_MM.copy()
    wires[2, 1] += np.deg2rad(1.0 + 3.0 * bound_deg) * np.linalg.norm(END_MM - ENTRY_MM) * -FRONT
    return wires


@pytest.mark.parametrize(
    ("wires_mm", "side", "broken"),
    [
        (WIRES_MM[[1, 0, 2]], "right", {"inverted triangle"}),
        (WIRES_MM[[0, 2, 1]], "right", {"inverted triangle"}),
        (WIRES_MM[[0, 1, 1]], "right", {"inverted triangle", "spacing"}),
        (WIRES_MM[0] - OFF_MM[:, None], "right", {"inverted triangle"}),
        (WIRES_MM, "left", {"inverted triangle"}),
        (WIRES_MM[:, ::-1], "left", {"inverted triangle"}),
        (np.array([*WIRES_MM[:2], WIRES_MM[2, ::-1]]), "right", {"parallel"}),
        (_not_parallel(), "right", {"parallel"}),
        (WIRES_MM[0] + 0.9 * 10.0 / 11.7 * OFF_MM[:, None], "right", {"spacing"}),
        (WIRES_MM[0] + 2.2 * OFF_MM[:, None], "right", {"spacing"}),
    ],
    ids=[
        "inferior and anterior exchanged",
        "anterior and posterior exchanged",
        "anterior picked twice",
        "triangle upside down",
        "wrong side",
        "wrong side, entries and ends exchanged",
        "one wire's entry and end exchanged",
        "not parallel",
        "too close",
        "too far apart",
    ],
)
def test_wrong_wires_are_no_go_each_of_them(wires_mm: np.ndarray, side: str, broken: set[str]):
    made = _planned(wires_mm, side=side)
    assert made.verdict.state == "no-go"
    assert broken <= _failed(made)
    assert not any("lies -" in check.sentence for check in made.relations)  # a person reads a direction, not a sign
    assert not any(one.verdict.go for one in made.plans.values())


@pytest.mark.parametrize("left_out", KEYS)
def test_without_a_wire_the_plan_is_incomplete_and_what_is_wrong_already_fails(left_out: str):
    def planned(wires_mm: np.ndarray) -> WirePlans:
        picks = {key: one for key, one in _picks(wires_mm).items() if key != left_out}
        return _planned_of(picks)

    made = planned(WIRES_MM)
    assert made.verdict.state == "incomplete"
    assert made.missing == (left_out,)
    assert _failed(made) == {"all wires", "parallel", "spacing", "inverted triangle"}
    assert all(one.verdict.go for one in made.plans.values())  # as planned one by one
    assert planned(WIRES_MM[[0, 0, 0]]).verdict.state == "no-go"
    without_side = _planned(WIRES_MM, side=None)
    assert (without_side.verdict.state, _failed(without_side)) == ("incomplete", {"inverted triangle"})


@pytest.mark.parametrize(
    ("change", "broken"),
    [
        ({"parallel": {"high": 0.2}}, "parallel"),
        ({"spacing": {"low": 11.6}}, "spacing"),
        ({"spacing": {"high": 13.8}}, "spacing"),
        ({"inverted triangle": {"wires": ["anterior", "inferior", "posterior"]}}, "inverted triangle"),
    ],
)
def test_each_relation_of_the_file_is_judged_by_its_own_limit(change: dict[str, Any], broken: str):
    made = _planned(WIRES_MM, _document(change))
    assert made.verdict.state == "no-go"
    assert _failed(made) == {broken}
    (check,) = failed(made.relations)
    limits = [value for value in change[broken].values() if isinstance(value, float)]
    assert [check.limit] == (limits or [0.0])


def test_the_plans_stand_in_the_order_of_drilling_of_the_file():
    order = ["posterior", "inferior", "anterior"]
    made = _planned(WIRES_MM, _document({"order": {"wires": order}}))
    assert list(made.plans) == order
    assert made.verdict.go


def test_the_checks_of_the_bone_are_asked_for_each_wire():
    made = _planned(WIRES_MM, _document(of_bone=True))
    assert made.verdict.state == "incomplete"
    said = [sentence for sentence in made.verdict.missing if sentence.startswith("The head is not drawn")]
    assert len(said) == 1  # once: it is the same for all wires


def test_a_placed_wire_takes_part_in_the_relations():
    covariance = 0.1**2 * np.eye(6)

    def planned(inferior_mm: np.ndarray, covariance_mm2: np.ndarray | None = covariance) -> WirePlans:
        picks = {key: one for key, one in _picks(WIRES_MM).items() if key != "inferior"}
        placed = {"inferior": Axis(inferior_mm, covariance_mm2)}
        return _planned_of(picks, placed=placed)

    made = planned(WIRES_MM[0])
    assert made.verdict.go, made.verdict.summary()
    assert made.missing == () and list(made.plans) == ["anterior", "posterior"]
    further_in = planned(WIRES_MM[0] + 20.0 * ALONG)  # measured elsewhere on the wire
    assert further_in.verdict.go and further_in.relations[1].figure == pytest.approx(made.relations[1].figure, abs=0.05)
    assert planned(_not_parallel()[2] - OFF_MM[2]).verdict.state == "no-go"
    assert planned(WIRES_MM[0], 9.0 * covariance * 9.0).verdict.state == "no-go"  # too badly known
    assert planned(WIRES_MM[0], None).verdict.state == "no-go"


def test_the_relations_that_were_not_checked_are_known():
    """None remain where the others are planned or placed; of a lone wire, and beside one other, those are named."""
    assert not any(one.unchecked_relations for one in _planned(WIRES_MM).plans.values())
    picks, every = _picks(WIRES_MM), ("inverted triangle", "parallel", "spacing")
    placed = {key: Axis(wire_mm, 0.01 * np.eye(6)) for key, wire_mm in zip(KEYS[:2], WIRES_MM[:2], strict=True)}
    last = {"posterior": picks["posterior"]}
    assert _planned_of(last, placed=placed).plans["posterior"].unchecked_relations == ()
    assert _planned_of(last, placed={"inferior": placed["inferior"]}).plans["posterior"].unchecked_relations == every
    assert _planned_of(last).plans["posterior"].unchecked_relations == every
    assert _planned_of(last, _document({"parallel": {"wires": KEYS[:2]}})).plans["posterior"].unchecked_relations == (
        "inverted triangle",
        "spacing",
    )


def test_unknown_and_repeated_wires_are_refused():
    picks = _picks(WIRES_MM)
    placed = {"inferior": Axis(WIRES_MM[0], np.eye(6))}
    for wires, there in (({}, {}), ({"lateral": picks["anterior"]}, {}), (picks, placed)):
        with pytest.raises(UnusableInputError, match="name each wire once"):
            _planned_of(wires, placed=there)
    with pytest.raises(UnusableInputError, match="the side is 'both'"):
        _planned(WIRES_MM, side="both")


def test_relations_do_not_depend_on_the_coordinates_or_the_order_of_the_wires():
    """Parallel and spacing under rotations and translations; all of them with the wires listed in another order."""
    rng = np.random.default_rng(3)
    root = rng.normal(0.0, 0.1, (18, 18))
    relations, names = _document().relations, {key: key for key in KEYS}
    lines = WireLines(KEYS, WIRES_MM, root @ root.T)
    first = judge_relations(relations, lines, names, "right").checks
    turn = Rotation.random(rng=rng).as_matrix()
    wide = np.kron(np.eye(6), turn)
    moved = WireLines(KEYS, WIRES_MM @ turn.T + [3.1, -80.2, 40.9], wide @ lines.joint_covariance_mm2 @ wide.T)
    for a, b in zip(first, judge_relations(relations, moved, names, "right").checks, strict=True):
        assert a.name == "inverted triangle" or a.figure == pytest.approx(b.figure, abs=1e-6)
    other = np.array([2, 0, 1])
    rows = (6 * other[:, None] + np.arange(6)).ravel()
    listed = WireLines(tuple(KEYS[k] for k in other), WIRES_MM[other], lines.joint_covariance_mm2[np.ix_(rows, rows)])
    for a, b in zip(first, judge_relations(relations, listed, names, "right").checks, strict=True):
        assert a.figure == pytest.approx(b.figure, abs=1e-9)


def _first(below_mm: float = 7.9, document: ProcedureDocument | None = None, outline: bool = True) -> Plan:
    """The plan of the lowest wire, so far below the neck's axis, with all aids of the shipped file drawn."""
    below = -unit(across(-caudal("right"), bone.NECK))
    ends = bone.ON_NECK_MM + below_mm * below + np.array([[-40.0], [52.0]]) * bone.NECK
    return plan(
        views(),
        *(np.array([view.project(end[None])[0] for view in views()]) for end in ends),
        procedure=Procedure.of(document or _document(of_bone=True), "inferior"),
        side="right",
        aids=replace(bone.aids(bone.pixels(views())), outline=tuple(map(neck_borders, views())) if outline else None),
        curve=lambda *_: curve_once(),
    )


def test_the_other_wires_are_proposed_within_the_neck_and_all_are_go_by_the_shipped_file():
    first = _first()
    proposed = propose_others(first)
    assert list(proposed) == ["anterior", "posterior"]
    picks = {key: WirePicks(one.entry_uv_px, one.end_uv_px) for key, one in proposed.items()}
    lesser = {"landmarks_uv_px": [view.project(bone.LESSER_MM[None]) for view in views()]}
    given = {"aids": first.arguments["aids"], "side": "right", "curve": lambda *_: curve_once()}
    given |= {**lesser, "landmark_names": ["lesser-trochanter"]}
    own = WirePicks(first.arguments["entry_uv_px"], first.arguments["end_uv_px"])
    made = _planned_of(picks | {"inferior": own}, _document(of_bone=True), **given)
    assert made.verdict.go, made.verdict.summary()
    depths = [np.linalg.norm(one.trajectory.end_mm - bone.CENTRE_MM) for one in made.plans.values()]
    assert depths == pytest.approx([depths[0]] * 3, abs=0.2)


def test_without_a_drawn_neck_the_smallest_spacing_is_proposed():
    first = _first(outline=False)
    ends = np.array([[one.entry_mm, one.end_mm] for one in propose_others(first).values()])
    three = np.array([first.trajectory.points.xyz_mm, *ends])[None]
    assert [spacing_mm(three, a, b)[0] for a, b in ((0, 1), (0, 2), (1, 2))] == pytest.approx([11.0] * 3, abs=1e-6)


def test_no_wires_are_proposed_where_they_have_no_place():
    with pytest.raises(ReconstructionRefusedError, match="have no space for wires 11 mm apart above the inferior wire"):
        propose_others(_first(below_mm=0.0))
    with pytest.raises(ReconstructionRefusedError, match="no inverted triangle with a spacing whose lowest wire it is"):
        propose_others(_first(document=_document({"inverted triangle": {"wires": list(KEYS[::-1])}}, of_bone=True)))


DRAWS = 200


@pytest.mark.slow
def test_the_relations_errors_are_as_stated_and_their_bounds_hold():
    """Sampled: errors of the views, those of the frame shared, and picks; wires 0.5° off parallel."""
    rng, true_views = np.random.default_rng(71), [stand_in("pa", 0.4), stand_in("lateral", -0.2)]
    wires_mm = WIRES_MM + np.deg2rad(0.5) * 88.0 * np.array([[[0]], [[0]], [[1]]]) * np.array([[0.0], [1.0]]) * UP
    exact = np.array([view.project(wires_mm.reshape(-1, 3)) for view in true_views])
    own = np.kron(np.eye(3), np.ones((6, 6)))
    relations, names = _document({"spacing": {"high": 99}}).relations, {key: key for key in KEYS}
    pairs = ((0, 1), (0, 2), (1, 2))

    def values(ends: np.ndarray) -> np.ndarray:
        """Differences of two pairs' directions, across the wires, and the distances of all pairs."""
        along = unit(ends[..., 1, :] - ends[..., 0, :])
        apart = [(along[:, b] - along[:, a]) @ np.array([UP, FRONT]).T for a, b in pairs[:2]]
        return np.concatenate([*apart, *(spacing_mm(ends, a, b)[:, None] for a, b in pairs)], axis=1)

    truth = values(wires_mm[None])[0]
    largest_deg = np.rad2deg(max(angle_rad(wires_mm[None], a, b)[0] for a, b in pairs))
    exactly = judge_relations(relations, WireLines(KEYS, wires_mm, 1e-12 * np.eye(18)), names, "right").checks
    true_figures = {check.name: check.figure for check in exactly}
    assert true_figures["parallel"] == pytest.approx(largest_deg, abs=1e-3)
    joint, independent, held = [], [], []
    for _ in range(DRAWS):
        lines = WireLines.of(
            KEYS, reconstruct(estimates(true_views, rng), exact + rng.normal(0.0, 0.5, exact.shape)), {}
        )
        for squares, factor in ((joint, 1.0), (independent, own)):
            given = replace(lines, joint_covariance_mm2=lines.joint_covariance_mm2 * factor)
            value, covariance = given.linear(values)
            squares.append((value - truth) @ np.linalg.solve(covariance, value - truth))
        figures = {one.name: one.figure for one in judge_relations(relations, lines, names, "right").checks}
        held.append([figures["parallel"] >= true_figures["parallel"]])
        held[-1] += [figures[name] <= true_figures[name] for name in ("spacing", "inverted triangle")]
    sd = np.sqrt(2.0 * len(truth) / DRAWS)
    assert np.mean(joint) == pytest.approx(len(truth), abs=4.0 * sd)
    assert np.mean(independent) < len(truth) - 10.0 * sd
    assert (np.mean(held, axis=0) >= 0.95 - 4.0 * np.sqrt(0.05 * 0.95 / DRAWS)).all()
