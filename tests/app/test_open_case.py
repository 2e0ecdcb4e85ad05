"""Opening another case from the list: what was done is kept, a refused case says why and changes nothing."""

import asyncio
from pathlib import Path

import pytest

from sightline.app.session.jobs import WorkerProcess
from sightline.app.session.session import Session
from sightline.case.journal import Case
from sightline.errors import CaseError, UnusableInputError


@pytest.fixture
def session(tmp_path: Path):
    worker = WorkerProcess()
    made = Session.open(tmp_path / "first", "gamma", None, worker)
    yield made
    asyncio.run(made.close())
    worker.close()


def test_another_case_has_its_own_decisions_and_frame(session: Session, tmp_path: Path) -> None:
    other = Session.open(tmp_path / "second", "biplane", None, session.planning.worker)
    other.planning.decide(side="left")
    asyncio.run(other.close())
    session.planning.decide(side="right")
    opened = session.succeeded_by(tmp_path / "second")
    assert opened.planning.decisions.side == "left"
    assert opened.planning.frame.fingerprint != session.planning.frame.fingerprint
    asyncio.run(session.close())
    again = opened.succeeded_by(tmp_path / "first")
    assert again.planning.decisions.side == "right"  # nothing acknowledged is lost
    for one in (opened, again):
        asyncio.run(one.close())


def test_a_folder_without_a_case_is_refused_and_stays_as_it_is(session: Session, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(CaseError, match="no case"):
        session.succeeded_by(tmp_path / "empty")
    assert not list((tmp_path / "empty").iterdir())
    session.planning.decide(side="left")  # the present one is still open


def test_work_in_progress_keeps_the_case_open(session: Session, tmp_path: Path) -> None:
    Case.create(tmp_path / "second").close()
    session.jobs.working = "calibrating"
    with pytest.raises(UnusableInputError, match="calibrating"):
        session.succeeded_by(tmp_path / "second")
