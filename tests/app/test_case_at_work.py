"""The case at work without a page: what is decided comes back, one thing at a time."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sightline.app.session.jobs import WorkerProcess
from sightline.app.session.rehearsing import Patient, images
from sightline.app.session.session import Session
from sightline.case.journal import Actor, Case
from sightline.case.stages import record_acquired
from sightline.errors import CaseError, ImageError, UnusableInputError


def test_snapping_is_a_decision_like_any_other(tmp_path: Path, worker: WorkerProcess) -> None:
    """For every page, undone with the others, and there again when the case is opened again."""

    async def decide() -> None:
        session = Session.open(tmp_path, "gamma", None, worker)
        told: list[bool] = []
        session.jobs.listeners.append(lambda: told.append(session.planning.decisions.snapping))
        session.planning.decide(snapping=False)
        session.planning.undo()
        session.planning.redo()
        assert told[:3] == [False, True, False]
        await asyncio.sleep(0)
        session.planning.case.close()

    asyncio.run(decide())
    again = Session.open(tmp_path, None, None, worker)
    assert not again.planning.decisions.snapping
    assert again.planning.history.can_undo
    again.planning.case.close()
    with Case.open(tmp_path, read_only=True) as case:
        assert not case.problems


def test_work_that_is_refused_while_other_work_goes_on_is_not_begun(tmp_path: Path, worker: WorkerProcess) -> None:
    """A coroutine made for it would be left behind, of which Python warns."""
    begun: list[str] = []

    async def work(name: str) -> str:
        begun.append(name)
        await asyncio.sleep(0)
        return name

    async def both() -> list[object]:
        session = Session.open(tmp_path, "gamma", None, worker)
        asked = [session.jobs.during(name, lambda name=name: work(name)) for name in ("first", "second")]
        said = await asyncio.gather(*asked, return_exceptions=True)
        assert await session.jobs.during("third", lambda: work("third")) == "third"
        session.planning.case.close()
        return list(said)

    first, second = asyncio.run(both())
    assert first == "first"
    assert isinstance(second, UnusableInputError) and "first is not done yet" in str(second)
    assert begun == ["first", "third"]


def test_the_images_of_a_rehearsal_are_begun_ahead_until_the_case_has_them(tmp_path: Path) -> None:
    """Taking them again at each start would cost seconds."""
    begun: list[Any] = []
    worker: Any = SimpleNamespace(begin=lambda *what: begun.append(what))
    planning = Session.open(tmp_path, None, Patient(9), worker).planning
    planning.begin()
    assert begun == [(images, Patient(9))]
    planning.edit(planning.decisions.with_image("pa", 1, same_pixels=False))
    planning.begin()
    assert len(begun) == 1
    planning.case.close()


def test_a_damaged_image_is_named_as_a_person_knows_it(tmp_path: Path) -> None:
    """Fails where the message names the kept file, which is called by its digest."""
    with Case.create(tmp_path / "case") as case, pytest.raises(ImageError) as refused:
        record_acquired(case, b"\0" * 128 + b"DICM" + b"junk", ".dcm", by=Actor.RADIOGRAPHER)
    assert str(refused.value).startswith("the file is truncated or damaged")


# Another case is opened from the list: what was done is kept, a refused case says why and changes nothing.


@pytest.fixture
def session(tmp_path: Path, worker: WorkerProcess) -> Iterator[Session]:
    made = Session.open(tmp_path / "first", "gamma", None, worker)
    yield made
    asyncio.run(made.close())


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
