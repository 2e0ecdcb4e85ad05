"""A block beside the hip on a flat panel, from the command line."""

import json
from pathlib import Path

import numpy as np
import pytest


@pytest.mark.slow
def test_the_demo_with_a_block_is_ten_times_as_accurate_as_the_paper(run, tmp_path: Path) -> None:
    """One patient: with exact picks both ends within 0.1 mm; each end within 1.5 times its stated 95 % error. The wire
    is drilled near the plan; images of the robot's wire would tell it better where it stands."""
    ran = run("demo", "--frame", "block60", "--out", tmp_path / "demo", "--json")
    assert ran.code == 0, ran.err
    told = json.loads(ran.out)
    assert told["go"] is True
    truth = json.loads((tmp_path / "demo/truth.json").read_text())
    trajectory = told["trajectory"]
    for name in ("entry", "end"):
        off = np.linalg.norm(np.subtract(trajectory[f"{name}_mm"], truth[f"{name}_mm"]))
        assert off < 1.5 * trajectory["error_95"][f"{name}_mm"] < 0.6
    exact = next(one for one in told["comparison"] if "exactly" in one["picks"])
    assert max(exact["error"]["entry_mm"], exact["error"]["end_mm"]) < 0.1
    drilled = json.loads((tmp_path / "demo/drilling.json").read_text())
    assert drilled["check_shot"]["passed"] is True
    against_plan, _, against_picks = drilled["physics"]
    for point in ("entry_mm", "tip_mm"):
        assert against_plan[point] < 1.5 * drilled["error_95"][point] < 1.5
        assert drilled["by_images"]["error_95"][point] < 0.9 * drilled["error_95"][point]
        check = drilled["check_shot"]
        assert abs(against_picks[point] - check["deviation"][point]) < 1.5 * check["error_95"][point]
    shots, record = drilled["shots"], drilled["record"]
    assert {state: one["decision"] for state, one in shots.items()} == {"ALIGNED": "GO", "PAUSED": "GO"}
    assert -20.5 < shots["ALIGNED"]["depth_mm"] < -19.5
    # The shot's depth was sent: what the robot knows of its depth is then mainly that of the shot.
    assert max(record["depth_sd_mm"]) > 0.3 and record["depth_sd_mm"][-1] < shots["PAUSED"]["depth_sd_mm"] < 0.15
    paused = shots["PAUSED"]["deviation"]
    assert abs(against_plan["entry_mm"] - paused["entry_mm"]) < 0.3
    report = (tmp_path / "demo/report.html").read_text()
    assert all(words in report for words in ("registered by images", "The shot at PAUSED says GO", "second shot, PA"))
    again = run("case", "replay", tmp_path / "demo/case", "--json")
    assert again.code == 0, again.err
    plan = run("calibrate", tmp_path / "demo/demo_pa.dcm", "--frame", "block60", "--json")
    assert plan.code != 0 and "name the view" in plan.out


@pytest.mark.slow
def test_the_demo_on_an_intensifier_plans_with_a_block_and_does_not_drill(run, tmp_path: Path) -> None:
    """Of one patient with exact picks both ends are within 0.2 mm, where a Γ has 0.3 mm rms."""
    frame = "block40+detector-plate"
    ran = run("demo", "--frame", frame, "--out", tmp_path / "demo", "--json")
    assert ran.code == 0, ran.err
    told = json.loads(ran.out)
    assert told["go"] is True and told["drilled"] is None
    exact = next(one for one in told["comparison"] if "exactly" in one["picks"])
    assert max(exact["error"]["entry_mm"], exact["error"]["end_mm"]) < 0.2
    again = run("case", "replay", tmp_path / "demo/case", "--json")
    assert again.code == 0, again.err
