"""The results of a study as a single HTML page, which needs no other file."""

from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from sightline import __version__
from sightline.studies.run import Result


def render(about: str, result: Result) -> str:
    """Return the page as HTML, in the report's style."""
    here, report = files("sightline.studies") / "templates", files("sightline.case.report") / "templates"
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    css = (report / "report.css").read_text("utf-8") + (here / "study.css").read_text("utf-8")
    page = environment.from_string((here / "study.html.j2").read_text("utf-8"))
    head, summary = result.head, result.summary
    return page.render(
        version=__version__,
        css=Markup(css),  # noqa: S704 - files of this package
        name=head["study"],
        about=about,
        trials=result.trials,
        seed=head["seed"],
        findings=summary.findings,
        tables=summary.tables,
        plots=[_plot(vars(one)) for one in summary.plots],
        provenance=[("code", f"Sightline {head['version']}, {head['code']}"), *head["configuration"].items()],
    )


def _plot(one: dict[str, Any]) -> dict[str, Any]:
    return {**one, "svg": Markup(one["svg"])}  # noqa: S704 - drawn by this package, its words escaped
