"""Settings of one run of the app."""

from dataclasses import dataclass
from pathlib import Path

from sightline.app.session.rehearsing import Patient


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
