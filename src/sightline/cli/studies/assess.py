"""`sightline assess`: the paper's Table 1 measured on your own C-arm."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.options import FrameName, Invert, Method, Mirrored, command, commands
from sightline.cli.output import Output

if TYPE_CHECKING:
    from sightline.case.views import CalibratedImage
    from sightline.studies.assess import Assessment, MeasuredPoints


@dataclass(frozen=True)
class PairOptions:
    """Both images, and how they are calibrated."""

    pa: Annotated[Path, typer.Argument(help="The PA image, or observations as CSV.")]
    lateral: Annotated[Path, typer.Argument(help="The lateral image, or observations as CSV (may be the same file).")]
    frame: FrameName = "gamma"
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
    from sightline.frame import Frame
    from sightline.studies.assess import assess as compare
    from sightline.studies.assess import read_points

    frame, points = Frame.load(pair.frame), read_points(truth)
    with output.step("finding and labelling the beads"):
        seen = see_pair(pair.pa, pair.lateral, frame, invert=pair.invert)
    with output.step(f"calibrating both views ({pair.method})"):
        images = calibrate_pair(seen, frame, pair.method, pair.mirrored or ())
    uv_px, covariance_px2 = _pixels(points, images, pick_sd)
    result = compare([image.view for image in images], points, uv_px, covariance_px2)
    checks = (
        [check for image in images for check in image.view.checks]
        + list(result.checks)
        + list(result.points.frame_checks())
    )
    output.failures(checks)
    _show(output, result)
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
    found = []
    for image in images:
        if image.seen.beads is None:
            raise UnusableInputError(
                f"the CSV file of the {image.name} view holds the frame's beads, not the test points; "
                "give the test points' pixels in --truth, or give the images themselves"
            )
        found.append(find_balls(image.view, image.seen.beads, image.seen.observations, points))
    uv_px, covariance_px2 = zip(*found, strict=True)
    return np.array(uv_px), np.array(covariance_px2)


def _show(output: Output, result: "Assessment") -> None:
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
