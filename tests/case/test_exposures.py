"""What a report tells of a case besides its plan: each exposure once, with its use, its frames and its time."""

from pathlib import Path

import pytest

from sightline.case.journal import Actor, Case, Entry, Kind
from sightline.case.replay import Recomputed
from sightline.case.report import content as case_report
from sightline.case.report.content import UNUSED, exposures_of_case


@pytest.fixture
def case(tmp_path: Path):
    with Case.create(tmp_path / "case") as opened:
        yield opened


def acquired(case: Case, pixels: str, **acquisition: object) -> Entry:
    name = case.keep(f"{pixels} {case.last}".encode(), ".dcm")
    content = {"original": name, "pixels_sha256": pixels}
    return case.record(Kind.ACQUIRED, content, by=Actor.RECEIVER, settings={"acquisition": acquisition})


def calibrated(case: Case, image: Entry, view: str) -> Entry:
    labelled = case.record(Kind.LABELLED, {}, by=Actor.APP, rests_on=[image.number])
    return case.record(Kind.CALIBRATED, {"view": view}, by=Actor.APP, rests_on=[labelled.number])


def planned(case: Case, *images: Entry) -> Entry:
    views = [calibrated(case, image, name).number for image, name in zip(images, ("pa", "lateral"), strict=True)]
    return case.record(Kind.PLANNED, {}, by=Actor.SURGEON, rests_on=views)


def test_every_exposure_is_listed_with_what_it_was_used_for(case: Case) -> None:
    spoilt, pa = acquired(case, "a"), acquired(case, "b", averaged=8)
    lateral, live = acquired(case, "c"), acquired(case, "d", frames=60)
    plan = planned(case, pa, lateral)
    checks = [acquired(case, name) for name in "ef"]
    views = [calibrated(case, one, name).number for one, name in zip(checks, ("pa", "lateral"), strict=True)]
    case.record(Kind.VERIFIED, {}, by=Actor.APP, rests_on=[plan.number, *views])
    found = exposures_of_case(case, plan)
    assert [(one.used, one.frames) for one in found] == [
        (UNUSED, 1),
        ("planning, PA view", 8),
        ("planning, lateral view", 1),
        (UNUSED, 60),
        ("check shot, PA view", 1),
        ("check shot, lateral view", 1),
    ]
    for one, entry in zip(found, (spoilt, pa, lateral, live, *checks), strict=True):
        assert one.image == f"{entry.content['original'][:12]}.dcm"
        assert one.at == f"{entry.at:%Y-%m-%d %H:%M:%S}"


def test_what_came_again_is_no_further_exposure(case: Case) -> None:
    """The same pixels under another header: an archive sent them again, and the plan was made on those."""
    first, lateral = acquired(case, "a"), acquired(case, "b")
    again = acquired(case, "a")
    found = exposures_of_case(case, planned(case, again, lateral))
    assert [one.used for one in found] == ["planning, PA view", "planning, lateral view"]
    assert found[0].image.startswith(again.content["original"][:12])
    assert found[0].at == f"{first.at:%Y-%m-%d %H:%M:%S}"


def test_another_plans_exposures_are_not_called_this_ones(case: Case) -> None:
    old = [acquired(case, name) for name in "ab"]
    planned(case, old[0], old[1])
    new = [acquired(case, name) for name in "cd"]
    found = exposures_of_case(case, planned(case, new[0], new[1]))
    assert [one.used for one in found[:2]] == [UNUSED] * 2
    assert found[2].used == "planning, PA view"


def test_frames_taken_out_of_one_file_are_one_exposure(case: Case) -> None:
    run = case.keep(b"a run of 30 frames", ".dcm")
    for index in range(2):
        content = {"original": run, "pixels_sha256": f"frame {index}"}
        case.record(Kind.ACQUIRED, content, by=Actor.RECEIVER, settings={"acquisition": {"frames": 30}})
    found = exposures_of_case(case, planned(case, acquired(case, "a"), acquired(case, "b")))
    assert [one.frames for one in found] == [30, 1, 1]


def test_a_check_shot_of_an_earlier_version_is_left_out(case: Case) -> None:
    """It did not say what it was measured from, so nobody can measure it again."""
    plan = case.record(Kind.PLANNED, {}, by=Actor.SURGEON)
    case.record(Kind.VERIFIED, {"entry_mm": 0.1}, by=Actor.APP, rests_on=[plan.number])
    assert case_report._drilled(case, plan, Recomputed(case)) is None
    case.record(Kind.VERIFIED, {"asked": {}}, by=Actor.APP, rests_on=[plan.number])
    with pytest.raises((KeyError, ValueError)):  # this one says so, and would be measured
        case_report._drilled(case, plan, Recomputed(case))
