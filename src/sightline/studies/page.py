"""Results of a study, or of a comparison with real images, as one HTML page in the report's style."""

import base64
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import cv2
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from sightline import __version__
from sightline.case.report.radiographs import JPEG_QUALITY, grey
from sightline.imaging import Radiograph
from sightline.studies.compare import Pair, differences, findings, plots
from sightline.studies.run import Result

SHOWN_PX = 512  # side of an image on the page [ours]


def page(template: str, *, plots: Any, **values: Any) -> str:
    """Return the page of a template of this room with its values; `plots`: their drawings are put in as they are."""
    here, report = files("sightline.studies") / "templates", files("sightline.case.report") / "templates"
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


def render_comparison(pairs: Sequence[Pair], passed: Sequence[str], folder: str, seed: int) -> str:
    """Return the page as HTML, with the images scaled to SHOWN_PX."""
    return page(
        "compare.html.j2",
        plots=plots(pairs),
        folder=folder,
        seed=seed,
        passed=passed,
        findings=findings(pairs),
        images=[_shown(pair) for pair in pairs],
    )


def _shown(pair: Pair) -> dict[str, Any]:
    rows, reasons = [], dict[str, list[str]]()
    for name, real, twin, ratio in differences(pair):
        for measured, whose in ((real, "real"), (twin, "twin")):
            if measured.value is None:
                reasons.setdefault(measured.why_not, []).append(f"{name} ({whose})")
        if real.value is not None or twin.value is not None:
            span = pair.ranges.get(name)
            between = "" if span is None else f"{span[0]:.3g} to {span[1]:.3g}"
            cells = ["not measurable" if measured.value is None else str(measured) for measured in (real, twin)]
            rows.append((name, *cells, "" if ratio is None else f"{ratio:.2f}", between))
    return {
        "name": pair.name,
        "real": _data_uri(pair.real.image),
        "twin": _data_uri(pair.twin.image),
        "like": pair.like,
        "rows": rows,
        "not_measurable": list(reasons.items()),
    }


def _data_uri(image: Radiograph) -> str:
    shown = grey(image)
    scale = min(1.0, SHOWN_PX / max(shown.shape))
    small = cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode()
