"""The report of one plan: a single page that needs no other file and asks nothing of a network."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from importlib.resources import files
from platform import python_version

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from sightline import __version__
from sightline.calibration import BeadView
from sightline.case import report_pictures, report_tables
from sightline.case.comparison import Compared, Refused, Truth
from sightline.case.drilled import Drilled
from sightline.case.exposures import Exposure
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


def render(report: Report) -> str:
    """The page as HTML."""
    templates = files("sightline.case") / "templates"
    # Pictures are markup of our own making; everything else is escaped.
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page = environment.from_string((templates / "report.html.j2").read_text("utf-8"))
    return page.render(
        version=__version__,
        css=Markup((templates / "report.css").read_text("utf-8")),  # noqa: S704 - a file of this package
        script=Markup((templates / "space.js").read_text("utf-8")),  # noqa: S704 - a file of this package
        title=report.title,
        provenance={**report.provenance, "software": _versions()}.items(),
        **report_tables.tables(report),
        **report_pictures.pictures(report),
    )


def _versions() -> str:
    others = (f"{name} {version(name)}" for name in ("numpy", "scipy", "numba", "opencv-python-headless"))
    return f"Sightline {__version__}, Python {python_version()}, {', '.join(others)}"
