"""`sightline undistort`: an image resampled to the plane of its XRII plate, and the map that did it."""

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.calibrate import Datums, FrameName, ViewName, see
from sightline.cli.detect import FrameIndex, Invert
from sightline.cli.output import Json, Output, Quiet, as_json, example

if TYPE_CHECKING:
    from sightline.calibration import BeadView
    from sightline.calibration.maps.undistort import PlaneImage


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("undistort", epilog=example("sightline undistort out/demo/demo_pa.dcm --out out/undistorted"))(
        undistort
    )


def undistort(
    image: Annotated[Path, typer.Argument(help="Image file.")],
    *,
    out: Annotated[Path, typer.Option(help="Folder for plate.png, map.npz and map.json.")],
    frame: FrameName = "gamma",
    view: ViewName = None,
    datum: Datums = None,
    frame_index: FrameIndex = None,
    invert: Invert = False,
    spacing: Annotated[
        float | None,
        typer.Option(help="Pixel size on the plate, mm; by default as in the image.", show_default=False),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Remove the distortion from an image.

    The image is resampled to the plane of its XRII plate; image and map are written (docs/undistort.md).
    """
    with Output(json=json, quiet=quiet) as output:
        from sightline.calibration import calibrate
        from sightline.calibration.maps.undistort import undistort as resample
        from sightline.errors import UnusableInputError
        from sightline.frame import Frame

        if image.suffix.lower() == ".csv":
            raise UnusableInputError("a CSV file has no pixels to resample; give the image")
        known_frame = Frame.load(frame)
        known_frame.refuse_solid("its images come from flat panels, which have no distortion to remove")
        with output.step("finding and labelling the beads"):
            seen = see(image, known_frame, view, datum, frame_index, invert=invert)
        with output.step("calibrating (smooth)"):
            calibrated = calibrate(seen.observations, known_frame, view)
        with output.step("resampling"):
            pixels = None if seen.image is None else seen.image.pixels
            plane_image = resample(pixels, calibrated.plane_map, calibrated.hull, spacing)  # pyright: ignore[reportArgumentType]
        document = _document(seen.source, calibrated, plane_image)
        document["files"] = _write(out, plane_image, document)
        height, width = plane_image.pixels.shape
        output.say(
            f"{width} x {height} pixels of {plane_image.spacing_mm:.4f} mm on the XRII plate of view {calibrated.name}"
        )
        for file in document["files"]:
            output.say(f"written: {file}")
        output.result(document, calibrated.checks)


def _document(source: str, view: "BeadView", image: "PlaneImage") -> dict[str, Any]:
    """Return the content of map.json (docs/undistort.md)."""
    return {
        "source": source,
        "view": view.name,
        "units": "mm",
        "shape": image.pixels.shape,
        "origin_mm": image.origin_mm,
        "spacing_mm": image.spacing_mm,
        "plane": {"origin_mm": view.plane.origin_mm, "axes": view.plane.axes},
        "focal_point_mm": view.focal_point_mm,
    }


def _write(folder: Path, image: "PlaneImage", document: dict[str, Any]) -> list[Path]:
    import cv2
    import numpy as np

    from sightline.atomic import write_folder

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
