"""Runs the app on one case: starts worker, procedure and server in this order, and ends them in reverse order."""

import asyncio
import sys
from collections.abc import Callable

from sightline.app.drawing.pictures import Pictures
from sightline.app.page import build
from sightline.app.session.session import Session
from sightline.app.session.worker import WorkerProcess
from sightline.app.settings import Settings
from sightline.app.web.serve import ServedApp, serve

# Thread switch interval, so that computing threads do not delay the page's thread. At Python's default of 5 ms a curve
# waits for the plan behind it: figures follow a drag 11 ms later [measured].
_SWITCH_S = 0.0005


def run(settings: Settings, on_ready: Callable[[ServedApp], None]) -> None:
    """Serve until Ctrl-C. Raises CaseError, FrameError, UnusableInputError."""
    sys.setswitchinterval(_SWITCH_S)
    worker = WorkerProcess()
    session = Session.open(settings.folder, settings.frame, settings.patient, worker)
    pictures: list[Pictures] = []
    started: list[asyncio.Task[None]] = []

    def page(site: ServedApp) -> None:
        build(site, session, pictures[0], settings)

    def ready(site: ServedApp) -> None:
        pictures.append(Pictures(site.images))
        loop = asyncio.get_running_loop()
        started.append(loop.create_task(session.planning.start()))  # while the browser still loads
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
        worker.close()
        session.planning.case.close()
