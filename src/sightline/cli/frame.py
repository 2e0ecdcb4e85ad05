"""`sightline frame new | show | check | draw`."""

from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import (
    FrameSource,
    ImagesFrame,
    Invert,
    Output,
    command,
    frame_of_images,
    group,
    refuse_existing,
)
from sightline.common.checks import failed

if TYPE_CHECKING:
    from sightline.calibration.plates.self_check import SelfCheck
    from sightline.calibration.solids.self_check import KnownDistance, SolidSelfCheck
    from sightline.case.views import ObservedView
    from sightline.frame import Frame
    from sightline.frame.measured.fit import FittedFrame
    from sightline.frame.plate import FrameView, Plate, RigidBody

app = group("frame", "Make, measure, draw and check frames.")


@dataclass(frozen=True)
class DesignOptions:
    """The values of a new frame that are not those of the frame that it is like."""

    rows: Annotated[
        int | None, typer.Option(help="Rows of balls on the XRII plate; the source plate has one more.")
    ] = None
    pitch_mm: Annotated[
        float | None, typer.Option(help="Distance between neighbouring balls on the XRII plate, mm.")
    ] = None
    xrii_mm: Annotated[
        float | None, typer.Option(help="Distance of the XRII plate from the hip, towards the intensifier, mm.")
    ] = None
    source_mm: Annotated[
        float | None, typer.Option(help="Distance of the source plate from the hip, mm; negative on the source side.")
    ] = None
    datums: Annotated[int | None, typer.Option(help="Number of datum markers on each plate.")] = None

    @property
    def stated(self) -> dict[str, Any]:
        """The values that are given, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def frame(self, name: str, like: str) -> "Frame":
        """Return a frame like a built-in one, or a copy of a block or of a file. Raises FrameError."""
        from sightline.errors import FrameError
        from sightline.frame import Frame
        from sightline.frame.designs import BUILTIN, builtin_design, patterns_for

        if like not in BUILTIN:
            copied = Frame.load(like)
            if self.stated:
                raise FrameError(
                    f"{like} is copied; rows, pitch, distances and datums are of {', '.join(BUILTIN)} alone"
                )
            return replace(copied, name=name)
        values = {"datums": 6, **self.stated}
        datums = values.pop("datums")
        design = replace(builtin_design(like), name=name, **values)
        patterns = patterns_for(design.beams, design.rows, datums, name)
        return Frame.from_design(replace(design, patterns=patterns))


_MAX_SD = 10.0  # mm or mrad [ours]: more is a wrong unit


@dataclass(frozen=True)
class ToleranceOptions:
    """How well a frame is made or known, 1 s.d. per axis."""

    bead_sd: Annotated[
        float | None,
        typer.Option(
            min=1e-4,
            max=_MAX_SD,
            metavar="MM",
            help="How far a ball may be from its place, 1 s.d. per axis, mm: 0.02 milled, 0.1 to 0.2 printed.",
        ),
    ] = None
    plate_sd: Annotated[
        str | None,
        typer.Option(
            metavar="MM,MRAD", help="The same of a plate as a whole: shift, mm, and rotation, mrad: 0.05,0.2."
        ),
    ] = None
    arm_sd: Annotated[
        str | None, typer.Option(metavar="MM,MRAD", help="The same of both plates of a view together.")
    ] = None

    def on(self, frame: "Frame") -> "Frame":
        """Return the frame with these tolerances; where one is not given, the frame's own, or the default.

        Raises BadParameter, and FrameError for a frame that states its errors otherwise or has no plates.
        """
        from sightline.errors import FrameError

        plates = {"plate": _pair(self.plate_sd, "--plate-sd"), "arm": _pair(self.arm_sd, "--arm-sd")}
        given = {} if self.bead_sd is None else {"bead_mm": self.bead_sd}
        for name, (mm, mrad) in ((name, pair) for name, pair in plates.items() if pair is not None):
            given |= {f"{name}_mm": mm, f"{name}_rad": 1e-3 * mrad}
        if not given:
            return frame
        if frame.covariance_mm2 is not None:
            raise FrameError("the balls' errors are stated already, as they were measured; leave the tolerances out")
        if frame.solid is not None and any(plates.values()):
            raise FrameError("a block has no plates and no arms; give --bead-sd alone")
        return replace(frame, tolerances=replace(frame.effective_tolerances, **given))


def _pair(text: str | None, option: str) -> tuple[float, float] | None:
    """Return the numbers of 'MM,MRAD'. Raises BadParameter."""
    if text is None:
        return None
    try:
        mm, mrad = (float(part) for part in text.split(","))
    except ValueError:
        mm = mrad = -1.0
    if not (0 <= mm <= _MAX_SD and 0 <= mrad <= _MAX_SD):
        raise typer.BadParameter(
            f"{text!r} is not MM,MRAD, each from 0 to {_MAX_SD:g}; write for example 0.1,0.7", param_hint=option
        )
    return mm, mrad


@command(app, "new", "sightline frame new mine.json --like block60 --bead-sd 0.1")
def new(
    output: Output,
    *,
    file: Annotated[Path, typer.Argument(help="The frame file to write.")],
    like: Annotated[
        str,
        typer.Option(
            help="Built-in frame that gives the beams and every value not stated here; or a block or a frame file, "
            "whose balls are copied."
        ),
    ] = "gamma",
    design: DesignOptions,
    tolerances: ToleranceOptions,
    csv: Annotated[
        Path | None,
        typer.Option(
            help="Table of measured balls, or frame specification of XMALab, instead of the values above "
            "(docs/frame-file.md)."
        ),
    ] = None,
    diameter_mm: Annotated[
        float | None, typer.Option(help="Diameter of the balls of a frame specification of XMALab, mm; default 3.")
    ] = None,
    units: Annotated[
        str | None, typer.Option(help="Unit of a frame specification of XMALab, mm or cm; default by its size.")
    ] = None,
) -> None:
    """Write a frame file.

    The frame is made from a few values or from a table of measured balls. It is checked first: where a check fails,
    nothing is written (exit code 3).
    """
    from sightline.errors import FrameError
    from sightline.frame.check import check_frame
    from sightline.frame.designs import BUILTIN
    from sightline.frame.tables import frame_from_csv

    refuse_existing(file)
    if csv is not None and design.stated:
        raise FrameError("--csv states the whole frame; leave out the other values")
    if csv is None and (diameter_mm is not None or units is not None):
        raise FrameError("--diameter-mm and --units hold for --csv alone; leave them out")
    with output.step("making the frame"):
        if csv is None:
            frame = design.frame(file.stem, like)
        else:
            frame = frame_from_csv(csv, file.stem, diameter_mm, units)
    frame = tolerances.on(frame)
    checks = check_frame(frame)
    sound = not failed(checks)
    if sound:
        frame.save(file)
    output.say(f"written: {file}" if sound else f"{file} was not written: a check failed")
    if csv is None and like in BUILTIN:
        output.say(f"its datum balls are not those of {like}: make it from `sightline frame draw {file}`")
    document = _frame_document(frame)
    _show_tolerances(output, frame, document)
    output.result({"file": file if sound else None, **document}, checks)


@command(app, "show", "sightline frame show gamma --picture out/plates.png")
def show(
    output: Output,
    *,
    frame: FrameSource,
    picture: Annotated[
        Path | None, typer.Option(help="Write a PNG of the plates, or of the block's faces, to this file.")
    ] = None,
) -> None:
    """Show plates, datums, tolerances and reach of a frame.

    Of a block: its balls, and where it may stand.
    """
    from sightline.frame import Frame

    loaded = Frame.load(frame)
    document = _frame_document(loaded)
    _show_frame(output, loaded, document)
    if picture is not None:
        from sightline.frame.drawings.picture import draw_frame

        draw_frame(loaded, picture)
        output.say(f"written: {picture}")
    output.result(document)


@command(app, "check", "sightline frame check gamma")
def check(
    output: Output,
    *,
    frame: FrameSource,
    before: Annotated[
        str | None, typer.Option(help="Earlier file of the same frame: fail if the new one is its mirror image.")
    ] = None,
) -> None:
    """Check a frame.

    Exit code 3 if a check fails. Of a block, it also says where it may stand.
    """
    from sightline.frame import Frame
    from sightline.frame.check import before_check, check_frame

    loaded = Frame.load(frame)
    checks = check_frame(loaded)
    if before is not None:
        checks += (before_check(loaded, Frame.load(before)),)
    solid = None if loaded.solid is None else _solid_document(loaded.solid)
    if solid is not None:
        _show_stands(output, solid)
    output.result({"frame": loaded.key, "solid": solid}, checks)


@command(app, "draw", "sightline frame draw gamma --out out/drawings")
def draw(
    output: Output,
    *,
    frame: FrameSource,
    out: Annotated[Path, typer.Option(help="Folder for the files.")],
    clearance_mm: Annotated[
        float,
        typer.Option(help="Added to the bores' diameters in the STL, mm: 0.2 for FDM, 0.1 for SLA.", min=0, max=1),
    ] = 0.0,
) -> None:
    """Write the drawings that a workshop needs.

    SVG and DXF of each plate or face, STL, an assembly picture, a bill of material and an inspection sheet.
    """
    from sightline.frame import Frame
    from sightline.frame.drawings.part import parts_of
    from sightline.frame.drawings.workshop import bill_rows, write_workshop

    loaded = Frame.load(frame)
    with output.step("drawing the parts"):
        files = write_workshop(loaded, out, clearance_mm)
    parts = parts_of(loaded)
    output.table("Bill of material", ("item", "number", "material", "remark"), bill_rows(parts))
    output.say(f"written: {len(files)} files in {out}")
    document = [
        {
            "plate": part.name,
            "width_mm": part.width_mm,
            "height_mm": part.height_mm,
            "thickness_mm": part.thickness_mm,
            "bores": len(part.bores),
            "position_tolerance_mm": part.position_mm,
        }
        for part in parts
    ]
    output.result({"files": files, "parts": document})


def _frame_document(frame: "Frame") -> dict[str, Any]:
    from sightline.frame.plate import ROLES

    source = "the frame file" if frame.tolerances else "the defaults: the frame file states none"
    return {
        "name": frame.name,
        "serial": frame.serial,
        "measured_on": frame.measured_on,
        "temperature_c": frame.temperature_c,
        "tolerances": None if frame.covariance_mm2 is not None else frame.effective_tolerances,
        "tolerances_from": source if frame.covariance_mm2 is None else "the covariance in the frame file",
        "in_use": frame.in_use,
        "plates": [
            _plate_document(name, role, view, getattr(view, role))
            for name, view in frame.views.items()
            for role in ROLES
        ],
        "solid": None if frame.solid is None else _solid_document(frame.solid),
        "detector": None
        if frame.detector is None
        else {
            "beads": len(frame.detector.ids),
            "datums": [f.id for f in frame.detector.fiducials if f.datum],
            "stand_off_mm": float(frame.detector.xyz_mm[:, 2].mean()),
        },
    }


def _plate_document(name: str, role: str, view: "FrameView", plate: "Plate") -> dict[str, Any]:
    from sightline.errors import UnusableInputError
    from sightline.frame.check import reach_mm

    try:
        normal, reach = plate.plane.normal, reach_mm(view, plate)
    except UnusableInputError:  # the beads are on one line; `frame check` reports it
        normal = reach = None
    return {
        "view": name,
        "plate": role,
        "beads": len(plate.ids),
        "datums": [f.id for f in plate.fiducials if f.datum],
        "middle_mm": plate.xyz_mm.mean(axis=0),
        "normal": normal,
        "reach_mm": reach,
    }


def _solid_document(solid: "RigidBody") -> dict[str, Any]:
    from collections import Counter

    import numpy as np

    from sightline.frame.solid_shape import FIELDS_MM, clear_beads, offset_mm, radius_mm

    clear = clear_beads(solid)
    return {
        "beads": len(solid.ids),
        "diameters_mm": dict(sorted(Counter(f.diameter_mm for f in solid.fiducials).items())),
        "size_mm": np.ptp(solid.xyz_mm, axis=0),
        "radius_mm": radius_mm(solid),
        "clear_mean": float(clear.mean()),
        "clear_worst": int(clear.min()),
        "stands": [
            {"detector": name, "field_mm": field, "offset_mm": offset_mm(solid, field)}
            for name, field in FIELDS_MM.items()
        ],
    }


def _show_stands(output: Output, solid: dict[str, Any]) -> None:
    sizes = ", ".join(f"{number} of {diameter:g} mm" for diameter, number in solid["diameters_mm"].items())
    output.say(f"a solid of {solid['beads']} beads: {sizes}")
    output.say(
        f"their centres span {' x '.join(f'{mm:g}' for mm in solid['size_mm'])} mm; radius {solid['radius_mm']:.1f} mm"
    )
    output.say(
        f"clear of each other: {solid['clear_mean']:.1f} beads on average over all directions, "
        f"{solid['clear_worst']} from the worst"
    )
    output.table(
        "Where it may stand at the hip, however it is turned, with all beads in the image",
        ("detector", "field mm", "middle within, mm of the beam's axis", "field left beside it, mm"),
        [
            (
                place["detector"],
                f"{place['field_mm']:g}",
                "does not fit" if place["offset_mm"] < 0 else f"{place['offset_mm']:.0f}",
                None if place["offset_mm"] < 0 else f"{2 * place['offset_mm']:.0f}",
            )
            for place in solid["stands"]
        ],
    )


def _show_frame(output: Output, frame: "Frame", document: dict[str, Any]) -> None:
    title = f"Frame {frame.name}" + (f", serial {frame.serial}" if frame.serial else "")
    if document["solid"] is not None:
        output.say(title)
        _show_stands(output, document["solid"])
        if (plate := document["detector"]) is not None:
            output.say(
                f"a plate of {plate['beads']} beads, {plate['stand_off_mm']:g} mm in front of the detector; datums "
                + " ".join(plate["datums"])
            )
    else:
        _show_frame_plates(output, title, document)
    _show_tolerances(output, frame, document)
    if (use := frame.in_use) is not None:
        output.say(
            f"handling adds (1 s.d.): {use.warmer_k:g} K of heat, {100 * use.water_share:g} % of water, "
            f"{use.drape_n:g} N of drapes"
        )


def _show_tolerances(output: Output, frame: "Frame", document: dict[str, Any]) -> None:
    """Print the tolerances in a line, and where they are from."""
    sd, known = document["tolerances"], ""
    if sd is not None:
        known = f": bead {sd.bead_mm:g} mm"
        if frame.solid is None:
            plate, arm = ((mm, 1e3 * rad) for mm, rad in ((sd.plate_mm, sd.plate_rad), (sd.arm_mm, sd.arm_rad)))
            known += f"; plate {plate[0]:g} mm, {plate[1]:g} mrad; arm {arm[0]:g} mm, {arm[1]:g} mrad"
    output.say(f"tolerances (1 s.d. per axis), from {document['tolerances_from']}{known}")


def _show_frame_plates(output: Output, title: str, document: dict[str, Any]) -> None:
    output.table(
        title,
        ("view", "plate", "beads", "datums", "middle, CFCS mm", "reach mm"),
        [
            (
                plate["view"],
                plate["plate"],
                plate["beads"],
                " ".join(plate["datums"]),
                " ".join(f"{value:.1f}" for value in plate["middle_mm"]),
                None if plate["reach_mm"] is None else f"{plate['reach_mm']:.1f}",
            )
            for plate in document["plates"]
        ],
    )
    output.say("reach: how far the ends of a 95 mm wire at 45° may move at the hip inside the beads' convex hull")


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
    told = Circumstances(
        conditions.serial, day, conditions.temperature_c, conditions.use_temperature_c, conditions.drift_mm
    )
    nominal = Frame.load(frame)
    series = read_measurements(measurements, covariance)
    with output.step("adjusting the frame"):
        fitted = fit_frame(nominal, series, told)
    document = _document(fitted)
    output.failures(fitted.checks)
    _show(output, document)
    if fitted.frame is not None:
        fitted.frame.save(out)
        if told.growth:
            grown = f"from {conditions.temperature_c:g} to {conditions.use_temperature_c:g} °C"
            output.say(f"grown by {1e6 * told.growth:.0f} ppm, {grown}")
        output.say(f"written: {out}")
    output.result({"file": out if fitted.frame else None, "growth": told.growth, **document}, fitted.checks)


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
