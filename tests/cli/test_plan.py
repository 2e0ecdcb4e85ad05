"""`sightline plan` from observations: GO, NO-GO, files of picks, and picks that cannot be used."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.picked import LANDMARKS_MM, VIEWS, WIRE_MM, picks_file, place, typed, wire

from sightline.detection.csv_files import write_observations
from sightline.detection.results import Observations
from sightline.frame import Frame
from sightline.rehearsal.patient import draw_patient
from sightline.studies.scenes import measure
from sightline.twin.anatomy.bone_model import SphereAid, drawn_aids

FREE = ("--procedure", "free-wire")


@pytest.fixture(scope="module")
def wire_px(setup) -> dict[str, np.ndarray]:
    return {view: setup.views[view].project(WIRE_MM) for view in VIEWS}


def test_a_plan_lies_within_its_own_bounds_of_the_truth(run, beads_csv: Path, setup, tmp_path: Path) -> None:
    picks = picks_file(tmp_path, pick_sd_px=0.1)
    ran = run("plan", beads_csv, beads_csv, *typed(setup), *FREE, "--picks", picks, "--json")
    assert ran.code == 0, ran.out
    document = ran.document
    assert document["go"] is True
    path = document["trajectory"]
    assert path["coordinates"] == "CFCS"
    # A frame error of three standard deviations is rarer than one in three hundred; the seed is fixed.
    error = np.linalg.norm(np.array([path["entry_mm"], path["end_mm"]]) - WIRE_MM, axis=1)
    assert error[0] < 1.5 * path["error_95"]["entry_mm"]
    assert error[1] < 1.5 * path["error_95"]["end_mm"]
    assert [view["view"] for view in document["views"]] == ["pa", "lateral"]
    assert all(check["passed"] for check in document["checks"])


def test_people_read_the_plan_and_its_folder_holds_what_was_picked(run, beads_csv, setup, tmp_path: Path) -> None:
    plan = ["plan", beads_csv, beads_csv, *FREE]
    ran = run(*plan, *typed(setup), "--out", tmp_path / "plan")
    assert ran.code == 0, ran.err
    for words in ("Trajectory in CFCS", "no robot", "95 % error", "GO: every check passed", "report.html"):
        assert words in ran.out
    assert {file.name for file in (tmp_path / "plan").glob("[!.]*")} == {"picks.json", "plan.json", "report.html"}
    written = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert f"{written['trajectory']['error_95']['entry_mm']:.2f} mm" in (tmp_path / "plan" / "report.html").read_text()
    again = run(*plan, "--picks", tmp_path / "plan" / "picks.json", "--json")
    assert again.document["trajectory"] == written["trajectory"]
    both = run(*plan, "--picks", tmp_path / "plan" / "picks.json", *typed(setup))
    assert both.code == 2 and "leave --entry and --end out" in both.err


def test_snapped_picks_have_no_gap_so_landmarks_show_whether_the_patient_moved(
    run, beads_csv: Path, setup, tmp_path: Path
) -> None:
    snapped = {"wires": {"wire": wire(setup, WIRE_MM, "entry", "end")}}

    def planned(landmarks_mm: Any, moved_mm: float = 0.0) -> Any:
        later = [place(setup, xyz + np.array([0.0, moved_mm, 0.0])) for xyz in landmarks_mm]
        marks = [two | {"pa": place(setup, xyz)["pa"]} for two, xyz in zip(later, landmarks_mm, strict=True)]
        picks = picks_file(tmp_path, **snapped, landmarks=marks)
        return run("plan", beads_csv, beads_csv, *FREE, "--picks", picks, "--json")

    without, still, moved = planned([]), planned(LANDMARKS_MM), planned(LANDMARKS_MM, 3.0)
    assert without.document["trajectory"]["gap_tested"] == [False, False]
    assert (without.code, without.failing) == (3, {"movement"})
    assert still.code == 0, still.failing
    found = np.array([mark["xyz_mm"] for mark in still.document["landmarks"]])
    assert np.linalg.norm(found - LANDMARKS_MM, axis=1).max() < 1.0  # the frame's errors
    assert (moved.code, moved.failing) == (3, {"gap", "movement", "pick spread"})
    for key in ("entry_mm", "end_mm", "covariance_mm2"):  # to the last digits of one adjustment that has them all
        path = [ran.document["trajectory"][key] for ran in (still, moved)]
        np.testing.assert_allclose(*path, rtol=0.0, atol=1e-9)


def test_a_depth_is_a_place_on_the_curve(run, beads_csv: Path, wire_px) -> None:
    """The same plan, whether its lateral places are clicked or stated in mm along the PA lines of sight."""
    (u0, v0), (u1, v1) = wire_px["pa"]
    ends = [f"pa:{u0:.2f},{v0:.2f} depth:300", f"pa:{u1:.2f},{v1:.2f} depth:310"]
    ran = run("plan", beads_csv, beads_csv, "--entry", ends[0], "--end", ends[1], *FREE, "--json")
    assert (ran.code, ran.failing) == (3, {"movement"}), ran.out  # a place on a curve has no gap
    path = ran.document["trajectory"]
    assert path["gap_tested"] == [False, False]
    # Depth runs from the plate at z = +300 towards the source, nearly along -Z: less than 10 % longer than in z.
    for z, depth in ((path["entry_mm"][2], 300.0), (path["end_mm"][2], 310.0)):
        assert 0.9 * depth < 300.0 - z <= depth + 0.5


def test_on_no_go_the_failures_come_first_and_no_error_stands_beside_the_points(run, beads_csv: Path, setup) -> None:
    of_other_points = typed(setup, shift_px=25.0)
    said = run("plan", beads_csv, beads_csv, *of_other_points, "--procedure", "interlocking").out
    assert "entry (near hole)" in said and "end (far hole)" in said  # as the procedure calls them
    ran = run("plan", beads_csv, beads_csv, *of_other_points, *FREE)
    assert ran.code == 3
    frame, procedure, *lines = ran.out.splitlines()
    assert (frame, procedure) == ("frame: gamma (assumed; --frame names another)", "procedure: free-wire")
    count = sum(line.startswith("FAIL ") for line in lines)
    assert lines[0].startswith(f"NO-GO: {count} checks failed")
    assert all(line.startswith("FAIL ") for line in lines[1 : count + 1])
    assert "the entry point pass" in lines[1] and "pick again" in lines[1]
    rows = {line.split()[0]: line.split()[1:] for line in lines if line.startswith(("  entry  ", "  end  "))}
    assert rows.keys() == {"entry", "end"}
    assert all(row[3] == "-" for row in rows.values())
    assert "No error is stated: the gap of a point contradicts it." in ran.out


def test_an_assumed_procedure_is_said_and_the_others_are_listed_where_it_asks_for_more(run, beads_csv, setup) -> None:
    said = run("plan", beads_csv, beads_csv, *typed(setup)).out
    assert "procedure: hip-screw (assumed; --procedure names another)\nINCOMPLETE: " in said
    assert "add --procedure KEY: cannulated-hip-screws (cannulated hip screws); " in said and "pedicle-screw" in said
    named = run("plan", beads_csv, beads_csv, *typed(setup), "--procedure", "hip-screw", "--frame", "gamma").out
    assert named.startswith("frame: gamma\nprocedure: hip-screw\nINCOMPLETE: ") and "add --procedure" not in named


# The tip lies 8 mm under the head's surface.
CENTRE_MM, RADIUS_MM = WIRE_MM[1] + 15.0 * (WIRE_MM[0] - WIRE_MM[1]) / np.linalg.norm(WIRE_MM[0] - WIRE_MM[1]), 23.0
LESSER_MM = WIRE_MM[0] + [-36.0, 4.0, -7.0]


@pytest.fixture(scope="module")
def of_a_hip(setup) -> dict[str, Any]:
    """What a hip screw asks for, without error: outline of a head around the tip, neck, shaft, cortex, trochanter."""
    circles = {}
    for name in VIEWS:
        view = setup.views[name]
        ray = CENTRE_MM - view.focal_point_mm
        around = np.linalg.svd(ray[None])[2][1:]
        turns = np.linspace(0.0, 2 * np.pi, 60, endpoint=False)
        sine = RADIUS_MM / np.linalg.norm(ray)
        ring = np.stack([np.cos(turns), np.sin(turns)], axis=1) @ around
        rim = view.project(CENTRE_MM - sine**2 * ray + RADIUS_MM * np.sqrt(1 - sine**2) * ring)
        u, v = rim.mean(axis=0)
        circles[name] = [u, v, np.linalg.norm(rim - [u, v], axis=1).mean()]
    shaft_mm = WIRE_MM[0] + [[-15.0, -10.0, 0.0], [-15.0, 10.0, 0.0]]
    lines = {"neck": np.stack([WIRE_MM[0], CENTRE_MM]), "shaft": shaft_mm}
    aids = {key: {v: setup.views[v].project(mm).tolist() for v in VIEWS} for key, mm in lines.items()}
    aids["cortex"] = {"pa": setup.views["pa"].project(WIRE_MM[:1]).tolist()}
    landmarks = [{"name": "lesser-trochanter", **place(setup, LESSER_MM)}]
    return {"head": circles, "landmarks": landmarks, "aids": aids}


@pytest.fixture
def hip(run, beads_csv: Path, setup, of_a_hip, tmp_path: Path) -> Any:
    """`hip(head=None)`: the plan of a hip screw without its head."""

    def planned(*more: str, side: str | None = "right", ends: list[str] | None = None, **change: Any) -> Any:
        given = {key: value for key, value in (of_a_hip | change).items() if value is not None}
        sides = ["--side", side] if side else []
        picks = ["--picks", picks_file(tmp_path, **given)]
        return run("plan", beads_csv, beads_csv, *(ends or typed(setup)), *sides, *picks, *(more or ["--json"]))

    return planned


def test_a_hip_screw_is_go_with_all_it_asks_for_and_incomplete_without(hip, of_a_hip) -> None:
    def without(key: str) -> dict[str, Any]:
        return {other: clicks for other, clicks in of_a_hip["aids"].items() if other != key}

    whole = hip()
    assert whole.code == 0, whole.failing
    assert (whole.document["go"], whole.document["verdict"], whole.document["missing"]) == (True, "go", [])
    assert (whole.document["kind"], whole.document["side"]) == ("hip-screw", "right")
    limits = {"position_mm": 1.0, "direction_deg": pytest.approx(0.6), "before_mm": 0.0, "beyond_mm": 0.0}
    assert whole.document["limits"] == limits
    assert [mark["name"] for mark in whole.document["landmarks"]] == ["lesser-trochanter"]
    for ran, check, words in (
        (hip(side=None), "side", "right or the left"),
        (hip(head=None), "head", "The head is not drawn"),
        (hip(aids=without("shaft")), "wire to shaft", "the shaft axis is not drawn"),
        (hip(aids=without("cortex")), "entry at cortex", "the lateral cortex is not clicked"),
        (hip(aids=without("neck")), "tip-apex distance", "the neck axis is not drawn"),
    ):
        assert (ran.code, ran.document["go"], ran.document["verdict"]) == (3, False, "incomplete")
        assert check in ran.failing
        assert any(words in missing for missing in ran.document["missing"])
    told = hip("--quiet", landmarks=[{**of_a_hip["landmarks"][0], "name": ""}])
    assert told.code == 0
    said = hip("--quiet", head=None, landmarks=None)
    assert (said.code, said.out) == (3, "")


def test_an_aid_is_drawn_by_its_clicks(hip, setup, of_a_hip) -> None:
    """The head by three clicks on its rim in each image, instead of a circle."""
    head = drawn_aids({"head": SphereAid(CENTRE_MM, RADIUS_MM)}, setup.views)["head"]
    rims = {view: uv.tolist() for view, uv in head.items()}
    ran = hip(head=None, aids={**of_a_hip["aids"], "head": rims})
    assert ran.code == 0, ran.failing
    in_one = hip(head=None, aids={**of_a_hip["aids"], "head": {"pa": rims["pa"]}})
    assert (in_one.code, in_one.document["verdict"]) == (3, "incomplete")


def test_half_the_beads_in_the_wrong_place_is_refused_or_a_no_go(run, observations, setup, tmp_path: Path) -> None:
    pa = observations["pa"]
    rolled = Observations("pa", pa.ids, np.roll(pa.uv_px, 1, axis=0), pa.covariance_px2)
    path = write_observations([rolled, observations["lateral"]], tmp_path / "rolled.csv")
    ran = run("plan", path, path, *typed(setup), *FREE, "--json")
    assert ran.code == 3
    assert "error" in ran.document or ran.document["go"] is False


def test_a_wire_is_proposed_from_what_is_drawn(run, tmp_path: Path) -> None:
    """No entry, no end: the rule of the procedure gives them, the checks judge them, and the case keeps its picks."""
    patient = draw_patient("slipped-epiphysis-pin", 3, Frame.load("gamma"), imaged=False)
    rng = np.random.default_rng(5)
    beads = write_observations(measure(rng, patient.setup, 0.1).values(), tmp_path / "beads.csv")

    def both(uv: Any) -> dict[str, Any]:
        return {view: np.asarray(each).tolist() for view, each in zip(VIEWS, uv, strict=True) if each is not None}

    marks = zip(patient.landmark_keys, patient.landmarks.values(), strict=True)
    landmarks = [{"name": key, **both(uv)} for key, uv in marks]
    aids = {key: both(uv) for key, uv in patient.aids_px.items()}
    given = ["plan", beads, beads, "--procedure", "slipped-epiphysis-pin", "--side", "right", "--json"]
    kept = ["--case", tmp_path / "case", "--out", tmp_path / "out"]
    made = run(*given, *kept, "--propose", "--picks", picks_file(tmp_path, landmarks=landmarks, aids=aids))
    assert made.code == 0, made.out
    wire_mm = patient.wires_mm[0]
    end = np.array(made.document["trajectory"]["end_mm"])
    along = (wire_mm[1] - wire_mm[0]) / np.linalg.norm(wire_mm[1] - wire_mm[0])
    assert np.linalg.norm(np.cross(end - wire_mm[1], along)) < 1.0
    assert "perpendicular to the growth plate" in (tmp_path / "out" / "report.html").read_text()
    assert run("case", "replay", tmp_path / "case").code == 0
    again = run(*given, "--picks", tmp_path / "out" / "picks.json")  # the proposal is in it
    assert again.document["trajectory"] == made.document["trajectory"]
    twice = run(*given, "--propose", "--picks", tmp_path / "out" / "picks.json")
    assert twice.code == 2 and "leave --propose out" in twice.document["error"]["message"]
    del aids["growth-plate"]
    refused = run(*given, "--propose", "--picks", picks_file(tmp_path, landmarks=landmarks, aids=aids))
    assert refused.code == 3
    assert "no wire can be proposed: the growth-plate is not drawn" in refused.document["error"]["message"]
