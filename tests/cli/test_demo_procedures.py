"""`sightline demo --procedure KEY`: every procedure, the whole way from drawing images to the check shot."""

import json

import numpy as np
import pytest

from sightline.app.plan.decisions import Decisions
from sightline.app.plan.planner import nail_drawn
from sightline.app.session.rehearsing import Patient
from sightline.case.journal import Case, Kind
from sightline.case.replay import ReplayOutcome, replay
from sightline.cli.demo import PLACED, WITH_ROBOT, frame_for
from sightline.planning.procedures.procedure import document_of
from sightline.rehearsal.patient import AT_HIP, BONE_OF, CANNULATED, NAILED, frame_of

# Words of a hip that no report of another bone may say. "The hip" of the frame's coordinates and of the robot may.
HIP_WORDS = ("femoral head", "lesser trochanter", "neck", "right hip", "hip screw")


REPLAYED = "pedicle-screw"  # the cases of a hip, of several wires and of a nail are in other files of this folder


@pytest.mark.slow
@pytest.mark.parametrize("procedure", ["slipped-epiphysis-pin", "pedicle-screw", NAILED])
def test_a_right_plan_is_go_near_the_truth_and_checked(run, tmp_path, procedure: str) -> None:
    ran = run("demo", "--procedure", procedure, "--out", tmp_path / "demo", "--json")
    assert ran.code == 0, ran.err
    told = ran.document
    assert (told["verdict"], told["kind"].partition(":")[0], told["missing"]) == ("go", procedure, [])
    of_plan = told["comparison"][0]  # with the picks of a person; the seed is fixed
    for name in ("entry_mm", "end_mm", "direction_deg"):
        assert of_plan["error"][name] < 1.5 * of_plan["stated_95"][name]
    assert told["drilled"]["passed"] is True
    page = (tmp_path / "demo" / "report.html").read_text()
    assert (PLACED in page.replace("&#39;", "'")) is (procedure in BONE_OF)
    for view in document_of(procedure).views[:2]:
        assert f"{'PA' if view.name == 'pa' else view.name} image" in page
    if procedure == "pedicle-screw":
        assert not [word for word in HIP_WORDS if word in page]
        nameless = run("calibrate", tmp_path / "demo/demo_pa.dcm", "--frame", "block60", "--json")
        assert nameless.code != 0 and "say which view the image is, --view" in nameless.out
        assert "as many as a block has" in run("calibrate", tmp_path / "demo/demo_pa.dcm").said
    with Case.open(tmp_path / "demo" / "case", read_only=True) as case:
        assert case.latest(Kind.VERIFIED) is not None
        made = list(replay(case)) if procedure == REPLAYED else []
        plans = [entry.content["asked"].get("nail") for entry in case.entries(Kind.PLANNED)]
        edit = case.latest(Kind.CHANGED, where={"what": "edit"})
    assert {one.outcome for one in made} <= {ReplayOutcome.SAME, ReplayOutcome.RECORDED}
    if procedure == NAILED:
        assert told["all_wires"]["verdict"] == "go"
        assert [(key, one["passed"]) for key, one in told["all_drilled"].items()] == [
            ("distal", True),
            ("proximal", True),
        ]
        tips = np.array([one["tip_mm"] for one in told["all_drilled"].values()])
        assert np.linalg.norm(tips[-1] - tips[-2]) > 10.0  # not one wire measured twice
        assert {one["name"]: one["passed"] for one in told["relations_measured"]} == {"spacing": True, "parallel": True}
        assert [one["drilled"] for one in plans] == [[], [], ["distal"]]  # the second hole again, beside the first one
        shown = None if edit is None else nail_drawn(Decisions.of(edit.content["to"]))  # in the app
        assert shown is not None and shown.strokes_px.tolist() == plans[0]["strokes_px"]
        drilling = json.loads((tmp_path / "demo" / "drilling.json").read_text())
        off = drilling["physics"][0]  # against the plan
        assert max(off["entry_mm"], off["tip_mm"]) < 0.5  # a drill of 4 mm in a hole of 5 mm
        events = [event["name"] for event in drilling["record"]["events"]]
        assert events[:5] == ["contact", "cortex", "break-through", "cortex", "break-through"]
        assert events[5:] in ([], ["planned depth"])  # where the far cortex ends less than 3 mm before it
        assert drilling["record"]["events"][0]["depth_mm"] < -5.0  # before the nail


@pytest.mark.slow
def test_the_demo_on_an_intensifier_plans_with_a_block_and_does_not_drill(run, tmp_path) -> None:
    """Of one patient with exact picks both ends are within 0.2 mm, where a Γ has 0.3 mm rms. The case knows the arm, so
    that the app starts the same one."""
    given = ("--frame", "block40+detector-plate", "--arm", "six-axis")
    told = run("demo", *given, "--out", tmp_path / "demo", "--json").document
    assert told["go"] is True and told["drilled"] is None
    exact = next(one for one in told["comparison"] if "exactly" in one["picks"])
    assert max(exact["error"]["entry_mm"], exact["error"]["end_mm"]) < 0.2
    assert "--arm six-axis" in (tmp_path / "demo/report.html").read_text()
    with Case.open(tmp_path / "demo/case", read_only=True) as case:
        patient = case.latest(Kind.CHANGED, where={"what": "rehearsal"})
    assert patient is not None and Patient.of(patient.content["to"]).arm == "six-axis"
    again = run("case", "replay", tmp_path / "demo/case", "--json")
    assert again.code == 0, again.err


def test_the_frame_is_gamma_unless_the_views_need_a_block() -> None:
    assert {procedure: frame_for(procedure, None) for procedure in (*AT_HIP, *BONE_OF)} == {
        "hip-screw": "gamma",
        "cannulated-hip-screws": "block60",
        "free-wire": "gamma",
        "slipped-epiphysis-pin": "gamma",
        "iliosacral-screw": "block60",
        "pedicle-screw": "block60",
    }
    assert frame_for(NAILED, None) == "block60" and frame_for(NAILED, "block30") == "block30"
    assert frame_for("pedicle-screw", "gamma") == "gamma"
    assert WITH_ROBOT.keys() == {*AT_HIP, NAILED}  # a table of its own, read before what it must agree with is imported
    assert {key: frame_of(key) for key in WITH_ROBOT} == {**WITH_ROBOT, CANNULATED: "gamma"}
