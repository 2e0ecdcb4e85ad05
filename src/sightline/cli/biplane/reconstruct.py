"""`sightline reconstruct`: points of a whole run, clicked or tracked in any program, in space."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sightline.cli.base import Output, command, commands

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sightline.calibration.exchange.point_table import PointTable
    from sightline.calibration.view import CalibratedView
    from sightline.planning.points.many import ManyPoints

Views = Annotated[
    list[Path],
    typer.Option(
        "--views",
        metavar="FILE",
        help="views.json with all views; or one file for each, such as a MayaCam 2 file, in the order of the cameras.",
    ),
]
_HEADER = "frame,point,x_mm,y_mm,z_mm,xx_mm2,xy_mm2,xz_mm2,yy_mm2,yz_mm2,zz_mm2,gap_mm,gap_sigma,reason\n"


@command(
    commands,
    "reconstruct",
    "sightline reconstruct points.csv --views views.json --out xyz.csv",
    "sightline reconstruct tracked.csv --views views.json --out xyz.csv \\",
    "  --points distorted --first-pixel 0",
)
def reconstruct(
    output: Output,
    *,
    path: Annotated[
        Path,
        typer.Argument(metavar="POINTS", help="CSV: frame, point, view, u_px, v_px; or NAME_cam1_X, NAME_cam1_Y, ..."),
    ],
    views: Views,
    out: Annotated[Path, typer.Option(metavar="FILE", help="CSV to write: a row for each point and frame.")],
    points: Annotated[
        Literal["distorted", "undistorted"] | None,
        typer.Option(
            help="Whether the points are pixels of an intensifier's raw images or of images without distortion.",
            show_default=False,
        ),
    ] = None,
    first_pixel: Annotated[
        int | None,
        typer.Option(min=0, max=1, help="What the file calls the middle of the top-left pixel.", show_default=False),
    ] = None,
    sd: Annotated[
        float, typer.Option(min=1e-3, help="Standard deviation of a point, px per axis, if the file states none.")
    ] = 0.5,
) -> None:
    """Reconstruct the points of a run from two or more views.

    Writes place, covariance and the distance between the lines of sight. Exit code 3 if too many lines do not meet.
    """
    import numpy as np

    from sightline.calibration.exchange.point_table import read_points
    from sightline.case.saved.files import read_views
    from sightline.common.atomic import write_whole
    from sightline.planning.points.many import BLOCK, ManySolver, gap_check

    solver = ManySolver(read_views(views))
    with output.step("reading the points"):
        table = read_points(path, [view.name for view in solver.views])
    pixels = _pixels(table, solver.views, points, first_pixel)
    uv = table.uv_px - (first_pixel or 0)
    sd_px = np.where(np.isnan(table.sd_px), sd, table.sd_px)
    with output.step("reconstructing"):
        solver.refuse_exchanged(uv)
        either = solver.refuse_upward(uv) and not table.pixels_stated
        found = solver.solve(uv, sd_px)
    text = [_lines(table, found, slice(k, k + BLOCK)) for k in range(0, len(table.frames), BLOCK)]
    write_whole(out, "".join([_HEADER, *text]).encode())
    document = _summary(output, found)
    if either:
        output.say("the lines of sight would meet as well with y counted from below: make sure that y is down")
    output.written([out])
    checks = [check for view in solver.views for check in view.checks]
    checks.append(gap_check(found.gap_mm, found.gap_sigma, found.reason))
    output.result({**document, "pixels": pixels, "file": out}, checks)


def _pixels(table: "PointTable", views: "Sequence[CalibratedView]", given: str | None, first_pixel: int | None) -> str:
    """Return "distorted" or "undistorted", what the points are and the views take. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError
    from sightline.planning.points.many import without_distortion

    if not table.pixels_stated and None in (given, first_pixel):
        raise UnusableInputError(
            "the file does not state its pixels: give --points distorted or undistorted, and --first-pixel 0 or 1, as "
            "they were exported (XMALab's defaults are distorted and 0; DLTdv 8 counts from 1)"
        )
    if table.pixels_stated and first_pixel:
        raise UnusableInputError("the columns u_px and v_px count from 0; leave out --first-pixel")
    taken = "undistorted" if without_distortion(views) else "distorted"
    if given not in (None, taken):
        raise UnusableInputError(
            "the views are of images without distortion, but the points are distorted: give undistorted points (those "
            "of a flat panel are), or views that were calibrated on raw images"
            if taken == "undistorted"
            else "the views take pixels of raw images, but the points are undistorted: give distorted points, or the "
            "matrices of the undistorted images (sightline export views)"
        )
    return taken


def _lines(table: "PointTable", found: "ManyPoints", rows: slice) -> str:
    """Return the CSV lines of these rows of the table."""
    import numpy as np

    from sightline.planning.points.many import REASONS

    columns, form = [found.xyz_mm, found.gap_mm[:, None]], "%.4f,%.4f,%.4f,,,,,,,%.4f,"
    if found.covariance_mm2 is not None and found.gap_sigma is not None:
        upper = found.covariance_mm2.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
        columns = [found.xyz_mm, upper, found.gap_mm[:, None], found.gap_sigma[:, None]]
        form = "%.4f,%.4f,%.4f,%.4g,%.4g,%.4g,%.4g,%.4g,%.4g,%.4f,%.2f"
    names = [_cell(name) for name in table.names]
    lines = zip(
        table.frames[rows].tolist(),
        table.points[rows].tolist(),
        found.reason[rows].tolist(),
        map(tuple, np.hstack([column[rows] for column in columns]).tolist()),
        strict=True,
    )
    return "".join(
        f"{frame},{names[point]},{',' * 10 if reason else form % numbers},{REASONS[reason]}\n"
        for frame, point, reason, numbers in lines
    )


def _cell(name: str) -> str:
    """Return a cell of CSV, quoted where needed."""
    return '"' + name.replace('"', '""') + '"' if any(mark in name for mark in ',"\n\r') else name


def _summary(output: Output, found: "ManyPoints") -> dict[str, Any]:
    """Show how many points were reconstructed, how well, and why others were not; return the same."""
    import numpy as np

    from sightline.planning.points.many import OK, REASONS

    ok = found.reason == OK
    reasons = {REASONS[k]: int(n) for k, n in enumerate(np.bincount(found.reason)) if k and n}
    gap = sd = None
    output.say(f"{ok.sum()} of {len(ok)} points reconstructed")
    for reason, count in reasons.items():
        output.say(f"{count} not reconstructed: {reason}")
    if ok.any():
        gap = float(np.median(found.gap_mm[ok]))
        output.say(f"distance between the lines of sight: {gap:.3f} mm (median)")
    if found.covariance_mm2 is None:
        output.say("errors unknown: a view states none")
    elif ok.any():
        sd = float(np.median(np.sqrt(np.linalg.eigvalsh(found.covariance_mm2[ok])[:, -1])))
        output.say(f"largest standard deviation of a point: {sd:.3f} mm (median)")
    return {"points": len(ok), "reconstructed": int(ok.sum()), "reasons": reasons, "gap_mm": gap, "sd_mm": sd}
