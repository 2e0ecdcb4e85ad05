"""A pair of mirrored displays: a person answers for one image, and the case holds what follows from it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sightline.app.panels.steps import StepStatus, steps
from sightline.app.plan.decisions import Decisions, Display
from sightline.app.session.jobs import WorkerProcess
from sightline.app.session.seen import SeenImage, entry_of
from sightline.app.session.session import Session
from sightline.case import stages
from sightline.case.journal import Actor, Kind
from sightline.case.replay import ReplayOutcome, replay
from sightline.case.views import NAMES, calibrated, see_pair
from sightline.common.checks import failed
from sightline.detection import Observations
from sightline.detection.csv_files import write_observations
from sightline.errors import UnusableInputError
from sightline.frame import Frame
from sightline.twin import SetUp, bead_images

WIDTH_PX = 1023.0


@pytest.fixture(params=[NAMES, ("lateral",), ()])
def flipped(request: pytest.FixtureRequest) -> tuple[str, ...]:
    """The views whose displays are mirrored."""
    return request.param


@pytest.fixture
def opened(
    flipped: tuple[str, ...], setup: SetUp, frame: Frame, worker: WorkerProcess, tmp_path: Path
) -> Iterator[Session]:
    """Both images calibrated and recorded, from tables of their beads."""
    session = Session.open(tmp_path / "case", "gamma", None, worker)
    tables = [_table(setup, name, tmp_path, mirrored=name in flipped) for name in NAMES]
    for table, seen in zip(tables, see_pair(tables[0], tables[1], frame), strict=True):
        image = calibrated(seen, frame)
        made = stages.record_view(session.planning.case, table, image, frame_ref="gamma", by=Actor.RECEIVER)
        acquired, pixels = stages.acquired_of(session.planning.case, made), _no_pixels()
        one = SeenImage(acquired, pixels, observations=seen.observations, view=image.view)
        session.planning.lightbox._images[acquired.number] = one
        session.planning.edit(session.planning.decisions.with_image(image.name, acquired.number, same_pixels=False))
    yield session
    session.planning.case.close()


def _no_pixels() -> Any:
    return None


def _table(setup: SetUp, name: str, folder: Path, *, mirrored: bool) -> Path:
    ids, uv = bead_images(setup, name, np.random.default_rng(5), 0.1)
    if mirrored:
        uv = uv * (-1.0, 1.0) + (WIDTH_PX, 0.0)
    return write_observations([Observations(name, tuple(ids), uv)], folder / f"{name}.csv")


def _upright(session: Session) -> list[bool]:
    views = session.planning.views()
    assert views is not None
    return [view.mirrored == bool(view.mirrored_display) for view in views]


def test_a_person_is_asked_only_where_no_image_shows_the_frame_unmirrored(
    opened: Session, flipped: tuple[str, ...]
) -> None:
    assert opened.planning.asks_mirrored == (NAMES if flipped == NAMES else ())
    asked = flipped == NAMES
    opened.planning.decide(side="right")
    opened.planning.confirm_serial("none")
    for number in opened.planning.decisions.images.values():
        opened.planning.decide(taken={**opened.planning.decisions.taken, number: opened.planning.case.entry(1).at})
    assert (steps(opened)[0].status is StepStatus.ATTENTION) is asked
    assert any(_upright(opened)) is not asked


@pytest.mark.parametrize("flipped", [NAMES], indirect=True)
@pytest.mark.parametrize("turned", [False, True])
def test_the_answer_is_of_the_file_and_not_of_how_the_page_shows_it(opened: Session, turned: bool) -> None:
    opened.planning.decide(display={"pa": Display(mirrored=turned)})
    opened.planning.state_mirrored("pa", backwards=not turned)
    assert opened.planning.decisions.mirrored == {opened.planning.decisions.images["pa"]: True}
    assert _upright(opened) == [True, False]
    assert Decisions.of(opened.planning.decisions.document()) == opened.planning.decisions
    seen = opened.planning.seen("pa")
    assert seen is not None and seen is opened.planning.seen("pa") and not failed(seen.view.checks)  # type: ignore[union-attr]
    opened.planning.history.undo()
    assert _upright(opened) == [False, False]


@pytest.mark.parametrize("flipped", [NAMES], indirect=True)
def test_a_display_that_is_said_to_be_right_accuses_the_frame_file(opened: Session) -> None:
    opened.planning.state_mirrored("lateral", backwards=False)
    seen = opened.planning.seen("lateral")
    assert seen is not None and seen.view is not None
    assert [check.name for check in failed(seen.view.checks)] == ["frame handedness"]
    with pytest.raises(UnusableInputError, match="calibrated"):
        opened.planning.state_mirrored("check-pa", backwards=True)


@pytest.mark.parametrize("flipped", [NAMES], indirect=True)
def test_the_case_holds_the_view_with_the_answer_and_replays_it(opened: Session) -> None:
    before = opened.planning.seen("pa")
    assert before is not None
    first = entry_of(opened.planning.case, before)
    opened.planning.state_mirrored("pa", backwards=True)
    after = opened.planning.seen("pa")
    assert after is not None
    entry = entry_of(opened.planning.case, after)
    assert entry.number > first.number and entry.settings["mirrored_display"] is True
    assert entry_of(opened.planning.case, after).number == entry.number  # once
    replayed = {one.entry.number: one for one in replay(opened.planning.case) if one.entry.kind is Kind.CALIBRATED}
    assert {one.outcome for one in replayed.values()} == {ReplayOutcome.SAME}
    assert len(replayed) == 3
