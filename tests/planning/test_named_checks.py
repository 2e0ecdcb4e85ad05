"""Checks that a procedure's file names: every limit in it decides, metrics with their 95 % error, what is missing."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sightline.common.checks import Check
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.planning import Aids, Line, Plan, Procedure, kind, locate, metrics, plan
from sightline.planning.procedures.document import CHECKS
from sightline.planning.procedures.procedure import copy_text, document_from_json
from sightline.planning.verdict.bone_checks import MEASURES
from sightline.planning.verdict.implant import fitting

from . import bone
from .test_wire_in_neck import neck_borders

WIRE_MM = np.stack([bone.ENTRY_MM, bone.END_MM])
OTHERS = {name for name, known in CHECKS.items() if not known.side}  # of other bones: test_other_bones.py
LIMITED = [(name, limit) for name, known in CHECKS.items() if name not in OTHERS for limit in known.limits]
METRICS = set(CHECKS) - set(MEASURES)
_WIDE = {"low": -900.0, "high": 900.0}


def _procedure(**checks: dict[str, Any]) -> Procedure:
    """A hip screw's file with these checks alone, by their names with "_" for a space, and no limits that refuse."""
    given = json.loads(copy_text("hip-screw", "mine"))
    given["limits"]["position_mm"]["limit"] = given["limits"]["direction_deg"]["limit"] = 50.0
    given["aids"].append(json.loads(copy_text("cannulated-hip-screws", "other"))["aids"][3])  # the neck's outline
    del given["corridor"]  # else no wide limit of its room is taken
    given["checks"] = [
        {"check": name.replace("_", " "), **{limit: _WIDE[limit] for limit in CHECKS[name.replace("_", " ")].limits}}
        | {"source": "a test"}
        | changed
        for name, changed in checks.items()
    ]
    return Procedure.of(document_from_json(json.dumps(given)))


def _plan(procedure: Procedure, aids: Aids | None = None, side: str | None = "right") -> Plan:
    uv = np.array([view.project(WIRE_MM) for view in bone.views()])
    return plan(
        bone.views(),
        uv[:, 0],
        uv[:, 1],
        procedure=procedure,
        side=side,
        aids=replace(bone.aids(bone.pixels(bone.views())), outline=_outline()) if aids is None else aids,
        landmarks_uv_px=np.array([view.project(bone.LESSER_MM[None]) for view in bone.views()]),
        landmark_names=("lesser-trochanter",),
        curve=lambda *_: bone.curve_once(),
    )


@cache
def _outline() -> tuple[tuple[Line, Line], tuple[Line, Line]]:
    first, second = (neck_borders(view) for view in bone.views())
    return first, second


def _of_file(made: Plan, at: int = 0) -> Check:
    """The check of the bone at this place: they come last, after the agreement of the head's outlines."""
    names = [check.name for check in made.verdict.checks]
    return made.verdict.checks[names.index("head agreement") + 1 + at]


@pytest.mark.parametrize(("name", "limit"), LIMITED)
def test_each_limit_in_a_file_decides_the_verdict(name: str, limit: str):
    """A limit a hundredth to either side of the value, with its error where the check has one."""
    wide = _of_file(_plan(_procedure(**{name: {}})))
    assert wide.passed and wide.figure is not None
    error = 0.0
    if name in METRICS:
        found = {one.name: one for one in metrics(_plan(_procedure()).anatomy, "right")}[name]
        assert (found.value, found.sd is not None) == (wide.figure, True)
        error = TWO_SIDED_95 * found.sd
        assert 0.05 < error < 3.0
    inward = 1.0 if limit == "low" else -1.0
    edge = wide.figure - inward * error
    kept = _of_file(_plan(_procedure(**{name: {limit: edge - 0.01 * inward}})))
    missed = _of_file(_plan(_procedure(**{name: {limit: edge + 0.01 * inward}})))
    assert (kept.passed, missed.passed) == (True, False)
    assert missed.limit == pytest.approx(edge + 0.01 * inward)
    assert len(missed.sentence) > len(kept.sentence)  # it says what to do


@pytest.mark.parametrize(
    ("name", "without"),
    [
        ("tip-apex distance", "neck"),
        ("calcar tip-apex distance", "calcar"),
        ("tip to bone nearest", "head"),
        ("wire in neck", "outline"),
        ("wire to shaft", "shaft"),
    ],
)
def test_a_check_without_its_aid_is_missing_and_an_optional_one_is_said_to_be_left_out(name: str, without: str):
    uv = bone.pixels(bone.views())
    aids = Aids(**{part: value for part, value in vars(bone.aids(uv)).items() if part != without})
    asked = {limit: _WIDE[limit] for limit in CHECKS[name].limits}
    required = _plan(_procedure(**{name: asked}), aids)
    assert required.verdict.state == "incomplete"
    (said,) = (one for one in required.verdict.missing if name in one)
    assert without in said and ("draw" in said or "click" in said)
    optional = _plan(_procedure(**{name: {**asked, "optional": "it is a test"}}), aids)
    assert name not in {check.name for check in optional.verdict.checks}
    (said,) = (one for one in optional.sentences() if name in one)
    assert without in said and said.endswith("A plan may do without it: it is a test.")


def test_metrics_are_not_judged_on_an_unknown_side_or_with_exchanged_ends():
    asked = _procedure(**{"tip-apex distance": {}})
    assert "tip-apex distance" in {check.name for check in _plan(asked, side=None).verdict.unmade}
    uv = np.array([view.project(WIRE_MM[::-1]) for view in bone.views()])
    aids = bone.aids(bone.pixels(bone.views()))
    other = plan(
        bone.views(), uv[:, 0], uv[:, 1], procedure=asked, side="right", aids=aids, curve=lambda *_: bone.curve_once()
    )
    assert "tip-apex distance" not in {check.name for check in other.verdict.checks}


def test_the_angle_between_views_is_that_of_their_beams():
    made = _plan(_procedure(**{"angle between views": {"low": 10.0}}))
    one, other = (WIRE_MM.mean(axis=0) - view.focal_point_mm for view in bone.views())
    angle = np.rad2deg(np.arccos(abs(one @ other) / np.linalg.norm(one) / np.linalg.norm(other)))
    assert _of_file(made).figure == pytest.approx(angle, abs=1e-2)


@pytest.mark.parametrize(
    ("wire_mm", "length_mm"), [(49.9, None), (50.0, 50.0), (98.6, 95.0), (149.9, 145.0), (150.1, None)]
)
def test_the_longest_screw_that_is_not_longer_than_the_wire_fits(wire_mm: float, length_mm: float | None):
    catalogue = kind("hip-screw").document.catalogue
    assert catalogue is not None
    made = fitting(catalogue, wire_mm, None, None)
    assert made is not None and (made.length_mm, made.plate_angle_deg) == (length_mm, None)
    assert f"{wire_mm:.1f} mm" in made.sentence and ("None of the lag screws" in made.sentence) == (length_mm is None)
    holes = kind("distal-interlocking").document.catalogue
    assert holes is not None and fitting(holes, wire_mm, None, None) is None  # the screw is longer than the wire


def test_the_plate_is_that_of_the_neck_shaft_angle_and_two_where_its_error_leaves_both():
    catalogue = kind("hip-screw").document.catalogue
    assert catalogue is not None
    uv = bone.pixels(bone.views())
    sure, unsure = (locate(bone.views(), bone.aids(uv, sd), bone.picks(uv)) for sd in (0.1, 6.0))
    truth = np.rad2deg(bone.NECK_SHAFT_RAD)
    exact = fitting(catalogue, 90.0, sure, "right")
    assert exact is not None and exact.plate_angle_deg == 130.0 == min(
        catalogue.plate_angles_deg, key=lambda angle: abs(angle - truth)
    )
    either = fitting(catalogue, 90.0, unsure, "right")
    assert either is not None and either.plate_angle_deg is None and "130° or 135°" in either.sentence


def test_a_plan_states_the_implant_in_its_document_and_its_sentences(tmp_path: Path):
    made = _plan(kind("hip-screw"))
    assert made.implant is not None
    assert made.document()["implant"]["length_mm"] == 5 * np.floor(made.trajectory.length_mm / 5)
    assert made.implant.sentence in made.sentences()
    free = _plan(kind("hip-screw"), side=None)
    assert free.implant is not None and free.implant.plate_angle_deg is None
