"""`sightline calibrate`: calibrate one view from its own beads."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.detect import FrameIndex, Invert
from sightline.cli.output import Json, Output, Quiet, example

if TYPE_CHECKING:
    from sightline.calibration import BeadView
    from sightline.case.views import ObservedView
    from sightline.frame import Frame

_SHOWN = 10  # beads in the table; --json has them all

FrameName = Annotated[str, typer.Option("--frame", help="A frame file, gamma, biplane or stereo.")]
ViewName = Annotated[
    str | None,
    typer.Option(
        "--view",
        help="View of the image, pa or lateral, of a block also oblique; by default as the datum markers show.",
        show_default=False,
    ),
]
Datums = Annotated[
    list[str] | None,
    typer.Option("--datum", help="Pixel of a datum marker, 'ID=U,V', where it is not found; give one for each marker."),
]


Sid = Annotated[
    float | None,
    typer.Option(
        "--sid",
        min=1.0,
        help="Distance from X-ray source to detector, mm; by default as DICOM states it, if it does.",
        show_default=False,
    ),
]
PixelSize = Annotated[
    float | None,
    typer.Option(
        "--pixel",
        min=1e-4,
        help="Size of a pixel on the detector, mm; by default as DICOM states it, if it does.",
        show_default=False,
    ),
]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("calibrate", epilog=example("sightline calibrate out/demo/demo_pa.dcm --picture out/residuals.png"))(
        calibrate
    )


def calibrate(
    image: Annotated[Path, typer.Argument(help="An image, or its beads as CSV, labelled (observations) or not.")],
    *,
    frame: FrameName = "gamma",
    view: ViewName = None,
    method: Annotated[
        str, typer.Option(help="Calibration method: smooth, localized (the paper's) or polynomial.")
    ] = "smooth",
    datum: Datums = None,
    frame_index: FrameIndex = None,
    mirrored: Annotated[
        bool | None,
        typer.Option(help="Whether the image is shown mirrored: writing in it reads backwards.", show_default=False),
    ] = None,
    sid: Sid = None,
    pixel: PixelSize = None,
    invert: Invert = False,
    csv: Annotated[Path | None, typer.Option(help="Write the labelled beads to this CSV file.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Write a PNG of the image with each bead's residual as an arrow.")
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate one view from its own beads.

    Gives the focal point, the residual of each bead and the checks of the view. Exit code 3 if a check fails.
    """
    with Output(json=json, quiet=quiet) as out:
        from sightline.case.documents import view_document
        from sightline.case.views import calibrated as calibrated_image
        from sightline.detection.csv_files import write_observations
        from sightline.frame import Frame
        from sightline.from_images.pipeline import known_arm

        known_frame = Frame.load(frame)
        with out.step("finding and labelling the beads"):
            seen = see(image, known_frame, view, datum, frame_index, invert=invert)
        if csv is not None:
            write_observations([seen.observations], csv)
        # Before the calibration: where that is refused for want of beads, this says how to get them.
        advice = None if known_frame.solid else _advise(seen, known_frame)
        for sentence in advice["sentences"] if advice else ():
            out.say(sentence)
        with out.step(f"calibrating ({method})"):
            calibrated = calibrated_image(
                seen,
                known_frame,
                method,  # pyright: ignore[reportArgumentType]
                known_arm(seen.image, sid, pixel),
                mirrored_display=mirrored,
            )
        document = view_document(calibrated) | {"set_up": advice}
        _add_leave_one_out(document, calibrated.view)
        if picture is not None:
            from sightline.atomic import write_whole

            write_whole(picture, calibrated.view.png())
        out.failures(calibrated.view.checks)
        _show(out, document)
        out.result(document, calibrated.view.checks)


def see(
    path: Path,
    frame: "Frame",
    view: str | None,
    datum: list[str] | None,
    frame_index: int | None,
    *,
    invert: bool = False,
) -> "ObservedView":
    """Return the labelled beads of one view: of an image, or of a CSV file with or without the beads' ids.

    Raises what reading and labelling raise.
    """
    from sightline.case import views
    from sightline.case.journal.originals import anonymous_name
    from sightline.detection.csv_files import are_detections, label_csv
    from sightline.errors import UnusableInputError

    if path.suffix.lower() == ".csv":
        if invert:
            raise UnusableInputError("--invert is of images; beads in CSV have no pixels to invert")
        if frame_index is None and are_detections(path):
            return views.ObservedView(anonymous_name(path), label_csv(path, frame, view, _datums(datum)))
        if datum or frame_index is not None:
            raise UnusableInputError(
                "--datum and --frame-index are for images; the beads of this CSV file are labelled already"
            )
        return views.ObservedView(anonymous_name(path), _observed(path, view))
    return views.see(path, frame, view, _datums(datum), frame_index, invert=invert)


def _advise(seen: "ObservedView", frame: "Frame") -> dict[str, Any] | None:
    """Return what to move before the next exposure; None for observations, which do not say where their field ends."""
    from sightline.calibration import advise

    if seen.image is None:
        return None
    advice = advise(seen.observations, frame, seen.image.field_mask)
    return {
        "sentences": advice.sentences,
        "outside": advice.outside,
        "outside_after": advice.outside_after,
        "move_mm": advice.move_mm,
    }


def _observed(path: Path, view: str | None) -> Any:
    from sightline.detection.csv_files import read_observations
    from sightline.errors import ObservationsError

    views = read_observations(path)
    if view is None and len(views) == 1:
        return next(iter(views.values()))
    if view not in views:
        known = ", ".join(views)
        raise ObservationsError(f"{path.name} holds observations of {known}; choose one with --view")
    return views[view]


def _datums(texts: list[str] | None) -> dict[str, tuple[float, float]] | None:
    """Return the pixels of 'ID=U,V' texts by fiducial. Raises UnusableInputError."""
    from math import isfinite

    from sightline.errors import UnusableInputError

    out: dict[str, tuple[float, float]] = {}
    for text in texts or ():
        try:
            name, numbers = text.split("=")
            u, v = (float(number) for number in numbers.split(","))
        except ValueError:
            raise UnusableInputError(f"--datum {text!r} is not ID=U,V; write for example pa-x-d1=512.0,388.5") from None
        if name in out or not (isfinite(u) and isfinite(v)):
            raise UnusableInputError(
                f"--datum {text!r} is given twice or is not finite; give one pixel for each marker"
            )
        out[name] = (u, v)
    return out or None


def _add_leave_one_out(document: dict[str, Any], view: "BeadView") -> None:
    left = view.residuals
    for bead, error, known in zip(document["beads"], left.leave_one_out_mm, left.predicted, strict=True):
        bead["leave_one_out_mm"] = error.tolist() if known else None


def _show(out: Output, document: dict[str, Any]) -> None:
    focal = ", ".join(f"{x:.1f}" for x in document["focal_point_mm"])
    mirrored = ", a mirror image" if document["mirrored"] else ""
    out.say(f"view {document['view']}{mirrored}; focal point ({focal}) mm in CFCS")
    left, predicted = document["residual_rms_mm"], document["leave_one_out_rms_mm"]
    out.say(f"{len(document['beads'])} beads; residual {left:.3f} mm rms per axis, leave-one-out {predicted:.3f} mm")
    worst = sorted(document["beads"], key=lambda bead: -_length(bead["leave_one_out_mm"] or (0.0, 0.0)))
    out.table(
        f"Beads with the largest leave-one-out errors (of {len(worst)}), mm on the reference plane",
        ("bead", "residual", "leave-one-out", "used"),
        [
            (
                bead["id"],
                f"{_length(bead['residual_mm']):.3f}",
                None if bead["leave_one_out_mm"] is None else f"{_length(bead['leave_one_out_mm']):.3f}",
                "yes" if bead["used"] else "no",
            )
            for bead in worst[:_SHOWN]
        ],
    )


def _length(xy: Any) -> float:
    return float(xy[0] ** 2 + xy[1] ** 2) ** 0.5
