"""`sightline frame fit | self-check`: a frame known by measured balls, or by images of itself."""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import ImagesFrame, Invert, Output, command, frame_of_images, refuse_existing
from sightline.cli.frame.make import app

if TYPE_CHECKING:
    from sightline.calibration.plates.self_check import SelfCheck
    from sightline.calibration.solids.self_check import KnownDistance, SolidSelfCheck
    from sightline.case.views import ObservedView
    from sightline.frame import Frame
    from sightline.frame.measured.fit import FittedFrame

_SHOWN = 8  # balls in the table; --json has them all


@dataclass(frozen=True)
class Conditions:
    """Which frame was measured, when, and how it is used."""

    serial: Annotated[str | None, typer.Option(help="Serial number of the frame.")] = None
    measured_on: Annotated[datetime | None, typer.Option(formats=["%Y-%m-%d"], help="Date of the measurement.")] = None
    temperature_c: Annotated[float | None, typer.Option(help="Temperature of the frame when it was measured, °C.")] = (
        None
    )
    use_temperature_c: Annotated[
        float | None, typer.Option(help="Temperature in use, °C; plates or block are scaled to it.")
    ] = None
    drift_mm: Annotated[
        float,
        typer.Option(
            help="Movement of a plate until it is used, 1 s.d. per axis, mm: heat, moisture, drapes. None for a block."
        ),
    ] = 0.05


@command(app, "fit", "sightline frame fit measured.csv --frame gamma --out gamma-07.json --serial 07")
def fit(
    output: Output,
    *,
    measurements: Annotated[Path, typer.Argument(help="CSV of measured balls (docs/own-frame.md).")],
    frame: Annotated[str, typer.Option(help="The frame as designed: a frame file, or a built-in one.")],
    out: Annotated[Path, typer.Option(help="Frame file to write.")],
    covariance: Annotated[
        Path | None, typer.Option(help="CSV with the full covariance of all coordinates, mm².")
    ] = None,
    conditions: Conditions,
) -> None:
    """Make a frame file from measured balls.

    The frame is adjusted to the measurements. Where a check fails, nothing is written (exit code 3).
    """
    from sightline.frame import Frame
    from sightline.frame.measured.fit import Circumstances, fit_frame
    from sightline.frame.tables import read_measurements

    refuse_existing(out)
    day = conditions.measured_on.date().isoformat() if conditions.measured_on else None
    circumstances = Circumstances(
        conditions.serial, day, conditions.temperature_c, conditions.use_temperature_c, conditions.drift_mm
    )
    nominal = Frame.load(frame)
    series = read_measurements(measurements, covariance)
    with output.step("adjusting the frame"):
        fitted = fit_frame(nominal, series, circumstances)
    document = _document(fitted)
    output.failures(fitted.checks)
    _show(output, document)
    if fitted.frame is not None:
        fitted.frame.save(out)
        if circumstances.growth:
            grown = f"from {conditions.temperature_c:g} to {conditions.use_temperature_c:g} °C"
            output.say(f"grown by {1e6 * circumstances.growth:.0f} ppm, {grown}")
        output.say(f"written: {out}")
    output.result({"file": out if fitted.frame else None, "growth": circumstances.growth, **document}, fitted.checks)


def _document(fitted: "FittedFrame") -> dict[str, Any]:
    document = {
        "series": [
            {
                "name": series.series,
                "mirrored": series.mirrored,
                "renamed": series.renamed,
                "astray_mm": series.astray_mm,
            }
            for series in fitted.identified
        ],
        "missing": fitted.missing,
    }
    adjusted = fitted.adjusted
    if adjusted is None or fitted.deviation_mm is None or fitted.sigma is None:
        return document
    import numpy as np

    sd = np.sqrt(np.diag(adjusted.covariance_mm2).reshape(-1, 3))
    return document | {
        "fle_mm": {
            "from_nominal_rms": float(np.sqrt((fitted.deviation_mm**2).sum(axis=1).mean())),
            "from_nominal_rms_per_axis": np.sqrt((fitted.deviation_mm**2).mean(axis=0)),
            "measured_rms": float(np.sqrt((sd**2).sum(axis=1).mean())),
            "measured_rms_per_axis": np.sqrt((sd**2).mean(axis=0)),
            "instrument_per_axis": adjusted.instrument_mm,
            "manufacturing_per_axis": float(np.sqrt(np.mean([p.manufacturing_mm**2 for p in fitted.plates]))),
        },
        "plates": [
            {
                "view": p.view,
                "plate": p.plate,
                "measured": p.measured,
                "shift_mm": p.shift_mm,
                "turn_rad": p.turn_rad,
                "growth_ppm": p.growth_ppm,
                "in_plane_rms_mm": p.in_plane_rms_mm,
                "across_rms_mm": p.across_rms_mm,
                "manufacturing_mm": p.manufacturing_mm,
            }
            for p in fitted.plates
        ],
        "balls": [
            {"id": ball, "xyz_mm": xyz, "deviation_mm": moved, "sd_mm": error, "sigma": float(sigma)}
            for ball, xyz, moved, error, sigma in zip(
                adjusted.ids, adjusted.xyz_mm, fitted.deviation_mm, sd, fitted.sigma, strict=True
            )
        ],
        "left_out": [{"series": series, "id": ball} for series, ball in adjusted.left_out],
    }


def _show(output: Output, document: dict[str, Any]) -> None:
    for series in document["series"]:
        if series["renamed"]:
            rows = list(series["renamed"].items())
            output.table(f"Series {series['name']}: ids that fit other balls", ("measured as", "fits"), rows)
    if "plates" not in document:
        return
    output.table(
        f"{'Solid' if document['plates'][0]['across_rms_mm'] is None else 'Plates'}, measured minus frame file",
        ("view", "plate", "balls", "shift mm", "rotation mrad", "growth ppm", "drilling mm", "across mm"),
        [
            (
                p["view"],
                p["plate"],
                p["measured"],
                " ".join(f"{x:+.3f}" for x in p["shift_mm"]),
                " ".join(f"{1e3 * x:+.2f}" for x in p["turn_rad"]),
                f"{p['growth_ppm']:+.0f}",
                f"{p['manufacturing_mm']:.4f}",
                None if p["across_rms_mm"] is None else f"{p['across_rms_mm']:.4f}",
            )
            for p in document["plates"]
        ],
    )
    output.table(
        f"Balls furthest from where the others put them (of {len(document['balls'])})",
        ("ball", "measured minus file mm", "sd mm", "off by s.d."),
        [
            (
                ball["id"],
                " ".join(f"{x:+.3f}" for x in ball["deviation_mm"]),
                " ".join(f"{x:.4f}" for x in ball["sd_mm"]),
                f"{ball['sigma']:.1f}",
            )
            for ball in sorted(document["balls"], key=lambda ball: -ball["sigma"])[:_SHOWN]
        ],
    )
    fle = document["fle_mm"]
    output.say(
        f"FLE: the balls are {fle['from_nominal_rms']:.3f} mm rms from the frame file and are now known to "
        f"{fle['measured_rms']:.4f} mm rms; drilling {fle['manufacturing_per_axis']:.4f} mm per axis"
    )
    if (instrument := fle["instrument_per_axis"]) is not None:
        output.say(f"the repeated measurements show an instrument error of {instrument:.4f} mm per axis")
    if missing := document["missing"]:
        output.say(f"not measured, positions computed from the other balls: {', '.join(missing)}")


_UNSEEN = 0.9  # an error whose s.d. the images leave above this share of its prior is not determined by them [ours]


@command(app, "self-check", "sightline frame self-check 1.dcm 2.dcm 3.dcm 4.dcm --frame gamma")
def self_check(
    output: Output,
    *,
    images: Annotated[
        list[Path], typer.Argument(help="4 or more images, or observations as CSV, with the C-arm moved between them.")
    ],
    frame: ImagesFrame = None,
    distance: Annotated[
        str | None,
        typer.Option(metavar="ID,ID,MM,SD", help="Of a block: a measured distance between two balls' centres, 1 s.d."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the frame as the images show it to this file.")] = None,
    invert: Invert = False,
) -> None:
    """Check a frame by several images of itself.

    Finds balls beyond their tolerance and rotated plates, and says which errors images cannot show. The balls of a
    block are measured, in images of a flat panel.
    """
    from sightline.calibration.plates.self_check import self_check as adjust
    from sightline.calibration.solids.self_check import SolidSelfCheck, self_check_solid

    refuse_existing(out)
    known = frame_of_images(output, frame)
    measured = None if known.solid is None else _distance(distance)
    seen: list[ObservedView] = []
    with output.progress("finding and labelling the beads", len(images)) as advance:
        for path in images:
            seen += _see(path, known, None if measured is None else f"image-{len(seen) + 1}", invert=invert)
            advance()
    with output.step("adjusting all images together"):
        beads = [view.observations for view in seen]
        if measured is None:
            checked = adjust(beads, known)
        else:
            from sightline.from_images.pipeline import known_arm

            checked = self_check_solid(beads, known, measured, [known_arm(view.image) for view in seen])
    output.failures(checked.checks)
    document = (
        _show_solid(output, checked)
        if isinstance(checked, SolidSelfCheck)
        else _show_plates(output, _self_check_document(checked))
    )
    written = out if out is not None and all(check.passed for check in checked.checks) else None
    if written is not None:
        checked.frame.save(written)
        output.say(f"written: {written}")
    output.result({"file": written, "images": len(seen), **document}, checked.checks)


def _distance(text: str | None) -> "KnownDistance":
    """Return the distance that gives a block its size. Raises BadParameter."""
    from sightline.calibration.solids.self_check import KnownDistance

    parts = (text or "").split(",")
    try:
        first, second, length, sd = parts
        return KnownDistance(first.strip(), second.strip(), float(length), float(sd))
    except ValueError:
        raise typer.BadParameter(
            "images of a block do not show its size; measure the distance between the centres of two balls and give it "
            "as ID,ID,MM,SD, for example b1,b4,55.23,0.02",
            param_hint="--distance",
        ) from None


def _see(path: Path, frame: "Frame", view: str | None, *, invert: bool) -> "list[ObservedView]":
    """Return the labelled beads of an image, or all views of a CSV file. `view`: the name of a block's image."""
    from sightline.case.views import ObservedView, see

    if path.suffix.lower() == ".csv":
        from sightline.detection.csv_files import read_observations

        return [ObservedView(path.name, observed) for observed in read_observations(path).values()]
    return [see(path, frame, view, invert=invert)]


def _show_solid(output: Output, checked: "SolidSelfCheck") -> dict[str, Any]:
    """Show the balls of a block and return them as a document."""
    columns = zip(checked.frame.fiducials, checked.images, checked.moved_mm, checked.sd_mm, strict=True)
    rows = [(f.id, int(count), moved, sd) for f, count, moved, sd in columns]
    output.table(
        "Balls against the file, after the rigid motion that fits best",
        ("ball", "images", "moved mm", "sd mm"),
        [
            (name, count, " ".join(f"{x:+.3f}" for x in moved), " ".join(f"{x:.3f}" for x in sd))
            for name, count, moved, sd in rows
        ],
    )
    balls = [{"id": name, "images": count, "moved_mm": moved, "sd_mm": sd} for name, count, moved, sd in rows]
    return {"balls": balls}


def _self_check_document(checked: "SelfCheck") -> dict[str, Any]:
    from sightline.calibration.plates.self_check import MOTIONS

    in_plate = checked.in_plate
    return {
        "misplaced": checked.misplaced,
        "focal_points_mm": checked.focal_points_mm,
        "plates": [
            {
                "view": pair.view,
                "motion": motion,
                "unit": "mm" if k < 3 else "mrad",
                "moved": moved * unit,
                "prior_sd": prior * unit,
                "sd": sd * unit,
                "seen": bool(sd < _UNSEEN * prior),
            }
            for pair in checked.pairs
            for k, (motion, moved, prior, sd) in enumerate(
                zip(MOTIONS, pair.moved.tolist(), pair.prior_sd.tolist(), pair.sd.tolist(), strict=True)
            )
            for unit in (1.0 if k < 3 else 1e3,)
        ],
        "balls": [
            {"id": f.id, "images": int(n), "moved_mm": all_, "in_plate_mm": moved, "prior_sd_mm": prior, "sd_mm": sd}
            | {"sigma": float(sigma)}
            for f, n, all_, moved, prior, sd, sigma in zip(
                checked.frame.fiducials,
                checked.images,
                checked.moved_mm,
                in_plate.moved_mm,
                in_plate.prior_sd_mm,
                in_plate.sd_mm,
                checked.sigma,
                strict=True,
            )
        ],
    }


def _show_plates(output: Output, document: dict[str, Any]) -> dict[str, Any]:
    output.table(
        "Source plate against XRII plate of each view, 1 s.d.",
        ("view", "motion", "", "found", "before", "after", ""),
        [
            (
                p["view"],
                p["motion"],
                p["unit"],
                f"{p['moved']:+.3f}" if p["seen"] else None,
                f"{p['prior_sd']:.3f}",
                f"{p['sd']:.3f}",
                "" if p["seen"] else "not seen",
            )
            for p in document["plates"]
        ],
    )
    output.table(
        f"Balls furthest from where the others put them (of {len(document['balls'])}), against their plate",
        ("ball", "images", "moved mm", "sd mm", "off by s.d."),
        [
            (
                ball["id"],
                ball["images"],
                " ".join(f"{x:+.3f}" for x in ball["in_plate_mm"]),
                " ".join(f"{x:.3f}" for x in ball["sd_mm"]),
                f"{ball['sigma']:.1f}",
            )
            for ball in sorted(document["balls"], key=lambda ball: -ball["sigma"])[:_SHOWN]
        ],
    )
    output.say(
        "Images show neither the scale of a frame, nor its views against each other, nor a plate's shift against its "
        "sister: these keep the error that the frame file states, however many images there are."
    )
    return document
