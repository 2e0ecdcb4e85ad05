"""One source of limits: each in a procedure's file, changed, is seen wherever a plan goes."""

import json
from math import degrees, radians
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests.planning.standin import StandInView, stand_in
from tests.robot.test_target import POINTS, registered

import sightline.from_images.pipeline
from sightline.case.contents import CheckRequest
from sightline.case.interop.formats import igtl_files
from sightline.case.interop.plan_file import PlanFile, sealed
from sightline.planning import Plan, kind, plan
from sightline.planning.check.wires import Landmarks
from sightline.planning.procedures.procedure import copy_text
from sightline.rehearsal.operation import target_of
from sightline.robot import contract
from sightline.robot.control.insertion import DEPTH_SLACK_MM
from sightline.robot.kinematics.target import PlanIdentity
from sightline.robot.link.client import plan_metadata

MARKS = np.array([[20.0, -12.0, 9.0], [-4.0, 22.0, -11.0], [8.0, 9.0, 16.0]])


def _file(folder: Path, changed: dict[str, float]) -> Path:
    """A procedure like the free wire with other limits."""
    given = json.loads(copy_text("free-wire", "mine"))
    for name, value in changed.items():
        given["limits"].setdefault(name, {"source": "mine"})["limit"] = value
    (folder / "mine.json").write_text(json.dumps(given))
    return folder / "mine.json"


def _shot(made: Plan, views: list[StandInView], beyond_mm: float, patch: pytest.MonkeyPatch) -> dict[str, float]:
    """The limits of the check shot of a wire drilled as planned, and how far past the end point its tip belongs."""
    path = made.trajectory
    points = path.entry_mm + np.linspace(0.0, path.length_mm + beyond_mm, 40)[:, None] * path.direction

    def found(
        _plan: Plan, _image: object, _beads: object, view: StandInView, *_: object, **_known: object
    ) -> SimpleNamespace:
        uv = view.project(points)
        known = {"variance_px2": np.full(len(uv) - 2, 0.01), "tip_variance_px2": 0.04}
        return SimpleNamespace(uv_px=uv[:-2], tip_uv_px=uv[-1], **known)

    patch.setattr(sightline.from_images.pipeline, "find_planned_wire", found)
    images = tuple(SimpleNamespace(view=view, seen=SimpleNamespace(image=1, beads=1)) for view in views)
    marks = np.array([view.project(MARKS) for view in views])
    shot = CheckRequest(made.kind.wire_mm, Landmarks(marks, marks, 0.1)).shot(made, images, images)
    limits = {check.name: check.limit for check in shot.checks}
    return {**limits, "beyond": float(np.linalg.norm(shot.tip_mm - path.end_mm)), "along": float(shot.deviation_mm[4])}


def _seen(made: Plan, views: list[StandInView], folder: Path, patch: pytest.MonkeyPatch) -> dict[str, dict[str, float]]:
    """What each consumer takes the limits to be, as the file states them."""
    checks = {check.name: check for check in made.verdict.checks}
    document = {
        **made.document(),
        "trajectory": made.trajectory.document() | {"covariance_mm2": made.trajectory.covariance_mm2.tolist()},
        "checks": [{"name": check.name, "passed": True} for check in made.verdict.checks],
    } | {"go": True, "verdict": "go"}  # as if it were, to see what is sent
    (folder / "plan.json").write_text(json.dumps(sealed(document)))
    read = PlanFile.read(folder)
    assert read.document.procedure is not None and read.document.procedure.fingerprint == made.kind.fingerprint
    identity = PlanIdentity("p", "right", "SN-7", made.verdict.go, made.kind.key)
    target = target_of(made, identity, registered())
    robots = {check.name: check.limit for check in target.checks}
    said = plan_metadata(target, 40.0, 999.0)
    sent = json.loads(igtl_files(read, "case")["igtl.json"])["metadata"]
    shot = _shot(made, views, made.kind.limits.beyond_mm, patch)
    length = made.trajectory.length_mm
    return {
        "position_mm": {
            "entry": checks["entry error"].limit,
            "end": checks["end error"].limit,
            "file": read.limits.position_mm,
            "robot's entry": robots["wire entry error"],
            "robot's end": robots["wire end error"],
            "message": float(said["position_limit_mm"]),
            "exported message": float(sent["position_limit_mm"]),
            "check shot's entry": shot["wire entry"],
            "check shot's tip": shot["wire tip"],
            "report": document["limits"]["position_mm"],
        },
        "direction_deg": {
            "plan": checks["direction error"].limit,
            "file": degrees(read.limits.direction_rad),
            "robot": robots["wire direction error"],
            "message": float(said["direction_limit_deg"]),
            "exported message": float(sent["direction_limit_deg"]),
            "check shot": shot["wire direction"],
            "report": document["limits"]["direction_deg"],
        },
        "beyond_mm": {
            "file": read.limits.beyond_mm,
            "robot": target.depth_mm - target.length_mm,
            "message": float(said["beyond_mm"]),
            "length in the message": float(said["length_mm"]) - target.length_mm,
            "pose": float(np.linalg.norm(target.T_cfcs_wire.translation - made.trajectory.end_mm)),
            "depth limit": float(sent[contract.DEPTH_LIMIT_MM]) - length - DEPTH_SLACK_MM,
            "check shot's tip": shot["beyond"] - shot["along"],
            "report": document["limits"]["beyond_mm"],
        },
        "before_mm": {
            "file": read.limits.before_mm,
            "robot": target.limits.before_mm,
            "message": float(said["before_mm"]),
            "exported message": float(sent["before_mm"]),
            "report": document["limits"]["before_mm"],
        },
    }


@pytest.mark.parametrize(
    "changed",
    [{}, {"position_mm": 0.7}, {"direction_deg": 2.9}, {"beyond_mm": 9.0}, {"before_mm": 8.0}],
    ids=str,
)
def test_each_limit_in_a_file_is_that_of_every_consumer(
    changed: dict[str, float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    views = [stand_in("pa", 0.4, 0.05), stand_in("lateral", -0.2, 0.05)]
    uv = np.array([view.project(POINTS) for view in views])
    made = plan(views, uv[:, 0], uv[:, 1], procedure=kind(str(_file(tmp_path, changed))), side="right")
    wanted = {"position_mm": 1.0, "direction_deg": 0.6, "beyond_mm": 0.0, "before_mm": 0.0} | changed
    assert made.kind.limits.direction_rad == radians(wanted["direction_deg"])
    for name, by_consumer in _seen(made, views, tmp_path, monkeypatch).items():
        for consumer, value in by_consumer.items():
            assert value == pytest.approx(wanted[name], abs=2e-3), (name, consumer)
