"""`sightline frame self-check`: check a frame by several images of itself."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.detect import Invert
from sightline.cli.output import Json, Output, Quiet, example

if TYPE_CHECKING:
    from sightline.calibration.self_check import SelfCheck
    from sightline.detection import Observations
    from sightline.frame import Frame

_SHOWN = 8  # balls in the table; --json has them all
_UNSEEN = 0.9  # an error whose s.d. the images leave above this share of its prior is not determined by them [ours]


def register(app: typer.Typer) -> None:
    """Add the command to `sightline frame`."""
    epilog = example("sightline frame self-check 1.dcm 2.dcm 3.dcm 4.dcm --frame gamma")
    app.command("self-check", epilog=epilog)(self_check)


def self_check(
    images: Annotated[
        list[Path], typer.Argument(help="4 or more images, or observations as CSV, with the C-arm moved between them.")
    ],
    *,
    frame: Annotated[
        str, typer.Option(help="The frame in the images: a frame file, gamma, biplane or stereo.")
    ] = "gamma",
    out: Annotated[Path | None, typer.Option(help="Write the frame as the images show it to this file.")] = None,
    invert: Invert = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Check a frame by several images of itself.

    Finds balls beyond their tolerance and rotated plates, and says which errors images cannot show.
    """
    with Output(json=json, quiet=quiet) as output:
        from sightline.calibration.self_check import NEEDS_PLATES
        from sightline.calibration.self_check import self_check as adjust
        from sightline.errors import FrameError
        from sightline.frame import Frame

        if out is not None and out.exists():
            raise FrameError(f"{out.name} exists; remove it, or name another file")
        known = Frame.load(frame)
        known.refuse_solid(NEEDS_PLATES)
        seen: list[Observations] = []
        with output.progress("finding and labelling the beads", len(images)) as advance:
            for path in images:
                seen += _see(path, known, invert=invert)
                advance()
        with output.step("adjusting all images together"):
            found = adjust(seen, known)
        document = _document(found)
        output.failures(found.checks)
        _show(output, document)
        written = out if out is not None and all(check.passed for check in found.checks) else None
        if written is not None:
            found.frame.save(written)
            output.say(f"written: {written}")
        output.result({"file": written, "images": len(seen), **document}, found.checks)


def _see(path: Path, frame: "Frame", *, invert: bool) -> "list[Observations]":
    """Return the labelled beads of an image, or all views of a CSV file."""
    if path.suffix.lower() == ".csv":
        from sightline.detection.files import read_observations

        return list(read_observations(path).values())
    from sightline.case.views import see

    return [see(path, frame, invert=invert).observations]


def _document(found: "SelfCheck") -> dict[str, Any]:
    from sightline.calibration.plate_motion import MOTIONS

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


def _show(output: Output, document: dict[str, Any]) -> None:
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
