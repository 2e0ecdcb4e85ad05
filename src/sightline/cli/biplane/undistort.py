"""`sightline undistort`: an image with beads, or whole runs by the map of a grid, without distortion."""

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import LabellingOptions, Output, Spacing, as_json, command, commands, frame_of_images
from sightline.cli.calibrate import see

if TYPE_CHECKING:
    from sightline.calibration.maps.undistort import PlaneImage


@command(commands, "undistort", "sightline undistort out/demo/demo_pa.dcm --out out/undistorted")
def undistort(
    output: Output,
    *,
    images: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="An image with beads; with --map also folders, runs, videos.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for plate.png, map.npz and map.json; with --map for the runs.")],
    map_file: Annotated[
        Path | None,
        typer.Option("--map", help="Map of `sightline grid`, for images without beads.", show_default=False),
    ] = None,
    labelling: LabellingOptions,
    spacing: Spacing = None,
) -> None:
    """Remove the distortion from an image or whole runs.

    Beads: the image is resampled to the plane of its XRII plate; image and map are written (docs/undistort.md).
    With --map whole runs are, and an interrupted call goes on where it ended (docs/biplane.md).
    """
    from sightline.errors import UnusableInputError

    if map_file is not None:
        if spacing is not None or labelling != LabellingOptions():
            raise UnusableInputError("--map needs no beads; leave out --frame, --view, --datum, --spacing and the like")
        _undistort_runs(output, images, map_file, out)
    else:
        _undistort_plate(output, images, out, labelling, spacing)


def _undistort_runs(output: Output, paths: list[Path], map_file: Path, out: Path) -> None:
    from sightline.calibration.maps.grid import GridMap
    from sightline.case.interop.undistorted import UndistortedRun, undistort_runs
    from sightline.case.saved import load

    with output.step("reading the map"):
        grid = load(map_file, GridMap)
    runs = [UndistortedRun.of(path, k) for k, path in enumerate(paths, 1)]
    frames = [run.frames for run in runs]
    with output.progress("undistorting", sum(frames)) as advance:
        files, already = undistort_runs(runs, grid, out, advance)
    output.say(f"{sum(frames)} frames in {len(files)} files, {already} of which were there already")
    output.say(f"a pixel is {grid.spacing_mm:.4f} mm on the sheet")
    output.written([out])
    output.result({"frames": frames, "already": already, "spacing_mm": grid.spacing_mm, "files": files})


def _undistort_plate(
    output: Output, images: list[Path], out: Path, labelling: LabellingOptions, spacing: float | None
) -> None:
    from sightline.calibration import calibrate
    from sightline.calibration.maps.undistort import undistort as resample
    from sightline.errors import UnusableInputError

    if len(images) > 1:
        raise UnusableInputError(f"{len(images)} images given; give one image with beads, or --map for whole runs")
    image = images[0]
    if image.suffix.lower() == ".csv":
        raise UnusableInputError("a CSV file has no pixels to resample; give the image")
    frame = frame_of_images(output, labelling.frame)
    frame.refuse_solid("its images come from flat panels, which have no distortion to remove")
    with output.step("finding and labelling the beads"):
        seen = see(image, frame, labelling)
    with output.step("calibrating (smooth)"):
        view = calibrate(seen.observations, frame, labelling.view)
    with output.step("resampling"):
        assert seen.image is not None  # noqa: S101 - it is not a CSV file
        plane_image = resample(seen.image.pixels, view.plane_map, view.hull, spacing)
    document: dict[str, Any] = {  # map.json, docs/undistort.md
        "source": seen.source,
        "view": view.name,
        "units": "mm",
        "shape": plane_image.pixels.shape,
        "origin_mm": plane_image.origin_mm,
        "spacing_mm": plane_image.spacing_mm,
        "plane": {"origin_mm": view.plane.origin_mm, "axes": view.plane.axes},
        "focal_point_mm": view.focal_point_mm,
    }
    files = _write(out, plane_image, document)
    height, width = plane_image.pixels.shape
    output.say(f"{width} x {height} pixels of {plane_image.spacing_mm:.4f} mm on the XRII plate of view {view.name}")
    output.written(files)
    output.result(document | {"files": files}, view.checks)


def _write(folder: Path, image: "PlaneImage", document: dict[str, Any]) -> list[Path]:
    import cv2
    import numpy as np

    from sightline.common.atomic import write_folder

    arrays = BytesIO()
    np.savez_compressed(
        arrays, uv_px=image.uv_px, inside_hull=image.inside_hull, origin_mm=image.origin_mm, spacing_mm=image.spacing_mm
    )
    return write_folder(
        folder,
        {
            "plate.png": cv2.imencode(".png", image.pixels)[1].tobytes(),
            "map.npz": arrays.getvalue(),
            "map.json": as_json(document).encode(),
        },
    )
