"""`sightline export`: views, undistorted images and plans in the formats of other programs (docs/interop.md)."""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.calibrate import FrameName, see
from sightline.cli.detect import Invert
from sightline.cli.output import Json, Output, Quiet, example

if TYPE_CHECKING:
    from sightline.calibration import BeadView
    from sightline.calibration.exchange.pinhole import Pinhole
    from sightline.case.interop.plate import PlateImage
    from sightline.case.views import ObservedView

export_app = typer.Typer(no_args_is_help=True)

Out = Annotated[Path, typer.Option(help="Folder for the files.")]
Image = Annotated[Path, typer.Argument(help="Image of one view, or observations as CSV.")]
Second = Annotated[Path | None, typer.Argument(help="Image of the other view.", show_default=False)]


def register(app: typer.Typer) -> None:
    """Add the group and its commands."""
    app.add_typer(export_app, name="export", help="Write files for other programs.")
    for name in ("export_plan", "deidentify"):
        if find_spec(f"sightline.cli.{name}"):
            import_module(f"sightline.cli.{name}").register(export_app)


@export_app.command(
    "views", epilog=example("sightline export views pa.dcm lateral.dcm --to opencv,rtk --out out/views")
)
def views(
    pa: Image,
    lateral: Second = None,
    *,
    out: Out,
    to: Annotated[str, typer.Option(help="Formats: opencv,rtk,mayacam2,diffdrr,deepdrr,xreg.")] = "opencv",
    frame: FrameName = "gamma",
    raw: Annotated[
        bool,
        typer.Option("--raw", help="Export the raw image with its nearest pinhole; refused if the image is distorted."),
    ] = False,
    invert: Invert = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Export each view's matrix and undistorted image.

    Exit code 3 if a check of a view fails.
    """
    with Output(json=json, quiet=quiet) as output:
        from sightline.atomic import write_folder
        from sightline.calibration.exchange.formats import check_format, write_view

        kinds = [check_format(kind.strip()) for kind in to.split(",")]
        calibrated = _calibrate(output, [pa, lateral], frame, pixels=raw, invert=invert)
        files: dict[str, bytes] = {}
        documents = []
        for view, seen in calibrated:
            pinhole, pixels, document = _raw(view, seen) if raw else _plate(view, seen)
            documents.append(document)
            if pixels is not None and not raw:
                files[f"{view.name}.png"] = _png(pixels)
            for kind in kinds:
                files |= write_view(pinhole, kind, pixels)
        written = write_folder(out, files)
        _say(output, documents, written)
        output.result(
            {"views": documents, "files": written}, [check for view, _ in calibrated for check in view.checks]
        )


@export_app.command("undistorted", epilog=example("sightline export undistorted pa.dcm lateral.dcm --out out/plates"))
def undistorted(
    pa: Image,
    lateral: Second = None,
    *,
    out: Out,
    to: Annotated[
        str, typer.Option(help="Formats: png,npy,dicom; png and npy keep the original's 8 or 16 bits.")
    ] = "png",
    frame: FrameName = "gamma",
    spacing: Annotated[
        float | None,
        typer.Option(help="Pixel size on the plate, mm; by default as in the image.", show_default=False),
    ] = None,
    invert: Invert = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Export each image without distortion.

    The image is as the X-ray source sees the XRII plate; its matrix is written beside it.
    """
    with Output(json=json, quiet=quiet) as output:
        from sightline.atomic import write_folder
        from sightline.calibration.exchange import opencv
        from sightline.calibration.exchange.reading import json_bytes
        from sightline.case.interop.images import encode

        calibrated = _calibrate(output, [pa, lateral], frame, pixels=True, invert=invert)
        files: dict[str, bytes] = {}
        documents = []
        for view, seen in calibrated:
            pinhole, pixels, document = _plate(view, seen, spacing)
            documents.append(document)
            files[f"{view.name}.opencv.json"] = json_bytes(opencv.document(pinhole))
            for kind in to.split(","):
                files |= encode(kind.strip(), view.name, pixels, seen.image.white, pinhole)  # pyright: ignore[reportOptionalMemberAccess]
        written = write_folder(out, files)
        _say(output, documents, written)
        output.result(
            {"views": documents, "files": written}, [check for view, _ in calibrated for check in view.checks]
        )


def _calibrate(
    output: Output, paths: list[Path | None], frame_name: str, *, pixels: bool, invert: bool
) -> "list[tuple[BeadView, ObservedView]]":
    """Return each calibrated view with its image and beads; with `pixels` each must have an image."""
    from sightline.calibration import calibrate
    from sightline.case.views import see_pair
    from sightline.errors import UnusableInputError
    from sightline.frame import Frame

    known: Frame = Frame.load(frame_name)
    first, second = paths
    assert first is not None  # noqa: S101 - typer requires it
    with output.step("finding and labelling the beads"):
        if second is None:
            seen = [see(first, known, None, None, None, invert=invert)]
        else:
            seen = list(see_pair(first, second, known, invert=invert))
    for one in seen:
        if pixels and one.image is None:
            raise UnusableInputError(f"a CSV file has no pixels; give the image of the {one.observations.view} view")
    with output.step("calibrating (smooth)"):
        return [(calibrate(one.observations, known), one) for one in seen]


def _plate(view: "BeadView", seen: "ObservedView", spacing: float | None = None) -> Any:
    """Return the pinhole and the pixels, or None, of the undistorted image, and their document."""
    from sightline.case.interop.plate import plate_image

    plate: PlateImage = plate_image(view, None if seen.image is None else seen.image.pixels, spacing)
    pinhole = _with_checks(plate.pinhole, view)
    document = {"view": view.name, "source": seen.source, "image": "undistorted", "residual_px": 0.0}
    return pinhole, plate.pixels, document | _geometry(pinhole)


def _raw(view: "BeadView", seen: "ObservedView") -> Any:
    """Return the same as `_plate`, of the raw image."""
    from sightline.case.interop.plate import raw_pinhole

    assert seen.image is not None  # noqa: S101 - `_calibrate` refused
    pinhole, residual = raw_pinhole(view, seen.image.shape)
    pinhole = _with_checks(pinhole, view)
    document = {"view": view.name, "source": seen.source, "image": "raw", "residual_px": residual}
    return pinhole, seen.image.pixels, document | _geometry(pinhole)


def _with_checks(pinhole: "Pinhole", view: "BeadView") -> "Pinhole":
    """Return the pinhole with the failed checks in its note, which is written into the file."""
    from dataclasses import replace

    from sightline.checks import failed

    bad = ", ".join(check.name for check in failed(view.checks))
    return replace(pinhole, note=f"{pinhole.note}; NOT TO BE TRUSTED, checks failed: {bad}") if bad else pinhole


def _geometry(pinhole: "Pinhole") -> dict[str, Any]:
    return {"matrix": pinhole.matrix, "shape": pinhole.shape, "pixel_mm": pinhole.pixel_mm, "note": pinhole.note}


def _png(pixels: Any) -> bytes:
    import cv2

    return cv2.imencode(".png", pixels)[1].tobytes()


def _say(output: Output, documents: list[dict[str, Any]], written: list[Path]) -> None:
    for document in documents:
        height, width = document["shape"]
        output.say(f"{document['view']}: {width} x {height} pixels, {document['image']}; {document['note']}")
    for file in written:
        output.say(f"written: {file}")
