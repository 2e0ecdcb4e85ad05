"""`sightline plan` from observations: GO, NO-GO, and picks that cannot be used."""

import json
from pathlib import Path

import numpy as np
import pytest

from sightline.cli.planning.points import parse_point
from sightline.detection.csv_files import write_observations
from sightline.detection.results import Observations
from sightline.errors import UnusableInputError
from sightline.frame import Frame
from sightline.rehearsal.patient import draw_patient
from sightline.studies.scenes import measure
from sightline.twin.anatomy.aids import drawn_aids
from sightline.twin.anatomy.bone_model import SphereAid

LANDMARKS_MM = np.array([[-21.3, -17.9, 4.4], [12.2, 30.1, -16.8]])
WIRE_MM = np.array([[31.3, 28.9, -9.7], [-30.1, -27.7, 8.3]])


@pytest.fixture(scope="module")
def wire_px(setup) -> dict[str, np.ndarray]:
    return {view: setup.views[view].project(WIRE_MM) for view in ("pa", "lateral")}


def picks(wire_px, shift=0.0) -> list[str]:
    def point(k: int) -> str:
        (u, v), (s, t) = wire_px["pa"][k], wire_px["lateral"][k] + shift
        return f"pa:{u:.2f},{v:.2f} lateral:{s:.2f},{t:.2f}"

    return ["--entry", point(0), "--end", point(1), "--kind", "free-wire"]


def test_a_plan_lies_within_its_own_bounds_of_the_truth(run, beads_csv: Path, wire_px) -> None:
    ran = run("plan", beads_csv, beads_csv, *picks(wire_px), "--pick-sd", "0.1", "--json")
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


def test_people_read_points_bounds_and_verdict_and_get_a_report(run, beads_csv: Path, wire_px, tmp_path: Path) -> None:
    ran = run("plan", beads_csv, beads_csv, *picks(wire_px), "--out", tmp_path / "plan")
    assert ran.code == 0, ran.err
    for words in (
        "Trajectory in CFCS",
        "no robot",
        "95 % error",
        "GO: every check passed",
        "entry error",
        "report.html",
    ):
        assert words in ran.out
    assert sorted(file.name for file in (tmp_path / "plan").glob("[!.]*")) == ["plan.json", "report.html"]
    written = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert f"{written['trajectory']['error_95']['entry_mm']:.2f} mm" in (tmp_path / "plan" / "report.html").read_text()


def landmarks(setup, moved_mm: float = 0.0) -> list[str]:
    """Two points of the bone, which moves along Y before the lateral view is taken."""
    options = []
    for xyz in LANDMARKS_MM:
        (u, v), (s, t) = (
            setup.views["pa"].project(xyz),
            setup.views["lateral"].project(xyz + np.array([0.0, moved_mm, 0.0])),
        )
        options += ["--landmark", f"pa:{u:.2f},{v:.2f} lateral:{s:.2f},{t:.2f}"]
    return options


def failing(ran) -> set[str]:
    return {check["name"] for check in ran.document["checks"] if not check["passed"]}


def test_snapped_picks_have_no_gap_so_movement_is_untested_without_landmarks(run, beads_csv: Path, wire_px) -> None:
    ran = run("plan", beads_csv, beads_csv, *picks(wire_px, shift=4.0), "--snap", "--json")
    assert ran.code == 3
    assert ran.document["trajectory"]["gap_tested"] == [False, False]
    assert ran.document["trajectory"]["gap_sigma"] == [None, None]
    assert ran.document["landmarks"] == []
    assert failing(ran) == {"movement"}


def test_landmarks_show_whether_the_patient_moved(run, beads_csv: Path, wire_px, setup) -> None:
    snapped = ["plan", beads_csv, beads_csv, *picks(wire_px), "--snap", "--json"]
    still, moved = (run(*snapped, *landmarks(setup, by_mm)) for by_mm in (0.0, 3.0))
    assert still.code == 0, failing(still)
    found = np.array([mark["xyz_mm"] for mark in still.document["landmarks"]])
    assert np.linalg.norm(found - LANDMARKS_MM, axis=1).max() < 1.0  # the frame's errors
    assert moved.code == 3
    assert failing(moved) == {"gap", "movement", "pick spread"}
    for key in ("entry_mm", "end_mm", "covariance_mm2"):  # to the last digits of one adjustment that has them all
        path = [ran.document["trajectory"][key] for ran in (still, moved)]
        np.testing.assert_allclose(*path, rtol=0.0, atol=1e-9)


def test_a_landmark_is_no_place_on_a_curve(run, beads_csv: Path, wire_px) -> None:
    ran = run("plan", beads_csv, beads_csv, *picks(wire_px), "--landmark", "pa:512,512 depth:300")
    assert ran.code == 2
    assert "picked freely in both views" in ran.err.replace("\n", " ")


def test_a_depth_is_a_place_on_the_curve(run, beads_csv: Path, wire_px) -> None:
    """The same plan, whether its lateral places are clicked or stated in mm along the PA lines of sight."""
    (u0, v0), (u1, v1) = wire_px["pa"]
    ends = [f"pa:{u0:.2f},{v0:.2f} depth:300", f"pa:{u1:.2f},{v1:.2f} depth:310"]
    ran = run("plan", beads_csv, beads_csv, "--entry", ends[0], "--end", ends[1], "--kind", "free-wire", "--json")
    assert ran.code == 3, ran.out
    assert failing(ran) == {"movement"}  # a place on a curve has no gap
    path = ran.document["trajectory"]
    assert path["gap_tested"] == [False, False]
    # Depth runs from the plate at z = +300 towards the source, nearly along -Z: less than 10 % longer than in z.
    for z, depth in ((path["entry_mm"][2], 300.0), (path["end_mm"][2], 310.0)):
        assert 0.9 * depth < 300.0 - z <= depth + 0.5


def test_on_no_go_the_failures_come_first_and_no_error_stands_beside_the_points(run, beads_csv: Path, wire_px) -> None:
    said = run("plan", beads_csv, beads_csv, *picks(wire_px, shift=np.array([25.0, 25.0]))).out
    lines = said.splitlines()
    count = sum(line.startswith("FAIL ") for line in lines)
    assert lines[0].startswith(f"NO-GO: {count} checks failed")
    assert all(line.startswith("FAIL ") for line in lines[1 : count + 1])
    assert "the entry point pass" in lines[1] and "pick again" in lines[1]
    rows = {line.split()[0]: line.split()[1:] for line in lines if line.startswith(("  entry  ", "  end  "))}
    assert rows.keys() == {"entry", "end"}
    assert all(row[3] == "-" for row in rows.values())
    assert "No error is stated: the gap of a point contradicts it." in said


def test_points_are_called_what_the_kind_of_trajectory_calls_them(run, beads_csv: Path, wire_px) -> None:
    said = run("plan", beads_csv, beads_csv, *picks(wire_px)[:4], "--kind", "interlocking").out
    assert "entry (near hole)" in said and "end (far hole)" in said


def test_picks_of_different_points_are_a_no_go_with_the_gap_as_reason(run, beads_csv: Path, wire_px) -> None:
    ran = run("plan", beads_csv, beads_csv, *picks(wire_px, shift=np.array([25.0, 25.0])), "--json")
    assert ran.code == 3
    failed = [check for check in ran.document["checks"] if not check["passed"]]
    assert "gap" in [check["name"] for check in failed]
    gaps = [check["sentence"] for check in failed if check["name"] == "gap"]
    assert all(sentence.endswith("pick again.") for sentence in gaps)  # nothing of arrays, which a person has not
    assert ran.document["go"] is False


CENTRE_MM, RADIUS_MM = WIRE_MM[1] + 15.0 * (WIRE_MM[0] - WIRE_MM[1]) / np.linalg.norm(WIRE_MM[0] - WIRE_MM[1]), 23.0
LESSER_MM = WIRE_MM[0] + [-36.0, 4.0, -7.0]


def of_a_hip(setup) -> dict[str, str]:
    """What a hip screw asks for, without error: the outline of a head around the tip, and the lesser trochanter."""
    circles, pixels = [], []
    for name in ("pa", "lateral"):
        view = setup.views[name]
        ray = CENTRE_MM - view.focal_point_mm
        around = np.linalg.svd(ray[None])[2][1:]
        turns = np.linspace(0.0, 2 * np.pi, 60, endpoint=False)
        sine = RADIUS_MM / np.linalg.norm(ray)
        ring = np.stack([np.cos(turns), np.sin(turns)], axis=1) @ around
        rim = view.project(CENTRE_MM - sine**2 * ray + RADIUS_MM * np.sqrt(1 - sine**2) * ring)
        u, v = rim.mean(axis=0)
        circles.append(f"{name}:{u:.2f},{v:.2f},{np.linalg.norm(rim - [u, v], axis=1).mean():.2f}")
        pixels.append("{}:{:.2f},{:.2f}".format(name, *view.project(LESSER_MM)))
    return {"--side": "right", "--head": " ".join(circles), "--landmark": f"lesser trochanter {' '.join(pixels)}"}


def options(given: dict[str, str]) -> list[str]:
    return [word for pair in given.items() for word in pair]


def test_a_hip_screw_is_go_with_all_it_asks_for_and_incomplete_without(run, beads_csv: Path, wire_px, setup) -> None:
    given = of_a_hip(setup)
    plan = ["plan", beads_csv, beads_csv, *picks(wire_px)[:4], "--json"]
    whole = run(*plan, *options(given))
    assert whole.code == 0, failing(whole)
    assert (whole.document["go"], whole.document["verdict"], whole.document["missing"]) == (True, "go", [])
    assert (whole.document["kind"], whole.document["side"]) == ("hip-screw", "right")
    limits = {"position_mm": 1.0, "direction_deg": pytest.approx(0.6), "before_mm": 0.0, "beyond_mm": 0.0}
    assert whole.document["limits"] == limits
    assert [mark["name"] for mark in whole.document["landmarks"]] == ["lesser-trochanter"]
    for option, check, words in (
        ("--side", "side", "right or the left"),
        ("--head", "head", "The head is not drawn"),
        ("--landmark", "entry at cortex", "lesser trochanter"),
    ):
        ran = run(*plan, *options({key: value for key, value in given.items() if key != option}))
        assert ran.code == 3
        assert (ran.document["go"], ran.document["verdict"]) == (False, "incomplete")
        assert failing(ran) == {check}
        (missing,) = ran.document["missing"]
        assert words in missing
    said = run(*plan[:-1])
    assert said.code == 3
    assert "INCOMPLETE" in said.out and "GO:" not in said.out


def test_an_aid_is_drawn_by_its_clicks(run, beads_csv: Path, wire_px, setup) -> None:
    """The head by three clicks on its rim in each image, instead of a circle."""
    given = of_a_hip(setup)
    del given["--head"]
    head = drawn_aids({"head": SphereAid(CENTRE_MM, RADIUS_MM)}, setup.views)["head"]
    rims = [f"{view}:{','.join(f'{number:.2f}' for number in uv.ravel())}" for view, uv in head.items()]
    plan = ["plan", beads_csv, beads_csv, *picks(wire_px)[:4], *options(given), "--json"]
    ran = run(*plan, "--aid", f"head {' '.join(rims)}")
    assert ran.code == 0, failing(ran)
    one = run(*plan, "--aid", f"head {rims[0]}")
    assert (one.code, one.document["verdict"]) == (3, "incomplete")


@pytest.mark.parametrize("key", ["head", "shaft"])
def test_a_table_of_beads_has_no_edges_to_fit_to(run, beads_csv: Path, wire_px, setup, key: str) -> None:
    plan = ["plan", beads_csv, beads_csv, *picks(wire_px)[:4], f"--fit-{key}"]
    shaft = ["--aid", "shaft pa:600,700,700,800 lateral:600,600,700,700"]
    assert "table of beads" in run(*plan, *options(of_a_hip(setup)), *(shaft if key == "shaft" else ())).err
    assert "draw it with --aid" in run(*plan).err


def test_a_hip_screw_that_is_wrong_in_its_bone_is_no_go(run, beads_csv: Path, wire_px, setup) -> None:
    given = of_a_hip(setup)
    entry, end = picks(wire_px)[1:4:2]
    exchanged = run("plan", beads_csv, beads_csv, "--entry", end, "--end", entry, *options(given), "--json")
    assert (exchanged.code, exchanged.document["verdict"]) == (3, "no-go")
    assert "entry and end" in failing(exchanged)
    plan = ["plan", beads_csv, beads_csv, "--entry", entry, "--end", end, "--json"]
    left = run(*plan, *options(given | {"--side": "left"}))
    assert (left.code, failing(left)) == (3, {"side"})
    shrunk = [text.rsplit(",", 1) for text in given["--head"].split()]
    small = {"--head": " ".join(f"{at},{float(radius) * 0.62:.2f}" for at, radius in shrunk)}
    through = run(*plan, *options(given | small))
    assert (through.code, failing(through)) == (3, {"tip in head"})
    (check,) = (check for check in through.document["checks"] if check["name"] == "tip in head")
    assert check["figure"] == pytest.approx(23.0 * 0.62 - 15.0, abs=0.6)
    assert 0.1 < check["limit"] < 1.5
    assert "95 % error" in check["sentence"] and "joint" in check["sentence"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--head", "pa:1,2,3"], "two circles"),
        (["--head", "pa:1,2 lateral:3,4"], "two circles"),
        (["--head", "pa:500,500,-9 lateral:500,500,90"], "positive radius"),
        (["--landmark", "patella pa:500,500 lateral:500,500"], "lesser-trochanter"),
        (["--landmark", "lesser-trochanter pa:500,500"], "--landmark"),
        (["--aid", "pa:1,2 lateral:3,4"], "not a drawing"),
        (["--aid", "shaft pa:1,2,3 lateral:1,2,3,4"], "not a drawing"),
        (["--aid", "shaft pa:1,2 lateral:3,4"], "a line needs two finite pixels"),
        (["--aid", "skull pa:1,2 lateral:3,4"], "has no aid 'skull'; choose one of head, shaft"),
        (["--side", "middle"], "side"),
        (["--kind", "tunnel"], "unknown procedure 'tunnel'"),
    ],
)
def test_aids_that_cannot_be_read_are_refused(run, beads_csv: Path, wire_px, options: list[str], words: str) -> None:
    ran = run("plan", beads_csv, beads_csv, *picks(wire_px)[:4], *options)
    assert ran.code == 2
    assert words in " ".join(ran.err.split())


def test_half_the_beads_in_the_wrong_place_is_refused_or_a_no_go(run, observations, wire_px, tmp_path: Path) -> None:
    pa = observations["pa"]
    rolled = Observations("pa", pa.ids, np.roll(pa.uv_px, 1, axis=0), pa.covariance_px2)
    path = write_observations([rolled, observations["lateral"]], tmp_path / "rolled.csv")
    ran = run("plan", path, path, *picks(wire_px), "--json")
    assert ran.code == 3
    assert "error" in ran.document or ran.document["go"] is False


@pytest.mark.parametrize(
    "text",
    [
        "",
        "pa:1,2",
        "lateral:1,2",
        "pa:1,2 lateral:3",
        "pa:1,2 pa:3,4",
        "pa:1,x lateral:1,2",
        "pa=1,2",
        "pa:1,2 side:3,4",
    ],
)
def test_a_point_that_cannot_be_read_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UnusableInputError, match=r"--entry .* is not a point; write 'pa:U,V lateral:U,V'"):
        parse_point(text, "--entry")


@pytest.mark.parametrize(
    ("entry", "end", "words"),
    [
        ("pa:512,512 lateral:nan,512", "pa:400,400 lateral:400,400", "is not a point"),
        ("pa:512,512 depth:300", "pa:400,400 lateral:400,400", "both in one way"),
        ("pa:512,512 depth:9000", "pa:400,400 depth:300", "9000 mm is outside the lateral view"),
        ("pa:5,5 lateral:512,512", "pa:512,512 lateral:512,512", "hull"),
    ],
)
def test_picks_that_give_no_plan_are_said(run, beads_csv: Path, entry: str, end: str, words: str) -> None:
    ran = run("plan", beads_csv, beads_csv, "--entry", entry, "--end", end)
    assert ran.code in (2, 3)
    assert words in ran.err
    assert "Traceback" not in ran.err


def test_files_that_are_not_there_are_named(run, tmp_path: Path, wire_px) -> None:
    ran = run("plan", tmp_path / "none.dcm", tmp_path / "none.dcm", *picks(wire_px))
    assert ran.code == 2
    assert "none.dcm" in ran.err


def test_a_wire_is_proposed_from_what_is_drawn(run, tmp_path: Path) -> None:
    """No entry, no end: the rule of the procedure gives them, the checks judge them, and the case keeps its picks."""
    patient = draw_patient("slipped-epiphysis-pin", 3, Frame.load("gamma"), imaged=False)
    rng = np.random.default_rng(5)
    beads = write_observations(measure(rng, patient.setup, 0.1).values(), tmp_path / "beads.csv")

    def written(uv) -> str:
        each = zip(("pa", "lateral"), uv, strict=True)
        return " ".join(
            f"{name}:{','.join(f'{x:.2f}' for x in np.ravel(one))}" for name, one in each if one is not None
        )

    given = ["plan", beads, beads, "--procedure", "slipped-epiphysis-pin", "--propose", "--side", "right"]
    for key, uv in zip(patient.landmark_keys, patient.landmarks.values(), strict=True):
        given += ["--landmark", f"{key} {written(uv)}"]
    aids = [f"{key} {written(uv)}" for key, uv in patient.aids_px.items()]
    drawn = [word for aid in aids for word in ("--aid", aid)]
    made = run(*given, *drawn, "--case", tmp_path / "case", "--out", tmp_path / "out", "--json")
    assert made.code == 0, made.out
    wire = patient.wires_mm[0]
    end = np.array(made.document["trajectory"]["end_mm"])
    assert np.linalg.norm(np.cross(end - wire[1], wire[1] - wire[0])) / np.linalg.norm(wire[1] - wire[0]) < 1.0
    assert "perpendicular to the growth plate" in (tmp_path / "out" / "report.html").read_text()
    assert run("case", "replay", tmp_path / "case").code == 0
    without = [word for aid in aids if not aid.startswith("growth-plate") for word in ("--aid", aid)]
    refused = run(*given, *without)
    assert refused.code == 3
    assert "no wire can be proposed: the growth-plate is not drawn" in refused.err
    assert run("plan", beads, beads, "--side", "right").code == 2  # neither picked nor to be proposed
