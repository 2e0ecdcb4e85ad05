"""`sightline export`: views, undistorted images and plans in other programs' formats, and images without identity."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import (
    FrameIndex,
    ImagesFrame,
    Invert,
    LabellingOptions,
    OutFolder,
    Output,
    Side,
    Spacing,
    command,
    frame_of_images,
    group,
)
from sightline.cli.calibrate import see

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from sightline.calibration import BeadView
    from sightline.calibration.exchange.pinhole import Pinhole
    from sightline.calibration.view import CalibratedView
    from sightline.case.interop.plan_file import PlanFile
    from sightline.case.views import ObservedView
    from sightline.common.checks import Check

app = group("export", "Write files for other programs.")
PLAN_FORMATS = ("slicer", "mrb", "itk", "dicom", "csv", "igtl")


@dataclass(frozen=True)
class ImageOptions:
    """The images whose views are exported."""

    pa: Annotated[Path, typer.Argument(help="Image of one view, or observations as CSV; for `views` also views.json.")]
    lateral: Annotated[Path | None, typer.Argument(help="Image of the other view.", show_default=False)] = None
    frame: ImagesFrame = None
    invert: Invert = False


@command(app, "views", "sightline export views pa.dcm lateral.dcm --to opencv,rtk --out out/views")
def views(
    output: Output,
    *,
    images: ImageOptions,
    out: OutFolder,
    to: Annotated[
        str,
        typer.Option(help="Formats: opencv,rtk,mayacam2,diffdrr,deepdrr,xreg; xmalab and autoscoper read mayacam2."),
    ] = "opencv",
    raw: Annotated[
        bool,
        typer.Option("--raw", help="Export the raw image with its nearest pinhole; refused if the image is distorted."),
    ] = False,
) -> None:
    """Export each view's matrix and undistorted image.

    Exit code 3 if a check of a view fails.
    """
    import cv2

    from sightline.calibration.exchange.formats import check_format, write_view
    from sightline.calibration.exchange.rtk import write_stack

    formats = [check_format(name.strip()) for name in to.split(",")]
    exported = _saved(images)
    if not exported:
        calibrated = _calibrate(output, images, pixels=raw)
        exported = [(*_exported(view, seen, raw=raw), view.checks) for view, seen in calibrated]
    files: dict[str, bytes] = {}
    for pinhole, pixels, _, _ in exported:
        if pixels is not None and not raw:
            files[f"{pinhole.name}.png"] = cv2.imencode(".png", pixels)[1].tobytes()
        for name in formats:
            files |= write_view(pinhole, name, pixels)
    pinholes, images_of, documents, checks = zip(*exported, strict=True)
    if "rtk" in formats and len(exported) > 1:
        files |= write_stack(pinholes, images_of)
    _finish(output, out, files, documents, list(chain(*checks)))


def _saved(images: ImageOptions) -> "list[tuple[Pinhole, np.ndarray | None, dict[str, Any], Sequence[Check]]]":
    """Return the views of a file of views as `reconstruct` uses them, without pixels; none for an image.

    Raises UnusableInputError.
    """
    from sightline.calibration import BeadView, MatrixView
    from sightline.calibration.solids.calibrate_together import adjusted_together
    from sightline.case.interop.plate import pinhole_of
    from sightline.case.saved.files import saved_views
    from sightline.errors import UnusableInputError

    views = saved_views(images.pa)
    if views is None:
        return []
    if images != ImageOptions(images.pa):
        raise UnusableInputError(f"{images.pa.name} holds calibrated views; leave out other images, --frame, --invert")
    exported: list[tuple[Pinhole, np.ndarray | None, dict[str, Any], Sequence[Check]]] = []
    for view in adjusted_together(views):
        assert isinstance(view, BeadView | MatrixView)  # noqa: S101 - what `saved_views` reads
        pinhole = _marked(pinhole_of(view), view)
        document = {"view": pinhole.name, "image": "as calibrated", **_geometry(pinhole)}
        exported.append((pinhole, None, document, view.checks))
    return exported


def _marked(pinhole: "Pinhole", view: "CalibratedView") -> "Pinhole":
    """Return a pinhole whose note, which is written into its file, names the failed checks of the view."""
    from sightline.common.checks import failed

    bad = ", ".join(check.name for check in failed(view.checks))
    return replace(pinhole, note=f"{pinhole.note}; NOT TO BE TRUSTED, checks failed: {bad}") if bad else pinhole


def _geometry(pinhole: "Pinhole") -> dict[str, Any]:
    return {name: getattr(pinhole, name) for name in ("matrix", "shape", "pixel_mm", "note")}


@command(app, "undistorted", "sightline export undistorted pa.dcm lateral.dcm --out out/plates")
def undistorted(
    output: Output,
    *,
    images: ImageOptions,
    out: OutFolder,
    to: Annotated[
        str, typer.Option(help="Formats: png,npy,dicom; png and npy keep the original's 8 or 16 bits.")
    ] = "png",
    spacing: Spacing = None,
) -> None:
    """Export each image without distortion.

    The image is as the X-ray source sees the XRII plate; its matrix is written beside it.
    """
    from sightline.calibration.exchange import opencv
    from sightline.calibration.exchange.reading import json_bytes
    from sightline.case.interop.dicom import encode

    calibrated = _calibrate(output, images, pixels=True)
    files: dict[str, bytes] = {}
    documents = []
    for view, seen in calibrated:
        pinhole, pixels, document = _exported(view, seen, spacing)
        assert seen.image is not None and pixels is not None  # noqa: S101 - `_calibrate` refused
        documents.append(document)
        files[f"{view.name}.opencv.json"] = json_bytes(opencv.document(pinhole))
        for name in to.split(","):
            files |= encode(name.strip(), view.name, pixels, seen.image.white, pinhole)
    _finish(output, out, files, documents, [check for view, _ in calibrated for check in view.checks])


@command(app, "plan", "sightline export plan out/plan --to csv,slicer --out out/export")
def plan(
    output: Output,
    *,
    path: Annotated[Path, typer.Argument(metavar="PLAN", help="plan.json, or the folder of `sightline plan --out`.")],
    out: OutFolder,
    to: Annotated[
        str,
        typer.Option(
            help=f"Formats: {','.join(PLAN_FORMATS)}. Each goes to a folder of its name, of several wires one for each "
            "in it."
        ),
    ] = "csv",
    side: Annotated[
        Side | None,
        typer.Option(
            help="Side of the patient, which patient axes depend on; needed where the plan does not state it."
        ),
    ] = None,
    case: Annotated[str, typer.Option(help="Case number: the only identification in the files.")] = "plan",
    original: Annotated[
        list[str] | None,
        typer.Option(help="Raw DICOM image to draw on, 'pa:FILE'; its UIDs are written.", show_default=False),
    ] = None,
) -> None:
    """Export a plan.

    A plan that is not GO says so in every file, and is not exported as a robot's message.
    """
    from sightline.case.interop.plan_file import PlanFile
    from sightline.common.atomic import write_folder
    from sightline.errors import UnusableInputError

    formats = [name.strip() for name in to.split(",")]
    if unknown := [name for name in formats if name not in PLAN_FORMATS]:
        raise UnusableInputError(f"{unknown[0]!r} is not a format of a plan; choose from {', '.join(PLAN_FORMATS)}")
    wires, originals = PlanFile.read_all(path), _originals(original)
    if originals and "dicom" not in formats:
        raise UnusableInputError("--original is for --to dicom only; leave it out")
    stated = next(iter(wires.values())).side  # one patient's, the same for all wires
    if side is not None and stated is None:
        output.note(f"the plan does not state its side: the patient axes rest on --side {side} alone")
    side = side or stated
    for wire in wires.values() if side else ():
        wire.refuse_other_side(side or "")
    with output.step("making the files"):  # all of them before any is written
        documents = _plan_files(wires, formats, side, case, originals)
    files = write_folder(out, documents)
    statements = {key: wire.statement for key, wire in wires.items()}
    for key, statement in statements.items():
        output.say(f"{key}: {statement}" if key else statement)
    output.written(files)
    stated_of = {"statement": statements[""]} if "" in statements else {"statements": statements}
    go = all(wire.go and wire.document.all_wires in (None, "go") for wire in wires.values())
    output.result({"go": go, **stated_of, "side": side, "files": files})


def _plan_files(
    wires: "dict[str, PlanFile]", formats: list[str], side: Side | None, case: str, originals: dict[str, Path]
) -> dict[str, bytes]:
    """Return the files of each wire in each format, by FORMAT/NAME or, of several wires, FORMAT/WIRE/NAME."""
    from datetime import datetime

    from sightline.case.interop import dicom, slicer
    from sightline.case.interop.dicom import ExportIdentity
    from sightline.case.interop.formats import csv_files, igtl_files, itk_files

    identity = ExportIdentity(case, datetime.now().replace(microsecond=0), side)
    writers: dict[str, Callable[[PlanFile], dict[str, bytes]]] = {
        "slicer": lambda wire: slicer.write(wire, side),
        "mrb": lambda wire: slicer.write_bundle(wire, side),
        "itk": lambda wire: itk_files(wire, side),
        "dicom": lambda wire: dicom.write(wire, identity, originals),
        "csv": lambda wire: csv_files(wire, side),
        "igtl": lambda wire: igtl_files(wire, case),
    }
    return {
        f"{name}/{f'{key}/' if key else ''}{file}": data
        for name in formats
        for key, wire in wires.items()
        for file, data in writers[name](wire).items()
    }


@command(app, "deidentify", "sightline export deidentify pa.dcm lateral.dcm --out out/anonymous")
def deidentify(
    output: Output,
    *,
    images: Annotated[list[Path], typer.Argument(metavar="DICOM...", help="DICOM images of one patient.")],
    out: Annotated[Path, typer.Option(help="Folder for image-001.dcm, image-002.dcm, ... in the order given.")],
    frame_index: FrameIndex = None,
) -> None:
    """Write DICOM files without the patient's identity.

    The new files hold pixels and geometry only. Burnt-in annotation stays in the pixels.
    """
    from sightline.case.deidentify import Deidentifier
    from sightline.common.atomic import write_folder

    cleaner = Deidentifier()
    cleaned = [cleaner.clean(image, frame_index) for image in images]  # all of them before one is written
    named = {f"image-{k:03d}.dcm": image for k, image in enumerate(cleaned, 1)}
    files = write_folder(out, {name: image.data for name, image in named.items()})
    output.written(files)
    burnt = [name for name, image in named.items() if image.burnt_in_stated or image.burnt_in_found]
    annotated = f"; annotation found in {', '.join(burnt)}" if burnt else ""
    output.note(f"look at every image before you pass it on: burnt-in annotation is not removed{annotated}")
    documents = [
        {"file": file, "burnt_in_stated": image.burnt_in_stated, "burnt_in_found": image.burnt_in_found}
        for file, image in zip(files, cleaned, strict=True)
    ]
    output.result({"images": documents})


def _calibrate(output: Output, images: ImageOptions, *, pixels: bool) -> "list[tuple[BeadView, ObservedView]]":
    """Return each calibrated view with its image and beads; with `pixels` each must have an image."""
    from sightline.calibration import calibrate
    from sightline.case.views import see_pair
    from sightline.errors import UnusableInputError

    frame = frame_of_images(output, images.frame)
    with output.step("finding and labelling the beads"):
        if images.lateral is None:
            seen = [see(images.pa, frame, LabellingOptions(invert=images.invert))]
        else:
            seen = list(see_pair(images.pa, images.lateral, frame, invert=images.invert))
    for view in seen:
        if pixels and view.image is None:
            raise UnusableInputError(f"a CSV file has no pixels; give the image of the {view.observations.view} view")
    with output.step("calibrating (smooth)"):
        return [(calibrate(view.observations, frame), view) for view in seen]


_Exported = tuple["Pinhole", "np.ndarray | None", dict[str, Any]]


def _exported(view: "BeadView", seen: "ObservedView", spacing: float | None = None, *, raw: bool = False) -> _Exported:
    """Return the pinhole and the pixels, or None, of the undistorted image, or of the raw one, and their document."""
    from sightline.case.interop.plate import plate_image, raw_pinhole

    given = None if seen.image is None else seen.image.pixels
    if raw:
        assert seen.image is not None  # noqa: S101 - `_calibrate` refused
        pixels = given
        pinhole, residual = raw_pinhole(view, seen.image.shape)
    else:
        plate, residual = plate_image(view, given, spacing), 0.0
        pinhole, pixels = plate.pinhole, plate.pixels
    pinhole = _marked(pinhole, view)
    image = {"image": "raw" if raw else "undistorted", "residual_px": residual}
    return pinhole, pixels, {"view": view.name, "source": seen.source, **image, **_geometry(pinhole)}


def _finish(
    output: Output,
    folder: Path,
    files: dict[str, bytes],
    documents: "Sequence[dict[str, Any]]",
    checks: "Sequence[Check]",
) -> None:
    from sightline.common.atomic import write_folder

    written = write_folder(folder, files)
    for document in documents:
        height, width = document["shape"] or ("?", "?")
        output.say(f"{document['view']}: {width} x {height} pixels, {document['image']}; {document['note']}")
    output.written(written)
    output.result({"views": documents, "files": written}, checks)


def _originals(texts: list[str] | None) -> dict[str, Path]:
    from sightline.errors import UnusableInputError

    originals: dict[str, Path] = {}
    for text in texts or ():
        view, colon, file = text.partition(":")
        if not colon or not file or view in originals:
            raise UnusableInputError(f"--original {text!r} is not VIEW:FILE, for example pa:shot1.dcm, once a view")
        originals[view] = Path(file)
    return originals
