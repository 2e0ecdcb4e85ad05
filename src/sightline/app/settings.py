"""How the app is run."""

from dataclasses import dataclass
from pathlib import Path

from sightline.app.session.rehearsing import Patient


@dataclass(frozen=True)
class Settings:
    """`folder`: of the case; `frame`: None for that of the case; `patient`: for a new case that rehearses; `live`: the
    source of a live image, as `sightline watch` names it; `fast_robot`: a simulated robot's time runs as fast as it
    computes. `token`: asked of every browser; made for addresses beyond this machine where none is given."""

    folder: Path
    frame: str | None
    patient: Patient | None
    live: str | None
    host: str
    port: int
    token: str | None
    open_browser: bool
    fast_robot: bool
