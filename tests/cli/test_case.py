"""`sightline case`: a case from the twin's images, checked, shown, computed again; and cases that are not whole."""

import json
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.cli.picked import LANDMARKS_MM, WIRE_MM

from sightline.case import stages
from sightline.case.canonical import canonical, digest
from sightline.case.contents import PlanRequest
from sightline.case.journal import Actor, Case, Kind
from sightline.case.replay import Recomputed, judge, replay
from sightline.case.views import NAMES, calibrate_pair, see_pair
from sightline.cli.case import _document
from sightline.common.estimator import ESTIMATOR
from sightline.errors import CaseError
from sightline.imaging import write_dicom
from sightline.twin import draw_setup, hip_scene, render


@pytest.fixture(scope="module")
def recorded(pair, beads_csv, frame, setup, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A case with every computed kind of entry, from images named after a patient and from a table, and a record."""
    folder = tmp_path_factory.mktemp("recorded")
    files = [Path(shutil.copy(pair[name], folder / f"MILLER_ANNA_{name}.dcm")) for name in NAMES]
    images = calibrate_pair(see_pair(*files, frame), frame, "smooth")
    table = calibrate_pair(see_pair(beads_csv, beads_csv, frame), frame, "localized")
    wire, marks = (np.stack([setup.views[n].project(xyz) for n in NAMES]) for xyz in (WIRE_MM, LANDMARKS_MM))
    asked = PlanRequest(wire[:, 0], wire[:, 1], 0.5, True, marks)
    with Case.create(folder / "case") as case:
        ref = stages.keep_frame(case, frame)
        first, second = (
            stages.record_view(case, file, image, frame_ref=ref, by=Actor.RECEIVER)
            for file, image in zip(files, images, strict=True)
        )
        plan = asked.plan(images)
        stages.record_planned(case, (first, second), asked, plan, by=Actor.SURGEON)
        for image in table:
            stages.record_view(case, beads_csv, image, frame_ref=ref, by=Actor.COMMAND)
        stages.record_planned(case, (first, second), asked, plan, by=Actor.APP)
        case.record(Kind.CHANGED, {"what": "side", "to": "left"}, by=Actor.SURGEON)
    return folder / "case"


@pytest.fixture
def copied(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "case"))


def edit(folder: Path, statement: str, values: tuple[object, ...] = ()) -> None:
    with sqlite3.connect(folder / "journal.sqlite") as db:
        db.execute("DROP TRIGGER IF EXISTS never_changed")
        db.execute(statement, values)
    db.close()


def test_everything_computed_comes_out_the_same_to_the_bit(run, recorded: Path) -> None:
    ran = run("case", "replay", recorded, "--json")
    assert ran.code == 0, ran.out
    outcomes = [(one["kind"], one["outcome"]) for one in ran.document["entries"]]
    view = ["acquired", "detected", "labelled", "calibrated"]
    computed = [*view, *view, "planned", *(2 * ["acquired", "labelled", "calibrated"]), "planned"]
    assert outcomes == [*((kind, "same to the bit") for kind in computed), ("changed", "recorded, not computed")]
    assert "MILLER" not in ran.out.upper()


def test_a_whole_case_is_said_to_be_whole_and_is_not_touched_and_names_nobody(run, recorded: Path) -> None:
    before = {file: file.read_bytes() for file in recorded.rglob("*") if file.is_file()}
    whole, shown = run("case", "check", recorded), run("case", "show", recorded)
    assert (whole.code, shown.code) == (0, 0), whole.err + shown.err
    assert "17 entries" in whole.out
    for words in ("planned", "surgeon", "4, 8", "C-"):
        assert words in shown.out
    check, show = run("case", "check", recorded, "--json"), run("case", "show", recorded, "--json")
    assert [one["name"] for one in check.document["checks"]] == ["case database", "case chain", "case originals"]
    assert show.document["entries"][8]["content"]["asked"]["pick_sd_px"] == 0.5
    assert {file: file.read_bytes() for file in recorded.rglob("*") if file.is_file()} == before
    for data in ((recorded / "journal.sqlite").read_bytes(), (check.out + show.out).encode()):
        assert b"MILLER" not in data.upper()


def test_the_report_names_the_case_by_its_number_alone(run, recorded: Path, tmp_path: Path) -> None:
    ran = run("case", "report", recorded, "--out", tmp_path / "report", "--json")
    assert ran.code == 0, ran.out
    files = {file.name: file.read_bytes() for file in (tmp_path / "report").glob("[!.]*")}
    assert files.keys() == {"report.html", "report.json"}
    for data in files.values():
        assert b"MILLER" not in data.upper()
    number = ran.document["case"].encode()
    assert number in files["report.html"]
    document = json.loads(files["report.json"])
    assert document["case"].encode() == number
    with Case.open(recorded, read_only=True) as case:
        assert document["trajectory"] == case.entry(9).content["trajectory"]


def test_results_are_made_again_from_their_entries(recorded: Path, setup) -> None:
    with Case.open(recorded, read_only=True) as case:
        entry = case.latest(Kind.PLANNED)
        assert entry is not None
        plan = Recomputed(case).plan(entry)
    assert plan.trajectory.document() == entry.content["trajectory"]
    assert np.linalg.norm(plan.trajectory.points.xyz_mm - WIRE_MM, axis=1).max() < 1.0  # the frame's errors


@pytest.mark.slow
def test_a_view_held_against_its_c_arm_and_earlier_ones_is_computed_again_so(frame, tmp_path: Path) -> None:
    """What a view was compared with stands in its entry; only a flat panel's is compared with earlier ones."""
    rng = np.random.default_rng(10)
    panel = draw_setup(rng, frame, chain="flat-panel")
    scene = hip_scene(panel, rng).scene
    pair = {name: write_dicom(render(panel, name, scene, rng), tmp_path / f"{name}.dcm") for name in NAMES}
    images = calibrate_pair(see_pair(pair["pa"], pair["lateral"], frame), frame, "smooth", source_detector_mm=1000.0)
    with Case.create(tmp_path / "case") as case:
        ref = stages.keep_frame(case, frame)
        first = stages.record_view(case, pair["pa"], images[0], frame_ref=ref, by=Actor.RECEIVER)
        again = replace(images[0], view=images[0].view.steady_since([images[0].view]))
        labelled = case.entry(first.rests_on[0])
        later = stages.record_calibrated(case, labelled, again, by=Actor.RECEIVER, before=[first.number])
        names = [check["name"] for check in later.content["checks"]]
        assert names[-2:] == ["source distance", "focal length before"]
        assert all(one.outcome == "same to the bit" for one in replay(case))


def test_a_case_that_is_not_whole_is_refused_with_the_reason(run, copied: Path) -> None:
    edit(copied, "UPDATE entries SET content = replace(content, 'smooth', 'Smooth') WHERE number = 4")
    ran = run("case", "check", copied)
    assert ran.code == 3
    assert "Entry 4" in " ".join(ran.out.split())
    (copied / "journal.sqlite").write_bytes(b"\x00" * 8192)
    ran = run("case", "check", copied)
    assert ran.code == 3
    assert "damaged" in " ".join(ran.out.split())


def test_a_missing_original_is_refused_and_what_rests_on_it_cannot_be_computed(run, copied: Path) -> None:
    with Case.open(copied) as case:
        case.original(case.entry(1).content["original"]).unlink()
    assert run("case", "check", copied).code == 3
    ran = run("case", "replay", copied, "--json")
    assert ran.code == 3
    outcomes = [one["outcome"] for one in ran.document["entries"]]
    assert outcomes[:9] == ["cannot be computed again"] * 4 + ["same to the bit"] * 4 + ["cannot be computed again"]
    assert "no such original" in ran.document["entries"][3]["reason"]


NOW = {"estimator": str(ESTIMATOR)}
SINCE = "version 2" if ESTIMATOR == 2 else f"versions 2 to {ESTIMATOR}"


def forged(folder: Path, number: int, change, versions: dict[str, str] | None = None) -> None:
    """An entry with another content and a hash that fits it: what the chain notices, replaying shall notice too."""
    with Case.open(folder, read_only=True) as case:
        entry = case.entry(number)
    content = entry.content
    change(content)
    text = canonical(content)
    stated = canonical(versions or entry.versions)
    values = (text, digest(text), stated, number)
    edit(folder, "UPDATE entries SET content = ?, content_sha256 = ?, versions = ? WHERE number = ?", values)


def shift(by_mm: float):
    def change(content) -> None:
        content["trajectory"]["entry_mm"][0] += by_mm

    return change


FORGED: tuple[tuple[float, dict[str, str] | None, str], ...] = (
    (1e-9, None, "differs"),
    (1e-9, {"numpy": "1.0", **NOW}, "within tolerance, by other versions"),
    (0.1, {"numpy": "1.0", **NOW}, "differs"),
    (0.1, {"numpy": "1.0"}, f"estimates changed in {SINCE}"),
    (3.0, {"numpy": "1.0"}, f"estimates changed by more than their stated error in {SINCE}"),
    (0.1, {"estimator": str(ESTIMATOR + 1)}, f"estimates changed in version {ESTIMATOR + 1}"),
    (1e-9, {"numpy": "1.0"}, "within tolerance, by other versions"),
)


@pytest.mark.slow
def test_a_result_that_is_not_what_the_originals_give_is_noticed(copied: Path) -> None:
    """Were the versions the same, it must be the same to the bit; with others, to what they may change.

    Of another estimator it may be anything, and how far is said. `case replay` prints the same of all entries together.
    """
    with Case.open(copied) as case:
        plan = case.entry(9)
        again = [case.record(Kind.PLANNED, plan.content, by=Actor.APP, rests_on=plan.rests_on).number for _ in FORGED]
    for number, (by_mm, versions, _) in zip(again, FORGED, strict=True):
        forged(copied, number, shift(by_mm), versions)
    with Case.open(copied, read_only=True) as case:
        replayed = list(replay(case))[-len(FORGED) :]
    for one, (by_mm, versions, outcome) in zip(replayed, FORGED, strict=True):
        assert one.said == outcome
        (difference,) = one.differences
        assert difference.where == "trajectory.entry_mm[0]"
        assert difference.by == pytest.approx(by_mm, rel=1e-3)
        judged = judge([one])
        assert judged.name == "case replay"
        assert judged.passed is not (outcome == "differs" or "more than" in outcome)
        if versions and "numpy" in versions:
            assert any(change.startswith("numpy 1.0 -> ") for change in one.changed)
        if outcome.startswith("estimates"):
            told = _document(one)["largest_change"]
            assert told["mm"].by == pytest.approx(by_mm)
            assert told["px"] is None
            words = (
                "entry point by 3 mm, 95 % error stated"
                if by_mm > 1
                else f"by at most 0.1 mm (entry {one.entry.number}, trajectory.entry_mm[0]"
            )
            assert words in judged.sentence


def test_each_entry_is_judged_by_itself(run, copied: Path) -> None:
    """Replay compares an older estimator's beads within their errors, images exactly, and verdicts as words."""

    def moved(by_sd: float):
        def change(content) -> None:
            content["uv_px"][0][0] += by_sd * content["covariance_px2"][0][0][0] ** 0.5

        return change

    def other_verdict(content) -> None:
        content.update(go=not content["go"])

    old = {"numpy": "1.0"}
    forged(copied, 1, lambda content: content.update(pixels_sha256="0" * 64), old)
    forged(copied, 3, moved(1.0), old)
    forged(copied, 7, moved(12.0), old)
    forged(copied, 9, other_verdict, old)
    forged(copied, 16, other_verdict, old | NOW)
    with Case.open(copied) as case:
        case.record(Kind.PLANNED, {"by": "hand"}, by=Actor.ENGINEER)  # as no stage records it
        case.record(Kind.DETECTED, {}, by=Actor.ENGINEER, rests_on=[1, 2])
    ran = run("case", "replay", copied, "--json")
    assert ran.code == 3
    outcomes = {one["entry"]: one["outcome"] for one in ran.document["entries"]}
    changed = f"estimates changed in {SINCE}"
    assert {number: outcome for number, outcome in outcomes.items() if outcome != "same to the bit"} == {
        1: "differs",
        3: changed,
        7: f"estimates changed by more than their stated error in {SINCE}",
        9: changed,
        16: "differs",
        17: "recorded, not computed",
        18: "cannot be computed again",
        19: "cannot be computed again",
    }
    replayed = next(check for check in ran.document["checks"] if check["name"] == "case replay")
    assert "another verdict in entry 9" in replayed["sentence"]


def test_a_frame_of_ones_own_is_kept_with_the_case(frame, tmp_path: Path) -> None:
    """A frame file that only calls itself gamma is not the built-in one."""
    document = tmp_path / "gamma.json"
    frame.save(document)
    own = json.loads(document.read_text())
    own["views"]["pa"]["xrii"][0]["xyz"][0] += 0.25
    document.write_text(json.dumps(own))
    measured = type(frame).load(document)
    with Case.create(tmp_path / "case") as case:
        assert stages.keep_frame(case, frame) == "gamma"
        name = stages.keep_frame(case, measured)
        assert name.endswith(".json")
        found = stages.frame_of(case, name).view("pa").xrii.fiducials[0].xyz_mm
    assert found[0] == own["views"]["pa"]["xrii"][0]["xyz"][0]


def test_a_plan_rests_on_two_calibrated_views(copied: Path) -> None:
    with Case.open(copied) as case:
        entry = case.entry(9)
        again = Recomputed(case)
        pair = case.entry(4), case.entry(3)
        with pytest.raises(CaseError, match="two calibrated views or more, not on calibrated and labelled"):
            stages.record_planned(case, pair, PlanRequest.of(entry.content["asked"]), again.plan(entry), by=Actor.APP)


def test_a_plan_of_an_earlier_version_is_judged_by_what_was_known_then(recorded: Path) -> None:
    with Case.open(recorded, read_only=True) as case:
        entry = case.latest(Kind.PLANNED)
        assert entry is not None
        old = json.loads(json.dumps(entry.content))
        for key in ("verdict", "missing", "noticed_along_mm", "kind", "procedure", "implant", "side", "limits"):
            del old[key]
        for key in ("side", "aids", "procedure"):
            del old["asked"][key]
        old["asked"] |= {"kind": "hip-screw", "limits": {"position_mm": 1.0, "direction_rad": 0.0105}}
        old["asked"]["landmark_names"] = ["landmark-head-centre", "landmark-lesser-trochanter"]
        old["landmarks"] = [{key: mark[key] for key in mark if key != "name"} for mark in old["landmarks"]]
        old["checks"] = [check for check in old["checks"] if check["name"] != "pick spread"]
        for check in old["checks"]:
            if check["name"] == "direction error":
                check["limit"] = float(np.rad2deg(0.0105))
        again = Recomputed(case).content(replace(entry, content=old))
    assert again is not None
    for check in (*again["checks"], *old["checks"]):
        del check["sentence"]  # it repeats the limit
    assert again == old
