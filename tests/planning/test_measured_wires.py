"""Relations between measured wires: the wires as they lie, their errors, and the limits of the file."""

import json

import numpy as np
import pytest

from sightline.errors import UnusableInputError
from sightline.planning import WirePicks, WirePlans, plan_wires
from sightline.planning.check.result import CheckShot
from sightline.planning.procedures.procedure import copy_text, document_from_json
from sightline.planning.wires import judge_measured, measured_lines

from .bone import END_MM, ENTRY_MM, curve_once, views
from .shots import straight_shot

KEYS = ("inferior", "anterior", "posterior")
WIRES_MM = np.array([ENTRY_MM, END_MM]) + np.array([[0.0, 0.0, 0.0], [7.0, -7.0, 8.0], [6.0, -6.0, -8.0]])[:, None]
SD_MM = 0.1


def planned(high_deg: float = 1.0) -> WirePlans:
    """Three parallel wires; `high_deg`: the file's limit of their angles."""
    given = json.loads(copy_text("cannulated-hip-screws", "mine"))
    given["relations"] = [one for one in given["relations"] if one["relation"] == "parallel"]
    given["relations"][0]["high"], given["checks"] = high_deg, []
    uv = np.array([[view.project(wire) for view in views()] for wire in WIRES_MM])
    picks = {key: WirePicks(one[:, 0], one[:, 1]) for key, one in zip(KEYS, uv, strict=True)}
    return plan_wires(views(), picks, procedure=document_from_json(json.dumps(given)), curve=lambda *_: curve_once())


def shot(key: str, tip_off_mm: float = 0.0, sd_mm: float = SD_MM) -> CheckShot:
    """A check shot of a wire whose tip lies beside its plan."""
    wire = WIRES_MM[KEYS.index(key)]
    along = (wire[1] - wire[0]) / np.linalg.norm(wire[1] - wire[0])
    across = np.linalg.svd(along[None])[2][1:]
    return straight_shot(wire, across, (0.0, 0.0, tip_off_mm, 0.0, 0.0), sd_mm)


def test_wires_that_lie_as_planned_are_parallel_and_one_that_does_not_is_named():
    plans = planned()
    good = judge_measured(plans, {key: shot(key) for key in KEYS}, "right")
    assert good.go and good.checks[0].name == "parallel"
    assert good.checks[0].figure > plans.relations[0].figure  # the errors of the check shots are in it
    off = {"inferior": shot("inferior"), "anterior": shot("anterior", 2.0), "posterior": shot("posterior")}
    bad = judge_measured(plans, off, "right").checks[0]
    assert not bad.passed and "anterior wire" in bad.sentence
    assert bad.figure > np.rad2deg(2.0 / np.linalg.norm(END_MM - ENTRY_MM))


def test_the_limit_is_that_of_the_file():
    shots = {key: shot(key, 0.7 * (key == "anterior")) for key in KEYS}
    verdicts = [judge_measured(planned(high), shots, "right") for high in (0.3, 3.0)]
    assert [one.go for one in verdicts] == [False, True]
    assert [one.checks[0].limit for one in verdicts] == [0.3, 3.0]


def test_a_wire_that_is_not_measured_is_missing():
    two = judge_measured(planned(), {key: shot(key) for key in KEYS[:2]}, "right")
    assert two.state == "incomplete" and "the posterior wire is not measured yet" in two.checks[0].sentence
    with pytest.raises(UnusableInputError, match="medial is not planned"):
        measured_lines(planned(), {"medial": shot("inferior")})


def test_the_errors_of_plan_and_check_shot_add():
    plans = planned()
    lines = measured_lines(plans, {"posterior": shot("posterior"), "inferior": shot("inferior", sd_mm=0.3)})
    assert lines.keys == ("inferior", "posterior")
    assert lines.joint_covariance_mm2 is not None and plans.lines.joint_covariance_mm2 is not None
    added = (
        lines.joint_covariance_mm2
        - plans.lines.joint_covariance_mm2[np.ix_([*range(6), *range(12, 18)], [*range(6), *range(12, 18)])]
    )
    along = (END_MM - ENTRY_MM) / np.linalg.norm(END_MM - ENTRY_MM)
    for k, sd in ((0, 0.3), (1, SD_MM)):
        own = added[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        np.testing.assert_allclose(own[:3, :3], sd**2 * (np.eye(3) - np.outer(along, along)), atol=1e-9)
        np.testing.assert_allclose(own[3:, 3:], sd**2 * np.eye(3), atol=1e-9)
    np.testing.assert_allclose(added[:6, 6:], 0.0, atol=1e-12)
