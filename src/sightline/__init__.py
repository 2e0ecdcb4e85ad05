"""Two ordinary C-arm images of a bead frame become a planned guide-wire trajectory with its error bound."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from sightline.calibration import CalibratedView as CalibratedView
    from sightline.calibration import CArm as CArm
    from sightline.calibration import calibrate as calibrate
    from sightline.calibration import fit_map as fit_map
    from sightline.calibration import view_from_matrix as view_from_matrix
    from sightline.calibration.exchange.formats import read_view as read_view
    from sightline.detection import Detections as Detections
    from sightline.detection import Observations as Observations
    from sightline.detection import detect as detect
    from sightline.detection import label as label
    from sightline.detection import look_again as look_again
    from sightline.errors import SightlineError as SightlineError
    from sightline.frame import Frame as Frame
    from sightline.from_images.pipeline import calibrate_image as calibrate_image
    from sightline.from_images.pipeline import check_shot as check_shot
    from sightline.from_images.registration.register import register_bone as register_bone
    from sightline.from_images.registration.render import render as render
    from sightline.from_images.registration.result import BonePose as BonePose
    from sightline.imaging import Radiograph as Radiograph
    from sightline.imaging import read_image as read_image
    from sightline.planning import Aids as Aids
    from sightline.planning import Circle as Circle
    from sightline.planning import Line as Line
    from sightline.planning import Plan as Plan
    from sightline.planning import SpacePoints as SpacePoints
    from sightline.planning import Trajectory as Trajectory
    from sightline.planning import plan as plan
    from sightline.planning import reconstruct as reconstruct
    from sightline.planning.check.result import CheckShot as CheckShot
    from sightline.planning.check.shot import Landmarks as Landmarks

    # Declared, not imported: rooms below `case.saved` take `__version__` from here, and must not reach up to it.
    load: Callable[..., Any]
    report: Callable[[Plan, str | Path], Path]
    save: Callable[[Any, str | Path], Path]

__version__ = "0.1.0"

# The promised face, imported on first use: `sightline --help` must not wait for numba.
_HOMES = {
    "CArm": "calibration",
    "CalibratedView": "calibration",
    "Detections": "detection",
    "Frame": "frame",
    "Observations": "detection",
    "Radiograph": "imaging",
    "SightlineError": "errors",
    "SpacePoints": "planning",
    "Trajectory": "planning",
    "Aids": "planning",
    "BonePose": "from_images.registration.result",
    "Circle": "planning",
    "Line": "planning",
    "Plan": "planning",
    "calibrate": "calibration",
    "CheckShot": "planning.check.result",
    "Landmarks": "planning.check.shot",
    "calibrate_image": "from_images.pipeline",
    "check_shot": "from_images.pipeline",
    "detect": "detection",
    "fit_map": "calibration",
    "label": "detection",
    "load": "case.saved",
    "look_again": "detection",
    "read_image": "imaging",
    "read_view": "calibration.exchange.formats",
    "plan": "planning",
    "reconstruct": "planning",
    "register_bone": "from_images.registration.register",
    "render": "from_images.registration.render",
    "report": "case.report.page",
    "save": "case.saved",
    "view_from_matrix": "calibration",
}
__all__ = [  # noqa: RUF022 - the order a reader meets them in
    "read_image",
    "detect",
    "Frame",
    "label",
    "look_again",
    "calibrate",
    "calibrate_image",
    "reconstruct",
    "plan",
    "check_shot",
    "fit_map",
    "view_from_matrix",
    "read_view",
    "render",
    "register_bone",
    "report",
    "save",
    "load",
    "Radiograph",
    "Detections",
    "Observations",
    "CalibratedView",
    "CArm",
    "SpacePoints",
    "Trajectory",
    "Plan",
    "CheckShot",
    "Landmarks",
    "BonePose",
    "Aids",
    "Circle",
    "Line",
    "SightlineError",
    "__version__",
]

# Rooms that pages name, imported on first use as well.
_ROOMS = (
    "calibration",
    "case",
    "detection",
    "errors",
    "frame",
    "from_images",
    "geometry",
    "imaging",
    "planning",
    "rehearsal",
    "robot",
    "studies",
    "twin",
)


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return import_module(f"sightline.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'sightline' has no attribute {name!r}")
    return getattr(import_module(f"sightline.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*__all__, *_ROOMS})
