"""The report as PDF, for printing and archives: verdict, wire, images, error budget, all checks. A4, no metadata."""

import textwrap
from collections.abc import Iterable, Sequence
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from sightline import __version__
from sightline.case.report.content import Report
from sightline.case.report.drawing.radiographs import grey
from sightline.case.report.tables import bars, tables
from sightline.case.views import NAMES, CalibratedImage

_A4_IN = (8.27, 11.69)
_LEFT, _RIGHT, _TOP, _LINE = 0.09, 0.91, 0.95, 0.0165  # fractions of the page
_WRAP = 104  # characters per line of text
_CHECKS_A_PAGE, _EXPOSURES_A_PAGE = 17, 45
_GOOD, _BAD, _INK, _MUTED, _RULE = "#1b7f4d", "#b3261e", "#1d2733", "#5b6875", "#c9d1d9"
_WIRE, _CURVE, _BEAD = "#ffb000", "#4cc9f0", "#7ae582"
_SOURCES = ("#4c6ef5", "#12a5a5", "#e8961e", "#8a63d2", "#8c99a6")  # the page's colours, in the order of the budget


def render_pdf(report: Report) -> bytes:
    """Return the report as PDF; equal reports give equal bytes."""
    buffer = BytesIO()
    with PdfPages(buffer, metadata={"CreationDate": None, "Producer": None, "Creator": None}) as pdf:
        for page in draw(report):
            pdf.savefig(page)
    return buffer.getvalue()


def draw(report: Report) -> list[Figure]:
    """Return the pages as figures."""
    context = tables(report)
    pages = [_first(report, context), _images(report), *_checks(report), *_exposures(context)]
    for number, page in enumerate(pages, 1):
        foot = f"{report.title} · Sightline {__version__} · research software, not a medical device"
        _say(page, foot, _LEFT, 0.035, size=7, colour=_MUTED)
        _say(page, f"{number} of {len(pages)}", _RIGHT, 0.035, size=7, colour=_MUTED, align="right")
    return pages


def _first(report: Report, context: dict[str, Any]) -> Figure:
    page, y = Figure(figsize=_A4_IN), _TOP
    _say(page, report.title, _LEFT, y, size=17, weight="bold")
    y = _lines(page, [context["subtitle"]], y - 1.6 * _LINE, colour=_MUTED)
    verdict = context["verdict"]
    colour = {"go": _GOOD, "no-go": _BAD, "incomplete": _INK}[verdict["state"]]
    _say(page, verdict["word"], _LEFT, y - 1.3 * _LINE, size=22, weight="bold", colour=colour)
    beside = _LEFT + (0.30 if verdict["state"] == "incomplete" else 0.17)
    _say(page, verdict["sentence"], beside, y - 1.3 * _LINE, size=10, colour=colour)
    y -= 3.5 * _LINE
    reasons = [f"{reason['name']}: {reason['sentence']}" for reason in verdict["reasons"][:4]]
    y = _lines(page, reasons, y, bullet="– ") - 0.5 * _LINE
    for k, tile in enumerate(context["tiles"]):
        x = _LEFT + k * (_RIGHT - _LEFT) / len(context["tiles"])
        _say(page, tile["name"], x, y, size=7.5, colour=_MUTED)
        _say(page, tile["value"], x, y - 1.5 * _LINE, size=14, weight="bold")
        _say(page, tile["note"], x, y - 2.7 * _LINE, size=7.5, colour=_MUTED)
    y = _heading(page, "Points, CFCS", y - 4.6 * _LINE)
    rows: list[tuple[str, ...]] = [("", "x mm", "y mm", "z mm", "gap mm", "picked")]
    for point in context["points"]:
        rows.append(
            (point["name"], *(_number(*one) for one in point["xyz"]), point["gap"], point["how"].split(" to ")[0])
        )
    y = _table(page, rows, (0.0, 0.13, 0.27, 0.41, 0.55, 0.68), y)
    if bars(report):
        y = _heading(page, "Where the error comes from: shares of the variance", y - _LINE)
        _budget(page.add_axes((_LEFT + 0.09, y - 0.13, _RIGHT - _LEFT - 0.2, 0.125)), report)
        y -= 0.165
    if context["drilled"]:
        y = _drilled(page, context["drilled"], y - 0.5 * _LINE)
    y = _heading(page, "How it was made", y - 0.5 * _LINE)
    _lines(page, [*(f"{name}: {value}" for name, value in report.provenance.items()), *context["notes"]], y)
    return page


def _drilled(page: Figure, section: dict[str, Any], y: float) -> float:
    y = _heading(page, "The drilled wire", y)
    if section["rows"]:
        rows = [("", "entry mm", "tip mm", "direction °"), *section["rows"]]
        y = _table(page, rows, (0.0, 0.55, 0.66, 0.75), y)
    return _lines(page, [section["check"]], y)


def _images(report: Report) -> Figure:
    page = Figure(figsize=_A4_IN)
    height = (_RIGHT - _LEFT) * _A4_IN[0] / _A4_IN[1] * 0.64 * min(1.0, 2 / len(report.images))
    for k, image in enumerate(report.images):
        top = _TOP - k * (height + 0.065)
        _say(
            page,
            f"{report.spoken(image.name)} image".capitalize() if k else f"{report.spoken(image.name)} image",
            _LEFT,
            top,
            12,
        )
        axes = page.add_axes((_LEFT, top - height - 0.02, _RIGHT - _LEFT, height))
        _image(axes, report, image, k)
    caption = (
        "Rings: beads that the calibration used. Line with dots: the planned wire from entry (large dot) to tip. "
        "Thin lines: image-matching curves of the two points."
    )
    _lines(page, [caption], _TOP - len(report.images) * (height + 0.065), colour=_MUTED)
    return page


def _image(axes: Axes, report: Report, image: CalibratedImage, k: int) -> None:
    seen = image.seen
    residuals = image.view.residuals
    beads = np.asarray(residuals.uv_px)[np.asarray(residuals.used, dtype=bool)]
    if seen.image is not None:
        axes.imshow(grey(seen.image), cmap="gray", interpolation="bilinear")
    axes.scatter(*beads.T, s=16, facecolors="none", edgecolors=_BEAD, linewidths=0.6)
    if k == NAMES.index("lateral"):
        for curve in (report.plan.entry_curve, report.plan.end_curve):
            axes.plot(*curve.uv_px.T, color=_CURVE, linewidth=0.7)
    wire = np.array([point[k].uv_px for point in report.plan.picks])
    if np.isnan(wire).any():  # not picked in this image
        wire = image.view.project(report.plan.trajectory.points.xyz_mm)
    axes.plot(*wire.T, color=_WIRE, linewidth=1.4)
    axes.scatter(*wire.T, s=(34, 12), color=_WIRE, zorder=3)
    if seen.image is None:
        axes.invert_yaxis()
    else:
        rows, columns = seen.image.shape
        axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
    axes.set(aspect="equal", xticks=[], yticks=[])
    for side in axes.spines.values():
        side.set_color(_RULE)


def _budget(axes: Axes, report: Report) -> None:
    rows = bars(report)
    for row, bar in enumerate(rows):
        start = 0.0
        for colour, (source, rms) in zip(_SOURCES, bar.rms.items(), strict=True):
            share = (rms / bar.total) ** 2
            label = source.replace("_", " ") if row == 0 else None
            axes.barh(-row, share, left=start, height=0.62, color=colour, label=label)
            if share > 0.07:
                axes.text(start + share / 2, -row, f"{share:.0%}", color="white", size=7.5, ha="center", va="center")
            start += share
        axes.text(1.01, -row, f"{bar.total:.2f}{bar.gap}{bar.unit} rms", size=8, va="center", color=_INK)
    axes.set(xlim=(0, 1), ylim=(-len(rows) + 0.45, 0.55), xticks=[])
    axes.set_yticks([-k for k in range(len(rows))], [bar.name for bar in rows], size=8)
    axes.tick_params(length=0)
    axes.set_frame_on(False)
    axes.legend(ncols=len(_SOURCES), loc="upper left", bbox_to_anchor=(-0.01, 0.06), frameon=False, fontsize=7.5)


def _checks(report: Report) -> Iterable[Figure]:
    checks = report.plan.verdict.checks
    for first in range(0, len(checks), _CHECKS_A_PAGE):
        page = Figure(figsize=_A4_IN)
        y = _heading(page, "Checks" if first == 0 else "Checks, continued", _TOP)
        for check in checks[first : first + _CHECKS_A_PAGE]:
            word, colour = ("pass", _GOOD) if check.passed else ("FAIL", _BAD)
            value = "not measured" if check.figure is None else f"{check.figure:.4g} {check.unit}".strip()
            limit = "" if check.limit is None else f", limit {check.limit:.4g} {check.unit}".rstrip()
            _say(page, word, _LEFT, y, size=8.5, weight="bold", colour=colour)
            _say(page, check.name, _LEFT + 0.07, y, size=8.5, weight="bold")
            _say(page, value + limit, _RIGHT, y, size=8.5, align="right", colour=_MUTED)
            y = _lines(page, [check.sentence], y - _LINE, indent=0.07) - 0.35 * _LINE
        yield page


def _exposures(context: dict[str, Any]) -> Iterable[Figure]:
    exposures = context["exposures"]
    for first in range(0, len(exposures), _EXPOSURES_A_PAGE):
        page = Figure(figsize=_A4_IN)
        y = _heading(page, "Exposures" if first == 0 else "Exposures, continued", _TOP)
        y = _lines(page, [context["exposures_note"]], y, colour=_MUTED) - 0.5 * _LINE
        rows: list[tuple[str, ...]] = [("image", "kept (UTC)", "used for", "frames")]
        for one in exposures[first : first + _EXPOSURES_A_PAGE]:
            rows.append((one.image, one.at or "not known", one.used, str(one.frames)))
        _table(page, rows, (0.0, 0.2, 0.42, 0.72), y)
        yield page


def _say(
    page: Figure,
    text: str,
    x: float,
    y: float,
    size: float = 8.5,
    *,
    weight: str = "normal",
    colour: str = _INK,
    align: str = "left",
) -> None:
    # Matplotlib would read a dollar sign as the start of a formula.
    page.text(x, y, text.replace("$", r"\$"), size=size, weight=weight, color=colour, ha=align, va="baseline")


def _lines(
    page: Figure, texts: Sequence[str], y: float, *, colour: str = _INK, bullet: str = "", indent: float = 0.0
) -> float:
    """Draw wrapped paragraphs and return the height of the next line."""
    for text in texts:
        for line in textwrap.wrap(
            bullet + text, int(_WRAP * (1.0 - 1.1 * indent)), subsequent_indent=" " * len(bullet)
        ):
            _say(page, line, _LEFT + indent, y, colour=colour)
            y -= 0.86 * _LINE
        y -= 0.2 * _LINE
    return y


def _heading(page: Figure, text: str, y: float) -> float:
    _say(page, text, _LEFT, y, size=11, weight="bold")
    return y - 1.6 * _LINE


def _table(page: Figure, rows: Sequence[Sequence[str]], columns: Sequence[float], y: float) -> float:
    for k, row in enumerate(rows):
        for at, cell in zip(columns, row, strict=True):
            _say(page, cell, _LEFT + at, y, size=8, colour=_MUTED if k == 0 else _INK)
        y -= 1.05 * _LINE
    return y


def _number(value: float, sd: float | None) -> str:
    return f"{value:.2f}" if sd is None else f"{value:.2f} ± {sd:.2f}"
