"""What two threads share, and what must not hold the page up."""

import asyncio
import threading
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any

import pytest
from tests.planning.standin import stand_in

from sightline.app.plan.decisions import Decisions
from sightline.app.plan.planner import planned
from sightline.app.session import robot_session
from sightline.app.session import shots as live_module
from sightline.app.session.jobs import Jobs
from sightline.app.session.robot_session import RobotNow, RobotSession
from sightline.app.session.shots import Live
from sightline.case.watch import live as watch
from sightline.errors import LinkError, SightlineError
from sightline.frame import Frame

VIEWS: Any = (stand_in("pa", 0.4, 0.3), stand_in("lateral", -0.2, 0.3))
PATIENCE_S = 60.0


def _session() -> RobotSession:
    """Without a link."""
    made = object.__new__(RobotSession)
    made.now, made._changed = RobotNow(activity="drilling"), lambda: None
    made._commands = SimpleQueue()
    made._lock, made._end, made._over = threading.Lock(), threading.Event(), False
    return made


def test_news_of_two_threads_are_both_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """The end of an order is not overwritten by a force that was read before it: it would be refused for ever after."""
    session, replace = _session(), robot_session.replace
    inside, done = threading.Event(), threading.Event()

    def slow(now: RobotNow, **news: Any) -> RobotNow:
        if "force_n" in news:
            inside.set()
            done.wait(0.2)  # the other thread gets in here, unless it is kept out
        return replace(now, **news)

    def end_order() -> None:
        inside.wait(PATIENCE_S)
        session._put(activity="")
        done.set()

    monkeypatch.setattr(robot_session, "replace", slow)
    other = threading.Thread(target=end_order)
    other.start()
    session._put(force_n=12.0)
    other.join(PATIENCE_S)
    assert (session.now.force_n, session.now.activity) == (12.0, "")


def test_an_order_after_the_links_end_is_refused_and_not_left_in_the_queue() -> None:
    session = _session()
    session.now, session._over = RobotNow(), True
    for order in (session.align(), session.stop()):
        with pytest.raises(LinkError, match="lost"):
            asyncio.run(order)
    assert session.now.activity == ""


class _Watch:
    """In place of `Watch`: what it was made of, and a source that hangs at its end."""

    made: Any = None

    def __init__(self, *of: Any) -> None:
        _Watch.made, self.let_go, self.in_time = of, threading.Event(), False

    def start(self) -> None: ...

    def close(self) -> None:
        self.in_time = self.let_go.wait(PATIENCE_S)


def _live(monkeypatch: pytest.MonkeyPatch, sent: Any) -> Live:
    monkeypatch.setattr(watch, "Watch", _Watch)
    monkeypatch.setattr(live_module, "_opened", lambda *_: ())
    planning: Any = SimpleNamespace(sent=sent, planned=None, patient=None, frame=Frame.load("gamma"), jobs=Jobs())
    planning.views = lambda: VIEWS
    return Live(planning)


def test_a_plan_that_was_sent_is_watched_with_the_views_it_was_made_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not with those of images that came since."""
    before = (object(), object())
    known = SimpleNamespace(plan=SimpleNamespace(trajectory="the plan"), views=before)
    live = _live(monkeypatch, SimpleNamespace(planned=known))
    asyncio.run(live.start(None))
    assert _Watch.made[2:] == ("the plan", before)


def test_the_page_goes_on_while_a_live_source_hangs_at_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    live = _live(monkeypatch, None)

    async def close_and_go_on() -> Any:
        await live.start(None)
        hanging: Any = live.watch
        closing = asyncio.create_task(live.close())
        while live.watch is not None:
            await asyncio.sleep(0)
        hanging.let_go.set()  # only a loop that is not held up gets here
        await closing
        return hanging

    assert asyncio.run(close_and_go_on()).in_time


def test_every_refusal_is_an_error_of_its_own() -> None:
    """One that is raised again carries the places of all times before, and grows."""
    known, raised = planned(Decisions(), VIEWS), []
    for _ in range(2):
        with pytest.raises(SightlineError, match="side") as refused:
            known.proposal()
        raised.append(refused.value)
    assert raised[0] is not raised[1]
