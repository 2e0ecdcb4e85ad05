"""Files of version 0.1.0 are read: a saved plan, plan.json, and a case, which replays."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import sightline as sl
from sightline.case.interop.plan_file import PlanFile
from sightline.case.journal import Case
from sightline.case.replay import judge, replay
from sightline.errors import RobotRefusedError

OLD = Path(__file__).parents[1] / "golden" / "version_0_1_0"
ENTRY_MM = (34.63, 31.26, -9.20)  # as version 0.1.0 printed it


def test_a_saved_plan_of_version_0_1_0_is_read() -> None:
    plan = sl.load(OLD / "saved_plan.json", sl.Plan)
    np.testing.assert_allclose(plan.trajectory.entry_mm, ENTRY_MM, atol=0.006)
    assert plan.verdict.state == "incomplete"
    assert {check.name for check in plan.verdict.unmade} >= {"head", "entry at cortex", "tip-apex distance"}


def test_a_plan_json_of_version_0_1_0_is_read() -> None:
    plan = PlanFile.read(OLD / "plan.json")
    assert plan.document.checks[0].code is None
    assert {"gap", "head", "entry at cortex"} <= set(plan.failed)
    with pytest.raises(RobotRefusedError, match="NO-GO"):
        plan.refuse_for_robot()


def test_a_case_of_version_0_1_0_replays(tmp_path: Path) -> None:
    shutil.copytree(OLD / "case", tmp_path / "case")
    with Case.open(tmp_path / "case") as case:
        outcomes = list(replay(case))
    assert judge(outcomes).passed, judge(outcomes).sentence
    assert {one.entry.kind for one in outcomes} >= {"labelled", "calibrated", "planned"}
