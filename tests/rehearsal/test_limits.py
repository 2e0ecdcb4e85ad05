"""One source of limits: each of a kind's, changed, is seen in plan, file, robot's target and message."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.planning.standin import stand_in
from tests.robot.test_target import POINTS, registered

from sightline.case.interop.plan_file import PlanFile, sealed
from sightline.checks import Limits
from sightline.planning import Plan, kind, plan
from sightline.rehearsal.operation import target_of
from sightline.robot.kinematics.target import PlanIdentity
from sightline.robot.link.client import plan_metadata


def _seen(made: Plan, folder: Path) -> dict[str, dict[str, float]]:
    """What each consumer takes the limits to be."""
    checks = {check.name: check for check in made.verdict.checks}
    document = {
        **made.verdict_document(),
        "trajectory": made.trajectory.document(),
        "checks": [{"name": check.name, "passed": check.passed} for check in made.verdict.checks],
    }
    (folder / "plan.json").write_text(json.dumps(sealed(document)))
    read = PlanFile.read(folder).limits
    identity = PlanIdentity("p", "right", "SN-7", made.verdict.go, made.kind.key)
    target = target_of(made, identity, registered())
    robots = {check.name: check.limit for check in target.checks}
    said = plan_metadata(target, 40.0, 999.0)
    return {
        "position_mm": {
            "entry": checks["entry error"].limit,
            "end": checks["end error"].limit,
            "file": read.position_mm,
            "robot's entry": robots["wire entry error"],
            "robot's end": robots["wire end error"],
            "message": float(said["position_limit_mm"]),
        },
        "direction_rad": {
            "plan": np.deg2rad(checks["direction error"].limit),
            "file": read.direction_rad,
            "robot": np.deg2rad(robots["wire direction error"]),
            "message": np.deg2rad(float(said["direction_limit_deg"])),
        },
        "beyond_mm": {
            "file": read.beyond_mm,
            "robot": target.depth_mm - target.length_mm,
            "message": float(said["beyond_mm"]),
            "length in the message": float(said["length_mm"]) - target.length_mm,
            "pose": float(np.linalg.norm(target.T_cfcs_wire.translation - made.trajectory.end_mm)),
        },
    }


@pytest.mark.parametrize(
    "limits", [Limits(), Limits(position_mm=0.7), Limits(direction_rad=0.05), Limits(beyond_mm=9.0)], ids=str
)
def test_each_limit_of_a_kind_is_that_of_every_consumer(limits: Limits, tmp_path: Path):
    views = [stand_in("pa", 0.4, 0.05), stand_in("lateral", -0.2, 0.05)]
    uv = np.array([view.project(POINTS) for view in views])
    made = plan(views, uv[:, 0], uv[:, 1], kind=replace(kind("free-wire"), limits=limits), side="right")
    for name, by_consumer in _seen(made, tmp_path).items():
        for consumer, value in by_consumer.items():
            assert value == pytest.approx(getattr(limits, name), abs=1e-6), (name, consumer)
