"""`sightline calibrate` and `detect`: one view from its own beads, and the beads of an image."""

from dataclasses import dataclass
from math import hypot, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import (
    Distances,
    FrameIndex,
    Invert,
    LabellingOptions,
    Method,
    Output,
    command,
    commands,
    frame_of_images,
)

if TYPE_CHECKING:
    from sightline.case.views import ObservedView
    from sightline.detection import Detections
    from sightline.frame import Frame
    from sightline.imaging import Radiograph

_SHOWN = 10  # beads in the table; --json has them all


@dataclass(frozen=True)
class CalibrationFiles:
    """What a calibration writes."""

    csv: Annotated[Path | None, typer.Option(help="Write the labelled beads to this CSV file.")] = None
    picture: Annotated[
        Path | None, typer.Option(help="Write a PNG of the image with each bead's residual as an arrow.")
    ] = None
    views: Annotated[
        Path | None, typer.Option(help="Put the view into this JSON file, beside those of other images.")
    ] = None


@command(commands, "calibrate", "sightline calibrate out/demo/demo_pa.dcm --picture out/residuals.png")
def calibrate(
    output: Output,
    *,
    image: Annotated[Path, typer.Argument(help="An image, or its beads as CSV, labelled (observations) or not.")],
    labelling: LabellingOptions,
    method: Method = "smooth",
    mirrored: Annotated[
        bool | None,
        typer.Option(help="Whether the image is shown mirrored: writing in it reads backwards.", show_default=False),
    ] = None,
    distances: Distances,
    written: CalibrationFiles,
) -> None:
    """Calibrate one view from its own beads.

    Gives the focal point, the residual of each bead and the checks of the view. Exit code 3 if a check fails.
    """
    from sightline.case.saved.files import add_view
    from sightline.case.views import calibrated as calibrated_image
    from sightline.case.views import view_document
    from sightline.common.atomic import write_whole
    from sightline.detection.csv_files import write_observations
    from sightline.from_images.pipeline import known_arm

    frame = frame_of_images(output, labelling.frame)
    with output.step("finding and labelling the beads"):
        seen = see(image, frame, labelling)
    if written.csv is not None:
        write_observations([seen.observations], written.csv)
    # Before the calibration: where that is refused for want of beads, this says how to get them.
    advice = None if frame.solid else _advise(seen, frame)
    for sentence in advice["sentences"] if advice else ():
        output.say(sentence)
    with output.step(f"calibrating ({method})"):
        arm = known_arm(seen.image, distances.sid, distances.pixel)
        calibrated = calibrated_image(seen, frame, method, arm, mirrored_display=mirrored)
    document: dict[str, Any] = {**view_document(calibrated), "set_up": advice}
    left = calibrated.view.residuals
    for bead, error, known in zip(document["beads"], left.leave_one_out_mm, left.predicted, strict=True):
        bead["leave_one_out_mm"] = error.tolist() if known else None
    if written.picture is not None:
        write_whole(written.picture, calibrated.view.png())
    if written.views is not None:
        output.say(f"{written.views.name} holds {', '.join(add_view(calibrated.view, written.views))}")
    output.failures(calibrated.view.checks)
    _show(output, document)
    output.result(document, calibrated.view.checks)


def see(path: Path, frame: "Frame", labelling: LabellingOptions) -> "ObservedView":
    """Return the labelled beads of one view: of an image, or of a CSV file with or without the beads' ids.

    Raises what reading and labelling raise.
    """
    from sightline.case import views
    from sightline.case.journal.originals import anonymous_name
    from sightline.detection.csv_files import are_detections, label_csv, read_observations
    from sightline.errors import ObservationsError, UnusableInputError

    view, datums = labelling.view, _datums(labelling.datum)
    if path.suffix.lower() != ".csv":
        return views.see(path, frame, view, datums, labelling.frame_index, invert=labelling.invert)
    if labelling.invert:
        raise UnusableInputError("--invert is of images; beads in CSV have no pixels to invert")
    if labelling.frame_index is None and are_detections(path):
        return views.ObservedView(anonymous_name(path), label_csv(path, frame, view, datums))
    if datums or labelling.frame_index is not None:
        raise UnusableInputError(
            "--datum and --frame-index are for images; the beads of this CSV file are labelled already"
        )
    observed = read_observations(path)
    if view is None and len(observed) == 1:
        view = next(iter(observed))
    if view not in observed:
        raise ObservationsError(
            f"{path.name} holds observations of {', '.join(observed)}; choose one of them with --view"
        )
    return views.ObservedView(anonymous_name(path), observed[view])


def _advise(seen: "ObservedView", frame: "Frame") -> dict[str, Any] | None:
    """Return what to move before the next exposure; None for observations, which do not say where their field ends."""
    from sightline.calibration import advise

    if seen.image is None:
        return None
    advice = advise(seen.observations, frame, seen.image.field_mask)
    return {name: getattr(advice, name) for name in ("sentences", "outside", "outside_after", "move_mm")}


def _datums(texts: list[str] | None) -> dict[str, tuple[float, float]] | None:
    """Return the pixels of 'ID=U,V' texts by fiducial. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    datums: dict[str, tuple[float, float]] = {}
    for text in texts or ():
        try:
            name, numbers = text.split("=")
            u, v = (float(number) for number in numbers.split(","))
        except ValueError:
            raise UnusableInputError(f"--datum {text!r} is not ID=U,V; write for example pa-x-d1=512.0,388.5") from None
        if name in datums or not (isfinite(u) and isfinite(v)):
            raise UnusableInputError(
                f"--datum {text!r} is given twice or is not finite; give one pixel for each marker"
            )
        datums[name] = (u, v)
    return datums or None


def _show(output: Output, document: dict[str, Any]) -> None:
    focal = ", ".join(f"{x:.1f}" for x in document["focal_point_mm"])
    mirrored = ", a mirror image" if document["mirrored"] else ""
    output.say(f"view {document['view']}{mirrored}; focal point ({focal}) mm in CFCS")
    left, predicted = document["residual_rms_mm"], document["leave_one_out_rms_mm"]
    output.say(f"{len(document['beads'])} beads; residual {left:.3f} mm rms per axis, leave-one-out {predicted:.3f} mm")
    worst = sorted(document["beads"], key=lambda bead: -hypot(*(bead["leave_one_out_mm"] or (0.0, 0.0))))
    output.table(
        f"Beads with the largest leave-one-out errors (of {len(worst)}), mm on the reference plane",
        ("bead", "residual", "leave-one-out", "used"),
        [
            (
                bead["id"],
                f"{hypot(*bead['residual_mm']):.3f}",
                None if bead["leave_one_out_mm"] is None else f"{hypot(*bead['leave_one_out_mm']):.3f}",
                "yes" if bead["used"] else "no",
            )
            for bead in worst[:_SHOWN]
        ],
    )


# Colours (blue, green, red) of the marks drawn over the image.
_BEAD, _REJECTED = (80, 220, 80), (60, 60, 255)
_SCALE = 2  # of the picture, so that rings do not hide small beads


@command(commands, "detect", "sightline detect out/demo/demo_pa.dcm --picture out/beads.png")
def detect(
    output: Output,
    *,
    image: Annotated[Path, typer.Argument(help="Image file.")],
    frame_index: FrameIndex = None,
    invert: Invert = False,
    csv: Annotated[Path | None, typer.Option(help="Write the beads to this CSV file.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Write a PNG of the image with beads and rejected candidates marked.")
    ] = None,
) -> None:
    """Find the beads of one image.

    Gives centres with covariance, radii, and why candidates were rejected.
    """
    from sightline.detection import detect as find
    from sightline.detection.common_shape import shape_checks
    from sightline.imaging import image_checks, read_image

    radiograph = read_image(image, frame_index, invert=invert)
    with output.step("finding beads"):
        beads = find(radiograph)
    if csv is not None:
        _write_csv(beads, csv)
    if picture is not None:
        _write_picture(radiograph, beads, picture)
    _show_beads(output, beads)
    checks = (*image_checks(radiograph), *shape_checks(radiograph, beads.uv_px, beads.radius_px))
    output.result(_document(beads), checks)


def _document(beads: "Detections") -> dict[str, Any]:
    return {
        "image_shape": beads.image_shape,
        "beads": [
            {"uv_px": uv, "radius_px": r, "covariance_px2": c, "kind": k, "contrast": d}
            for uv, r, c, k, d in zip(
                beads.uv_px, beads.radius_px, beads.covariance_px2, beads.kind, beads.contrast, strict=True
            )
        ],
        "rejected": beads.rejected,
    }


def _show_beads(output: Output, beads: "Detections") -> None:
    output.table(
        f"{len(beads)} beads",
        ("u px", "v px", "radius px", "sd px", "kind"),
        [
            (f"{u:.2f}", f"{v:.2f}", f"{r:.2f}", f"{max(c[0, 0], c[1, 1]) ** 0.5:.3f}", k)
            for (u, v), r, c, k in zip(beads.uv_px, beads.radius_px, beads.covariance_px2, beads.kind, strict=True)
        ],
    )
    reasons = [candidate.reason for candidate in beads.rejected]
    counts = sorted(((reasons.count(reason), reason) for reason in set(reasons)), reverse=True)
    if counts:
        output.table(f"{len(reasons)} candidates rejected", ("count", "reason"), counts)


def _write_csv(beads: "Detections", path: Path) -> None:
    from sightline.common.atomic import write_whole

    rows = ["u_px,v_px,radius_px,suu_px2,suv_px2,svv_px2,kind,contrast"]
    for i, (u, v) in enumerate(beads.uv_px):
        c = beads.covariance_px2[i]
        numbers = (u, v, beads.radius_px[i], c[0, 0], c[0, 1], c[1, 1])
        rows.append(",".join([*(repr(float(n)) for n in numbers), beads.kind[i], repr(float(beads.contrast[i]))]))
    write_whole(path, ("\n".join(rows) + "\n").encode())


def _write_picture(radiograph: "Radiograph", beads: "Detections", path: Path) -> None:
    import cv2

    from sightline.case.report.radiographs import grey
    from sightline.common.atomic import write_whole

    height, width = radiograph.shape
    large = cv2.resize(grey(radiograph), (_SCALE * width, _SCALE * height), interpolation=cv2.INTER_LINEAR)
    shown = cv2.cvtColor(large, cv2.COLOR_GRAY2BGR)
    for (u, v), radius in zip(beads.uv_px, beads.radius_px, strict=True):
        cv2.circle(shown, _point(u, v), round(_SCALE * (radius + 3)), _BEAD, 2, cv2.LINE_AA)
    for candidate in beads.rejected:
        cv2.drawMarker(shown, _point(*candidate.uv_px), _REJECTED, cv2.MARKER_TILTED_CROSS, 5 * _SCALE)
    write_whole(path, cv2.imencode(".png", shown)[1].tobytes())


def _point(u: float, v: float) -> tuple[int, int]:
    """The pixel of the enlarged picture; its pixel (0, 0) is a quarter of ours."""
    return round(_SCALE * (u + 0.5) - 0.5), round(_SCALE * (v + 0.5) - 0.5)
