"""The report of one plan as a single HTML page with its figures, which needs no other file and no network."""

from collections.abc import Iterable, Iterator
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from platform import python_version
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from sightline import __version__
from sightline.calibration.maps.localized import LocalizedMap
from sightline.case.report import radiographs, scene, tables
from sightline.case.report.charts import budget
from sightline.case.report.content import Report, report_of_plan
from sightline.case.report.tables import POINTS, bars, budget_rows
from sightline.case.views import CalibratedImage
from sightline.common.atomic import write_whole
from sightline.common.geometry.lines import unit
from sightline.errors import UnusableInputError
from sightline.imaging import Radiograph
from sightline.planning import Pick, Plan


def render(report: Report) -> str:
    """Return the page as HTML."""
    templates = files("sightline.case.report") / "templates"
    # Only the figures are trusted markup, made here; everything else is escaped.
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page = environment.from_string((templates / "report.html.j2").read_text("utf-8"))
    return page.render(
        version=__version__,
        css=Markup((templates / "report.css").read_text("utf-8")),  # noqa: S704 - a file of this package
        script=Markup((templates / "report.js").read_text("utf-8")),  # noqa: S704 - a file of this package
        title=report.title,
        provenance={**report.provenance, "software": _versions()}.items(),
        **tables.tables(report),
        **figures(report),
    )


def report(plan: Plan, path: str | Path) -> Path:
    """Write the report of a plan, one HTML page that needs no other file, and return its path.

    It shows the verdict, the wire in the images, the errors with their sources, the beads and all checks. A plan from
    `load` has no images. Of several wires give each of `WirePlans.plans`.
    Raises UnusableInputError for other objects, for a plan on a matrix's view, and where `path` cannot be written.

    >>> pa, lateral = sl.load("out/demo/views.json")
    >>> plan = sl.plan([pa, lateral], [[162, 689], [684, 692]], [[818, 366], [378, 276]], side="right")
    >>> sl.report(plan, "report.html").name
    'report.html'
    """
    if not isinstance(plan, Plan):
        raise UnusableInputError(f"a report is of a Plan, not of a {type(plan).__name__}; give a Plan")
    return write_whole(path, render(report_of_plan(plan)).encode())


def _versions() -> str:
    others = (f"{name} {version(name)}" for name in ("numpy", "scipy", "numba", "opencv-python-headless"))
    return f"Sightline {__version__}, Python {python_version()}, {', '.join(others)}"


TICK_MM = 10  # depth between ticks of an image-matching curve, as planning samples it
BEYOND_MM = 40.0  # the close-up shows lines of sight this far to both sides of the wire
RAMP_STEPS = 8


def _markup(svg_text: str) -> Markup:
    return Markup(svg_text)  # noqa: S704 - made by svg.py, which escapes


def figures(report: Report) -> dict[str, Any]:
    """Return the part of the template context that is drawn."""
    shown = {image.name: image.seen.image for image in report.images if image.seen.image is not None}
    return {
        "sources": _markup(radiographs.sources(shown)),
        "plan_figures": _plan_figures(report),
        "near_figures": _near_figures(report),
        "tick_mm": TICK_MM,
        "budget": _budget(report),
        "space": _space(report),
        **_bead_figures(report),
    }


def _figure(drawing: str, words: str) -> dict[str, Any]:
    return {"svg": _markup(drawing), "caption": f"{words[0].upper()}{words[1:]}."}


def _shown(report: Report) -> Iterator[tuple[int, CalibratedImage, Radiograph]]:
    """Yield the images that have pixels, with their places in the report."""
    yield from ((k, image, pixels) for k, image in enumerate(report.images) if (pixels := image.seen.image) is not None)


def _plan_figures(report: Report) -> list[dict[str, Any]]:
    """Draw the wire in all images, and the image-matching curves in the lateral one."""
    drawn = []
    for k, image, pixels in _shown(report):
        words = f"{report.spoken(image.name)} image with the planned wire and its picks"
        if report.plan.hole is not None:
            words += ", and the nail with both rims and the axis of each hole as measured"
        elif k == 1:
            words += ", and the image-matching curves of entry and tip with their uncertainty bands"
        words += ", and the landmarks, each with a line to its projection" if k == 2 else ""
        drawn.append(_figure(radiographs.radiograph(pixels, image.name, _plan_marks(report, k), words), words))
    return drawn


def _plan_marks(report: Report, k: int) -> list[str]:
    """Return the marks of the plan in image `k`."""
    curves = (report.plan.entry_curve, report.plan.end_curve)
    plans = [report.plan] if report.wires is None else report.wires.plans.values()
    holes = [hole for plan in plans if (hole := plan.hole) is not None]
    marks = [radiographs.nail_hole(report.images[k].view, hole) for hole in holes]
    if k == 1 and report.plan.hole is None:
        marks += [radiographs.curve(curve, name) for curve, name in zip(curves, POINTS, strict=True)]
    marks.append(radiographs.wire(report.images[k].view, report.plan.trajectory))
    if report.truth is not None:
        marks.append(radiographs.truth(report.truth.uv_px[k]))
    if k == 2:
        marks.append(radiographs.landmarks(report.plan, k))
    return marks + [radiographs.pick(pair[k], name) for pair, name in _picked(report, k)]


def _picked(report: Report, k: int) -> list[tuple[tuple[Pick, ...], str]]:
    """Return the picks of entry and tip with their names, of those that image `k` shows."""
    named = zip(report.plan.picks, POINTS, strict=True)
    return [(picks, name) for picks, name in named if np.isfinite(picks[k].uv_px).all()]


def _near_figures(report: Report) -> list[dict[str, Any]]:
    """Draw close-ups of entry and tip in each image."""
    drawn = []
    for k, image, _ in _shown(report):
        for pair, name in _picked(report, k):
            words = f"{report.spoken(image.name)} image around the {name}"
            closeup = radiographs.closeup(image.name, pair[k].uv_px, _plan_marks(report, k), words)
            drawn.append(_figure(closeup, words))
    return drawn


def _budget(report: Report) -> dict[str, Any] | None:
    rows = bars(report)
    if not rows:
        return None
    words = "; ".join(
        f"{bar.name}: " + ", ".join(f"{source.replace('_', ' ')} {v:.3f} {bar.unit}" for source, v in bar.rms.items())
        for bar in rows
    )
    headings = [f"{bar.name}, {bar.unit} rms" for bar in rows]
    return {"svg": _markup(budget(rows, f"Error budget. {words}")), "points": headings, "rows": budget_rows(report)}


def _radii(image: CalibratedImage, uv_px: np.ndarray) -> np.ndarray:
    """Return the radii (N,) of the nearest detections."""
    beads = image.seen.beads or image.seen.observations
    assert beads.radius_px is not None  # noqa: S101 - only images are shown
    return beads.radius_px[np.linalg.norm(uv_px[:, None] - beads.uv_px, axis=2).argmin(axis=1)]


def _bead_figures(report: Report) -> dict[str, Any]:
    """Draw the beads coloured by residual, and the triangles of the localized method."""
    shown = [image for _, image, _ in _shown(report)]
    if not shown:
        return {"bead_figures": [], "triangle_figures": [], "ramp": [], "top_mm": 0.0}
    residuals_mm = np.concatenate([image.view.residuals.residual_mm for image in shown])
    top = max(float(np.quantile(np.linalg.norm(residuals_mm, axis=1), 0.95)), 1e-3)
    return {
        "bead_figures": [_beads_of(report, image, top) for image in shown],
        "triangle_figures": _triangles(report),
        "ramp": radiographs.colour_map(np.linspace(0.0, top, RAMP_STEPS), top),
        "top_mm": top,
    }


def _beads_of(report: Report, image: CalibratedImage, top_mm: float) -> dict[str, Any]:
    beads = image.seen.beads or image.seen.observations
    assert image.seen.image is not None  # noqa: S101 - only images are shown
    # Without candidates at a bead that was found with another size
    refused = [
        c for c in beads.rejected or () if (np.linalg.norm(beads.uv_px - c.uv_px, axis=1) > beads.radius_px).all()
    ]
    residuals = image.view.residuals
    words = (
        f"{report.spoken(image.name)} image: {len(residuals.ids)} beads labelled, residual {residuals.rms_mm:.3f} mm "
        f"rms per axis, {np.count_nonzero(~residuals.used)} left out of the fit, {len(refused)} other candidates "
        "rejected"
    )
    drawn = radiographs.beads(residuals, _radii(image, residuals.uv_px), top_mm)
    marks = [radiographs.rejected(refused), drawn]
    return _figure(radiographs.radiograph(image.seen.image, image.name, marks, words), words)


def _space(report: Report) -> dict[str, Any]:
    """Draw the whole set-up, and the wire in close-up."""
    points = report.plan.trajectory.points
    known = report.plan.trajectory.error_stated
    whole, near = list(_whole(report)), list(_near(report))
    note = ""
    if known:
        times = scene.magnification(points.covariance_mm2, scene.NEAR_MM)
        ellipsoids = [
            scene.ellipsoid(p, c, times, "95 % ellipsoid")
            for p, c in zip(points.xyz_mm, points.covariance_mm2, strict=True)
        ]
        near += [shape for shapes in ellipsoids for shape in shapes]
        note = f"In the close-up the 95 % ellipsoids are magnified {times:g} times."
    words = "The calibration plates, both focal points with the lines of sight of entry and tip, and the wire, in space"
    return {
        "svg": _markup(scene.space(whole, words)),
        "near": _markup(scene.space(near, "The wire in close-up, with the lines of sight and the 95 % ellipsoids")),
        "note": note,
        "ellipsoids": known,
    }


def _wire(report: Report) -> scene.Shape:
    entry, tip = report.plan.trajectory.points.xyz_mm
    return scene.line(entry, tip, "wire", "planned wire")


def _whole(report: Report) -> Iterable[scene.Shape]:
    if report.frame.solid is not None:
        yield from scene.beads(report.frame.solid.xyz_mm, "xrii")
    for image in report.images:
        if report.frame.solid is None:
            plates = report.frame.view(image.name)
            yield from scene.plate(plates.xrii.xyz_mm, "xrii", f"{report.spoken(image.name)} XRII plate")
            yield from scene.plate(plates.source.xyz_mm, "source", f"{report.spoken(image.name)} source plate")
        focal = image.view.focal_point_mm
        yield scene.dot(focal, "focal", 6.0, f"{report.spoken(image.name)} focal point")
        yield scene.label(focal, f"{report.spoken(image.name)} focal point")
        for line in _lines(report, image):
            yield scene.line(focal, line, "sight")
    yield _wire(report)


def _near(report: Report) -> Iterable[scene.Shape]:
    for image in report.images:
        focal, k = image.view.focal_point_mm, report.images.index(image)
        shown = [np.isfinite(picks[k].uv_px).all() for picks in report.plan.picks]
        for on_plate, point in zip(_lines(report, image), report.plan.trajectory.points.xyz_mm[shown], strict=True):
            along = unit(on_plate - focal)
            nearest = focal + ((point - focal) @ along) * along
            yield scene.line(
                nearest - BEYOND_MM * along,
                nearest + BEYOND_MM * along,
                "sight",
                f"{report.spoken(image.name)} line of sight",
            )
    yield _wire(report)
    for name, point in zip(POINTS, report.plan.trajectory.points.xyz_mm, strict=True):
        yield scene.label(point, name)


def _lines(report: Report, image: CalibratedImage) -> np.ndarray:
    """Return the points (2, 3) at which the lines of sight of entry and tip meet the view's reference plane."""
    k = report.images.index(image)
    uv = np.array([pair[k].uv_px for pair, _ in _picked(report, k)]).reshape(-1, 2)
    return image.view.lines_of_sight(uv).points_mm


def _triangles(report: Report) -> list[dict[str, Any]]:
    """Draw the triangles of the localized method; those around the picks are filled."""
    if report.localized is None:
        return []
    drawn = []
    for k, (image, view) in enumerate(zip(report.images, report.localized, strict=True)):
        net = view.plane_map
        if image.seen.image is None or not isinstance(net, LocalizedMap):
            continue
        uv = np.array([pair[k].uv_px for pair in report.plan.picks])
        around = net.containing_triangle(uv)
        bounding = net.controls_px[net.triangulation.simplices[around[around >= 0]]]
        marks = [radiographs.triangles(net.triangles_px, bounding)]
        marks += [radiographs.pick(pair[k], name) for pair, name in zip(report.plan.picks, POINTS, strict=True)]
        name = report.spoken(image.name)
        words = f"{name} image: the triangles of the XRII plate; those that bound entry and tip are filled"
        drawn.append(_figure(radiographs.radiograph(image.seen.image, image.name, marks, words), words))
    return drawn
