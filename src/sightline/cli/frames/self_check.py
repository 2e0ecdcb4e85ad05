"""`sightline frame self-check`: check a frame by several images of itself."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.frames.frame import app
from sightline.cli.options import FrameName, Invert, command, refuse_existing
from sightline.cli.output import Output

if TYPE_CHECKING:
    from sightline.calibration.self_checks.plates import SelfCheck
    from sightline.calibration.self_checks.solid import KnownDistance, SolidSelfCheck
    from sightline.case.views import ObservedView
    from sightline.frame import Frame

_SHOWN = 8  # balls in the table; --json has them all
_UNSEEN = 0.9  # an error whose s.d. the images leave above this share of its prior is not determined by them [ours]


@command(app, "self-check", "sightline frame self-check 1.dcm 2.dcm 3.dcm 4.dcm --frame gamma")
def self_check(
    output: Output,
    *,
    images: Annotated[
        list[Path], typer.Argument(help="4 or more images, or observations as CSV, with the C-arm moved between them.")
    ],
    frame: FrameName = "gamma",
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
    from sightline.calibration.self_checks.plates import self_check as adjust
    from sightline.calibration.self_checks.solid import SolidSelfCheck, self_check_solid
    from sightline.frame import Frame

    refuse_existing(out)
    known = Frame.load(frame)
    measured = None if known.solid is None else _distance(distance)
    seen: list[ObservedView] = []
    with output.progress("finding and labelling the beads", len(images)) as advance:
        for path in images:
            seen += _see(path, known, None if measured is None else f"image-{len(seen) + 1}", invert=invert)
            advance()
    with output.step("adjusting all images together"):
        beads = [one.observations for one in seen]
        if measured is None:
            found = adjust(beads, known)
        else:
            from sightline.from_images.pipeline import known_arm

            found = self_check_solid(beads, known, measured, [known_arm(one.image) for one in seen])
    output.failures(found.checks)
    document = _show_solid(output, found) if isinstance(found, SolidSelfCheck) else _show(output, _document(found))
    written = out if out is not None and all(check.passed for check in found.checks) else None
    if written is not None:
        found.frame.save(written)
        output.say(f"written: {written}")
    output.result({"file": written, "images": len(seen), **document}, found.checks)


def _distance(text: str | None) -> "KnownDistance":
    """Return the distance that gives a block its size. Raises BadParameter."""
    from sightline.calibration.self_checks.solid import KnownDistance

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

        return [ObservedView(path.name, one) for one in read_observations(path).values()]
    return [see(path, frame, view, invert=invert)]


def _show_solid(output: Output, found: "SolidSelfCheck") -> dict[str, Any]:
    """Show the balls of a block and return them as a document."""
    columns = zip(found.frame.fiducials, found.images, found.moved_mm, found.sd_mm, strict=True)
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


def _document(found: "SelfCheck") -> dict[str, Any]:
    from sightline.calibration.self_checks.plate_motion import MOTIONS

    in_plate = found.in_plate
    return {
        "misplaced": found.misplaced,
        "focal_points_mm": found.focal_points_mm,
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
            for pair in found.pairs
            for k, (motion, moved, prior, sd) in enumerate(
                zip(MOTIONS, pair.moved.tolist(), pair.prior_sd.tolist(), pair.sd.tolist(), strict=True)
            )
            for unit in (1.0 if k < 3 else 1e3,)
        ],
        "balls": [
            {"id": f.id, "images": int(n), "moved_mm": all_, "in_plate_mm": moved, "prior_sd_mm": prior, "sd_mm": sd}
            | {"sigma": float(sigma)}
            for f, n, all_, moved, prior, sd, sigma in zip(
                found.frame.fiducials,
                found.images,
                found.moved_mm,
                in_plate.moved_mm,
                in_plate.prior_sd_mm,
                in_plate.sd_mm,
                found.sigma,
                strict=True,
            )
        ],
    }


def _show(output: Output, document: dict[str, Any]) -> dict[str, Any]:
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
