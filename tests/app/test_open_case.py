"""Opening another case from the list: what was done is kept, a refused case says why and changes nothing."""

import asyncio
from pathlib import Path

import pytest
from playwright.sync_api import expect
from tests.app.hands import SEED, Hands

from sightline.app import texts
from sightline.app.plan.decisions import Decisions
from sightline.app.session.session import Session
from sightline.app.session.worker import WorkerProcess
from sightline.case.journal import Actor, Case
from sightline.case.stages import record_changed
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
    other.planning.confirm_side("left")
    asyncio.run(other.close())
    session.planning.confirm_side("right")
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
    session.planning.confirm_side("left")  # the present one is still open


def test_work_in_progress_keeps_the_case_open(session: Session, tmp_path: Path) -> None:
    Case.create(tmp_path / "second").close()
    session.jobs.working = "calibrating"
    with pytest.raises(UnusableInputError, match="calibrating"):
        session.succeeded_by(tmp_path / "second")


@pytest.mark.slow
def test_a_case_is_opened_from_the_list_on_all_pages(serve, open_page, tmp_path: Path) -> None:
    """It asks first, and the first case is as it was."""
    with Case.create(tmp_path / "2") as other:
        record_changed(other, "edit", Decisions(side="left").document(), by=Actor.SURGEON)
        number = other.number
    command = ["sightline", "app", "--port", "{port}", "--no-browser", "--quiet"]
    server = serve(*command, "--case", str(tmp_path / "1"), "--rehearse", str(SEED))
    hands, second = Hands(open_page(server.url)), Hands(open_page(server.url))
    hands.wait_for_step("calibrate", "done")
    first = _open_list(hands)
    hands.press("cases-close")
    hands.details()
    hands.confirm()
    hands.step("plan")
    _open(hands, number)
    for page in (hands, second):
        expect(page.see("step-images")).to_have_attribute("aria-current", "step")
        expect(page.see("no-pa")).to_be_visible()
    _open_list(hands)
    hands.press("cases-close")
    hands.details()
    _open(hands, first)
    hands.wait_for_step("images", "done")
    hands.wait_for_step("calibrate", "done")


def _open_list(hands: Hands) -> str:
    """Open the list of cases; return the number of the one that is open."""
    hands.details()
    hands.press("cases")
    here = hands.see("cases-table").get_by_text(texts.CASE_HERE.format(number=""))
    return here.inner_text().split()[0]


def _open(hands: Hands, number: str) -> None:
    _open_list(hands)
    hands.press(f"open-{number}")
    expect(hands.see("cases-sheet")).to_contain_text(texts.CASE_QUESTION.format(number=number))
    hands.press("open-yes")
