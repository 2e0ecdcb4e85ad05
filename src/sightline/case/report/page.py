"""The report of one plan as a single HTML page, which needs no other file and no network."""

from importlib.metadata import version
from importlib.resources import files
from platform import python_version

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from sightline import __version__
from sightline.case.report import figures, tables
from sightline.case.report.content import Report


def render(report: Report) -> str:
    """Return the page as HTML."""
    templates = files("sightline.case.report") / "templates"
    # Only the figures are trusted markup, made here; everything else is escaped.
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page = environment.from_string((templates / "report.html.j2").read_text("utf-8"))
    return page.render(
        version=__version__,
        css=Markup((templates / "report.css").read_text("utf-8")),  # noqa: S704 - a file of this package
        script=Markup((templates / "space.js").read_text("utf-8")),  # noqa: S704 - a file of this package
        title=report.title,
        provenance={**report.provenance, "software": _versions()}.items(),
        **tables.tables(report),
        **figures.figures(report),
    )


def _versions() -> str:
    others = (f"{name} {version(name)}" for name in ("numpy", "scipy", "numba", "opencv-python-headless"))
    return f"Sightline {__version__}, Python {python_version()}, {', '.join(others)}"
