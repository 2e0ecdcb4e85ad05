"""Runs the app on one case: workshop, procedure, server, in this order, and ends them in the other."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sightline.app.drawn import Pictures
from sightline.app.page import build
from sightline.app.procedure import Procedure
from sightline.app.rehearsing import Patient
from sightline.app.serve import Site, serve
from sightline.app.workshop import Workshop


@dataclass(frozen=True)
class Settings:
    """How the app is run. `folder`: of the case; `frame`: None for that of the case; `patient`: for a new case that
    rehearses; `fast_robot`: a simulated robot's time runs as fast as it computes."""

    folder: Path
    frame: str | None
    patient: Patient | None
    host: str
    port: int
    open_browser: bool
    fast_robot: bool


def run(settings: Settings, on_ready: Callable[[Site], None]) -> None:
    """Serve until Ctrl-C. Raises CaseError, FrameError, UnusableInputError."""
    workshop = Workshop()
    procedure = Procedure.open(settings.folder, settings.frame, settings.patient, workshop)
    pictures: list[Pictures] = []
    started: list[asyncio.Task] = []

    def page(site: Site) -> None:
        if not pictures:
            pictures.append(Pictures(site.images))
            started.append(asyncio.get_running_loop().create_task(procedure.start()))
        build(site, procedure, pictures[0], fast_robot=settings.fast_robot)

    try:
        serve(page, host=settings.host, port=settings.port, open_browser=settings.open_browser, on_ready=on_ready)
    finally:
        asyncio.run(procedure.drilling.close())
        workshop.close()
        procedure.case.close()
