"""`sightline study`: measure accuracy on the twin by many trials."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import (
    ImagesFrame,
    Invert,
    Method,
    Mirrored,
    Output,
    as_json,
    command,
    commands,
    frame_of_images,
)

if TYPE_CHECKING:
    from sightline.case.views import CalibratedImage
    from sightline.studies.assess import Assessment, MeasuredPoints
    from sightline.studies.runs.run import Result, StudyRun
    from sightline.studies.runs.study import Study

PRINTED = 2  # tables on the terminal; the page has all of them


@command(commands, "study", "sightline study table1 --trials 50")
def study(
    output: Output,
    *,
    name: Annotated[str, typer.Argument(help="Name of the study; a wrong name lists them all.")],
    trials: Annotated[int, typer.Option(min=1, help="Number of trials; more can be added later.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Trial k draws from default_rng([seed, k]).")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler; by default the cores of this machine.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for trials and results; by default out/study/NAME.")] = None,
) -> None:
    """Measure accuracy on the digital twin.

    An interrupted run continues where it stopped.
    """
    from sightline.studies.catalogue import study_called
    from sightline.studies.runs.run import StudyRun

    chosen = study_called(name)
    folder = out or Path("out/study") / name
    result = _do(output, StudyRun.open(chosen, trials, seed, folder), scheduler)
    files = _write(folder, chosen, result)
    for finding in result.summary.findings:
        output.say(f"- {finding}")
    for table in result.summary.tables[:PRINTED]:
        output.table(table.title, table.columns, table.rows)
    output.say(f"page: {files[0]}; values with their intervals: {files[1]}")
    output.result({**result.document(), "files": files})


def _do(output: Output, run: "StudyRun", scheduler: str | None) -> "Result":
    left = len(run.missing)
    if 0 < left < run.trials:
        output.note(f"{run.trials - left} trials were finished earlier; {left} remain")
    try:
        with output.progress(f"study {run.study.name}", left) as advance:
            run.do(scheduler, advance=advance)
    except KeyboardInterrupt:
        output.note(f"{len(run.record.finished)} finished trials are kept; run the same command to continue")
        raise
    return run.result()


def _write(folder: Path, chosen: "Study", result: "Result") -> list[Path]:
    from sightline.common.atomic import write_folder
    from sightline.studies.runs.page import render_study

    page = render_study(chosen.about, result)
    documents = {"report.html": page.encode(), "result.json": as_json(result.document()).encode()}
    return write_folder(folder / "report", documents)


@dataclass(frozen=True)
class PairOptions:
    """Both images, and how they are calibrated."""

    pa: Annotated[Path, typer.Argument(help="The PA image, or observations as CSV.")]
    lateral: Annotated[Path, typer.Argument(help="The lateral image, or observations as CSV (may be the same file).")]
    frame: ImagesFrame = None
    method: Method = "smooth"
    mirrored: Mirrored = None
    invert: Invert = False


@command(commands, "assess", "sightline assess pa.dcm lateral.dcm --truth points.csv")
def assess(
    output: Output,
    *,
    pair: PairOptions,
    truth: Annotated[
        Path,
        typer.Option(help="CSV of measured test points: name,x_mm,y_mm,z_mm and, if picked, four pixel coordinates."),
    ],
    pick_sd: Annotated[float, typer.Option(help="Standard deviation of the pixels in the table, px.")] = 0.5,
) -> None:
    """Reconstruct test points and compare them with measured ones.

    Exit code 3: the errors are larger than predicted.
    """
    from sightline.case.views import calibrate_pair, see_pair, view_document
    from sightline.studies.assess import assess as reconstruct_points
    from sightline.studies.assess import read_points

    frame, points = frame_of_images(output, pair.frame), read_points(truth)
    with output.step("finding and labelling the beads"):
        seen = see_pair(pair.pa, pair.lateral, frame, invert=pair.invert)
    with output.step(f"calibrating both views ({pair.method})"):
        images = calibrate_pair(seen, frame, pair.method, pair.mirrored or ())
    uv_px, covariance_px2 = _pixels(points, images, pick_sd)
    result = reconstruct_points([image.view for image in images], points, uv_px, covariance_px2)
    checks = (
        [check for image in images for check in image.view.checks]
        + list(result.checks)
        + list(result.points.frame_checks())
    )
    output.failures(checks)
    _show_assessment(output, result)
    output.result({**result.document(), "views": [view_document(image) for image in images]}, checks)


def _pixels(points: "MeasuredPoints", images: "tuple[CalibratedImage, CalibratedImage]", pick_sd: float) -> Any:
    """Return pixels (2, N, 2) and covariances (2, N, 2, 2): of the table, else of the test balls in the images."""
    import numpy as np

    from sightline.errors import UnusableInputError
    from sightline.planning import Pick
    from sightline.studies.assess import find_balls

    if points.uv_px is not None:
        covariance = Pick.free((0.0, 0.0), pick_sd).covariance_px2
        return points.uv_px, np.broadcast_to(covariance, (*points.uv_px.shape, 2))
    found_balls = []
    for image in images:
        if image.seen.beads is None:
            raise UnusableInputError(
                f"the CSV file of the {image.name} view holds the frame's beads, not the test points; "
                "give the test points' pixels in --truth, or give the images themselves"
            )
        found_balls.append(find_balls(image.view, image.seen.beads, image.seen.observations, points))
    uv_px, covariance_px2 = zip(*found_balls, strict=True)
    return np.array(uv_px), np.array(covariance_px2)


def _show_assessment(output: Output, result: "Assessment") -> None:
    rows = [
        (
            p["name"],
            *(f"{v:.2f}" for v in p["reconstructed_mm"]),
            *_shown(p["error_mm"], p["predicted_95_mm"], p["normalised"]),
        )
        for p in result.document()["points"]
    ]
    columns = ("point", "x", "y", "z", "error", "predicted 95 %", "normalised")
    output.table("Test points in CFCS, mm", columns, rows)
    table = [(s.what, s.unit, s.number, *_shown(s.mean, s.sd, s.largest)) for s in result.table()]
    output.table("After ASTM F2554", ("error of", "unit", "number", "mean", "s.d.", "largest"), table)


def _shown(*figures: float | None) -> list[str | None]:
    return [None if figure is None else f"{figure:.3f}" for figure in figures]


@command(commands, "compare", "sightline compare images --out out/compare")
def compare(
    output: Output,
    *,
    folder: Annotated[Path, typer.Argument(help="Folder of images of one C-arm: plates, beads, open beam, anatomy.")],
    seed: Annotated[int, typer.Option(min=0, help="The twin of image k draws from the generator of [seed, k].")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for the page and the plots.")] = Path("out/compare"),
    invert: Invert = False,
) -> None:
    """Compare real images with the digital twin's.

    Both are measured in the same way; the page says by how much they differ.
    """
    import numpy as np

    from sightline.common.atomic import write_folder
    from sightline.studies.comparison.compare import compare as compare_pair
    from sightline.studies.comparison.compare import document, findings, plots, read_folder, render_comparison

    images, passed = read_folder(folder, invert=invert)
    for reason in passed:
        output.note(f"skipped: {reason}")
    pairs = []
    with output.progress("images and their twins", len(images)) as advance:
        for k, (name, image) in enumerate(images):
            pairs.append(compare_pair(name, image, np.random.default_rng([seed, k])))
            advance()
    figures = document(pairs, passed, seed)
    page = render_comparison(pairs, passed, folder.name, seed)
    curves = {f"{picture.title.lower().replace(' ', '-')}.svg": picture.svg.encode() for picture in plots(pairs)}
    files = write_folder(out, {"compare.html": page.encode(), "compare.json": as_json(figures).encode(), **curves})
    for finding in findings(pairs):
        output.say(f"- {finding}")
    output.say(f"page: {files[0]}; all values: {files[1]}")
    output.result({**figures, "files": files})
