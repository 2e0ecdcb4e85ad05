"""Results as a single HTML page in the report's style, which needs no other file."""

from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from sightline import __version__
from sightline.studies.runs.run import Result


def page(template: str, *, plots: Any, **values: Any) -> str:
    """Return the page of a template of this room with its values; `plots`: their drawings are put in as they are."""
    here, report = files("sightline.studies.runs") / "templates", files("sightline.case.report") / "templates"
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    css = (report / "report.css").read_text("utf-8") + (here / "study.css").read_text("utf-8")
    return environment.from_string((here / template).read_text("utf-8")).render(
        version=__version__,
        css=Markup(css),  # noqa: S704 - files of this package
        plots=[{**vars(plot), "svg": Markup(plot.svg)} for plot in plots],  # noqa: S704 - drawn by this package
        **values,
    )


def render_study(about: str, result: Result) -> str:
    """Return the page of a study."""
    head, summary = result.head, result.summary
    return page(
        "study.html.j2",
        plots=summary.plots,
        name=head["study"],
        about=about,
        trials=result.trials,
        seed=head["seed"],
        findings=summary.findings,
        tables=summary.tables,
        provenance=[("code", f"Sightline {head['version']}, {head['code']}"), *head["configuration"].items()],
    )
