"""What the report of one plan is made from."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from sightline.calibration import BeadView
from sightline.case.report.comparison import Compared, Refused, Truth
from sightline.case.report.drilled import Drilled
from sightline.case.report.exposures import Exposure
from sightline.case.views import CalibratedImage
from sightline.frame import Frame
from sightline.planning import Plan


@dataclass(frozen=True, eq=False)
class Report:
    """What a report is made from. `images`: PA and lateral, with the views that `plan` was made on.

    `localized`: both views calibrated with the paper's method, for its triangles. `compared` and `truth`: only
    where the truth is known. `drilled`: once a robot has carried the plan out. `exposures`: those of the procedure that
    are known. `provenance`: what a reader needs to make the same report again, in words.
    """

    title: str
    frame: Frame
    images: tuple[CalibratedImage, CalibratedImage]
    plan: Plan
    exposures: Sequence[Exposure]
    provenance: dict[str, str]
    localized: tuple[BeadView, BeadView] | None = None
    truth: Truth | None = None
    compared: Sequence[Compared | Refused] = field(default=())
    drilled: Drilled | None = None
