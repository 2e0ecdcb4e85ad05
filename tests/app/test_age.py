"""How old a plan is: since its images were taken, not since their files came; and no older once it is drilled."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydicom import dcmread
from pydicom.config import disable_value_validation
from pydicom.datadict import dictionary_VR

from sightline.app.plan.decisions import Decisions
from sightline.app.session import readiness as module
from sightline.app.session.jobs import WorkerProcess
from sightline.app.session.seen import SeenImage
from sightline.app.session.sent import SentPlan
from sightline.app.session.session import Session
from sightline.case.journal import Actor
from sightline.case.views import NAMES
from sightline.errors import UnusableInputError
from sightline.imaging import Radiograph, taken_at, write_dicom, write_png
from sightline.planning import kind
from sightline.robot.kinematics.target import LIFETIME_S

NOW = datetime(2026, 3, 4, 12, 0, 0, tzinfo=UTC)
IMAGE = Radiograph(np.full((32, 32), 9, np.uint16), 4095.0)


@pytest.mark.parametrize(
    ("said", "at"),
    [
        ({"AcquisitionDateTime": "20260304115030.25+0100"}, datetime(2026, 3, 4, 10, 50, 30, tzinfo=UTC)),
        (
            {"AcquisitionDate": "20260304", "AcquisitionTime": "115030", "TimezoneOffsetFromUTC": "-0500"},
            datetime(2026, 3, 4, 16, 50, 30, tzinfo=UTC),
        ),
        ({"ContentDate": "20260304", "ContentTime": "115030.5"}, datetime(2026, 3, 4, 11, 50, 30).astimezone()),
        ({"StudyDate": "20260304", "StudyTime": "115030"}, None),  # of the study, not of the image
        ({"AcquisitionDate": "20260304", "AcquisitionTime": "11"}, None),  # to the hour
        ({"AcquisitionDate": "20261404", "AcquisitionTime": "115030"}, None),
        ({"AcquisitionTime": "115030"}, None),
        ({}, None),
    ],
)
def test_a_dicom_file_says_when_its_image_was_taken(tmp_path: Path, said: dict[str, str], at: datetime | None) -> None:
    file = write_dicom(IMAGE, tmp_path / "one.dcm")
    data = dcmread(file)
    for keyword in [one.keyword for one in data if one.keyword.endswith(("Date", "Time"))]:
        delattr(data, keyword)
    with disable_value_validation():
        for keyword, value in said.items():
            data.add_new(keyword, dictionary_VR(keyword), value)
        data.save_as(file)
    assert taken_at(file) == at


def test_no_other_file_says_it(tmp_path: Path) -> None:
    assert taken_at(write_png(IMAGE, tmp_path / "one.png")) is None


class _Clock(datetime):
    """`now` is set by hand."""

    at = NOW

    @classmethod
    def now(cls, tz: Any = None) -> datetime:
        return cls.at


@pytest.fixture
def opened(tmp_path: Path, worker: WorkerProcess, monkeypatch: pytest.MonkeyPatch) -> Iterator[Session]:
    """Both images came just now."""
    monkeypatch.setattr(module, "datetime", _Clock)
    monkeypatch.setattr(module, "monotonic", lambda: 0.0)
    _Clock.at = NOW
    made = Session.open(tmp_path, "gamma", None, worker)
    for number, name in enumerate(NAMES, 101):
        _came(made, name, number)
    yield made
    made.planning.case.close()


def _came(session: Session, name: str, number: int, said_ago_s: float | None = 0.0, by: Actor = Actor.APP) -> None:
    acquired: Any = SimpleNamespace(number=number, at=NOW, by=by)
    image: Any = None
    said = None if said_ago_s is None else NOW - timedelta(seconds=said_ago_s)
    session.planning.lightbox._images[number] = SeenImage(acquired, image, taken_at=said)
    session.planning.history.edit(session.planning.decisions.with_image(name, number, same_pixels=True))


def _age_check(session: Session):
    return next(check for check in session.readiness.confirmations if check.name == "plan age")


def test_age_counts_from_the_acquisition(opened: Session) -> None:
    """A file that lay for an hour is an hour old however lately it came."""
    assert opened.age.now_s == 0.0 and opened.age.fresh
    _came(opened, "lateral", 103, said_ago_s=3600.0)
    assert opened.age.now_s == 3600.0 and not opened.age.fresh
    assert "too old" in _age_check(opened).sentence


@pytest.mark.parametrize("said_ago_s", [None, -60.0])
def test_a_time_that_is_not_known_is_asked_for(opened: Session, said_ago_s: float | None) -> None:
    """Nor is one known that lies after the file's arrival: that clock is another."""
    _came(opened, "lateral", 103, said_ago_s)
    assert opened.age.now_s is None and not opened.age.fresh
    assert not _age_check(opened).passed and "not known" in _age_check(opened).sentence
    for minutes in (-1.0, float("nan"), 1e9):
        with pytest.raises(UnusableInputError, match="minutes"):
            opened.age.state_taken("lateral", minutes)
    opened.age.state_taken("lateral", 4.0)
    assert opened.age.now_s == 240.0 and _age_check(opened).passed
    assert Decisions.of(opened.planning.decisions.document()) == opened.planning.decisions
    _came(opened, "lateral", 104, None)  # the statement was about another image
    assert opened.age.now_s is None


def test_a_clock_that_is_set_back_makes_no_plan_younger(opened: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    passed_s = [1000.0]
    monkeypatch.setattr(module, "monotonic", lambda: passed_s[0])
    _Clock.at = NOW + timedelta(seconds=60.0)
    assert opened.age.now_s == 60.0
    passed_s[0] += LIFETIME_S - 30.0
    assert opened.age.now_s == LIFETIME_S + 30.0 and not opened.age.fresh
    _Clock.at = NOW - timedelta(seconds=1.0)
    assert opened.age.now_s == -1.0 and not opened.age.fresh
    _came(opened, "pa", 103, said_ago_s=0.0)
    _came(opened, "lateral", 104, said_ago_s=5.0)
    _Clock.at = NOW
    assert opened.age.now_s == 5.0  # of another pair


def test_the_images_of_a_rehearsal_are_taken_as_they_come(opened: Session) -> None:
    for number, name in enumerate(NAMES, 103):
        _came(opened, name, number, None, Actor.DEMO)
    assert opened.age.now_s == 0.0


def test_what_is_drilled_grows_no_older_but_is_not_sent_again(opened: Session) -> None:
    decisions = opened.planning.decisions
    planned: Any = SimpleNamespace(decisions=decisions, plan=SimpleNamespace(kind=kind(decisions.kind)))
    drilled: Any = SimpleNamespace()
    opened.planning.all_sent[decisions.kind] = SentPlan(planned, NOW + timedelta(seconds=120))
    opened.planning.all_drilled[decisions.kind] = drilled
    _Clock.at = NOW + timedelta(seconds=LIFETIME_S + 1.0)
    check = _age_check(opened)
    assert check.passed and check.figure == 120.0
    assert not opened.age.fresh and not opened.readiness.can_send
    opened.planning.history.edit(opened.planning.decisions.with_image("pa", 105, same_pixels=True))  # another plan
    assert not _age_check(opened).passed
