"""The content of a report, before it is rendered."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sightline.calibration import BeadView
from sightline.case.report.comparison import Compared, Refused, Truth
from sightline.case.report.drilled import Drilled
from sightline.case.report.exposures import KeptExposure
from sightline.case.views import CalibratedImage, spoken
from sightline.frame import Frame
from sightline.planning import Plan, WirePlans
from sightline.planning.check.result import CheckShot


@dataclass(frozen=True, eq=False)
class Report:
    """The content of the report of one plan.

    `images`: PA, lateral and any third, with the views that `plan` was made on. `localized`: both views calibrated with
    the paper's method, for its triangles. `compared`, `truth`: only if the truth is known. `drilled`: once a robot has
    carried out the plan. `exposures`: the known exposures of the procedure. `provenance`: how to reproduce the report,
    in words. `wires`: the plans of all wires of the procedure, where `plan` is one of several; `measured`: the check
    shots of these wires, by key.
    """

    title: str
    frame: Frame
    images: tuple[CalibratedImage, ...]
    plan: Plan
    exposures: Sequence[KeptExposure]
    provenance: dict[str, str]
    localized: tuple[BeadView, BeadView] | None = None
    truth: Truth | None = None
    compared: Sequence[Compared | Refused] = field(default=())
    drilled: Drilled | None = None
    wires: WirePlans | None = None
    measured: Mapping[str, CheckShot] = field(default_factory=dict)

    def spoken(self, view: str) -> str:
        """Return a view's name as the procedure has it."""
        return spoken(view, self.plan.kind)
