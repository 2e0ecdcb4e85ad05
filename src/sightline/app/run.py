"""Runs the app on one case: starts worker, procedure and server in this order, and ends them in reverse order."""

import asyncio
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sightline.app.session.jobs import WorkerProcess
from sightline.app.session.rehearsing import Patient
from sightline.app.session.session import Session

if TYPE_CHECKING:
    from sightline.app.web.serve import ServedApp


@dataclass(frozen=True)
class Settings:
    """Settings of one run.

    `folder`: of the case. `frame`: None for the case's own. `patient`: for a new case that rehearses. `live`: source of
    a live image, as named for `sightline watch`. `fast_robot`: run a simulated robot's time as fast as possible.
    `token`: required of every browser; if None, one is made for addresses beyond this machine.
    """

    folder: Path
    frame: str | None
    patient: Patient | None
    live: str | None
    host: str
    port: int
    token: str | None
    open_browser: bool
    fast_robot: bool


# Thread switch interval, so that computing threads do not delay the page's thread. At Python's default of 5 ms a curve
# waits for the plan behind it: figures follow a drag 11 ms later [measured].
_SWITCH_S = 0.0005


def run(
    settings: Settings,
    worker: WorkerProcess,
    on_ready: Callable[["ServedApp"], None],
    on_session: Callable[[Session], None] = lambda _: None,
) -> None:
    """Serve until Ctrl-C, and end the worker. `on_session` is called with each session that is opened.

    Raises CaseError, FrameError, UnusableInputError."""
    sys.setswitchinterval(_SWITCH_S)
    with closing(worker):
        session = Session.open(settings.folder, settings.frame, settings.patient, worker)
        session.planning.begin()

        # The worker takes the images meanwhile: NiceGUI takes a second to import.
        from nicegui import Client

        from sightline.app.drawing.pictures import Pictures
        from sightline.app.page import build
        from sightline.app.tab.tab import Tab
        from sightline.app.web.serve import serve

        shown: list[Pictures] = []  # of the open case

        def page(site: "ServedApp") -> None:
            async def open_case(folder: Path) -> None:
                nonlocal session
                before = session
                session = before.succeeded_by(folder)
                shown.pop().forget()
                start(site)
                for client in list(Client.instances.values()):
                    client.run_javascript("sightlineOpened()")
                await before.close()

            build(site, Tab(session, shown[0], fast_robot=settings.fast_robot, live_source=settings.live), open_case)

        def start(site: "ServedApp") -> None:
            shown.append(Pictures(site.images))
            on_session(session)
            session.jobs.start(session.planning.start())  # while the browser still loads

        def ready(site: "ServedApp") -> None:
            start(site)
            on_ready(site)

        try:
            serve(
                page,
                host=settings.host,
                port=settings.port,
                token=settings.token,
                open_browser=settings.open_browser,
                on_ready=ready,
            )
        finally:
            asyncio.run(session.close())
