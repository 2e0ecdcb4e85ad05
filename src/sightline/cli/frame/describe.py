"""What a frame is made of: as a document for JSON, and printed."""

from typing import TYPE_CHECKING, Any

from sightline.cli.base import Output

if TYPE_CHECKING:
    from sightline.frame import Frame
    from sightline.frame.plate import FrameView, Plate, RigidBody


def frame_document(frame: "Frame") -> dict[str, Any]:
    """Return a frame as a document for JSON."""
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
        "solid": None if frame.solid is None else solid_document(frame.solid),
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


def solid_document(solid: "RigidBody") -> dict[str, Any]:
    """Return the balls of a block, and where it may stand, as a document for JSON."""
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


def show_stands(output: Output, solid: dict[str, Any]) -> None:
    """Print a block's balls, and where it may stand."""
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


def show_frame(output: Output, frame: "Frame", document: dict[str, Any]) -> None:
    """Print what `frame_document` says of a frame."""
    title = f"Frame {frame.name}" + (f", serial {frame.serial}" if frame.serial else "")
    if document["solid"] is not None:
        output.say(title)
        show_stands(output, document["solid"])
        if (plate := document["detector"]) is not None:
            output.say(
                f"a plate of {plate['beads']} beads, {plate['stand_off_mm']:g} mm in front of the detector; datums "
                + " ".join(plate["datums"])
            )
    else:
        _show_frame_plates(output, title, document)
    show_tolerances(output, frame, document)
    if (use := frame.in_use) is not None:
        output.say(
            f"handling adds (1 s.d.): {use.warmer_k:g} K of heat, {100 * use.water_share:g} % of water, "
            f"{use.drape_n:g} N of drapes"
        )


def show_tolerances(output: Output, frame: "Frame", document: dict[str, Any]) -> None:
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
