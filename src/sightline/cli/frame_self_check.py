"""`sightline frame self-check`: what several images of one frame say of it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.output import Json, Output, Quiet

if TYPE_CHECKING:
    from sightline.calibration.self_check import SelfCheck
    from sightline.detection import Observations
    from sightline.frame import Frame

_SHOWN = 8  # balls in the table; --json has them all
_UNSEEN = 0.9  # [ours] share of an error's s.d. left by the images above which they say nothing of it


def register(app: typer.Typer) -> None:
    """Add the command to `sightline frame`."""
    app.command("self-check")(self_check)


def self_check(
    images: Annotated[list[Path], typer.Argument(help="4 images or more, or observations as CSV; the C-arm moved.")],
    *,
    frame: Annotated[str, typer.Option(help="The frame in them: a file, or gamma, biplane, stereo.")] = "gamma",
    out: Annotated[Path | None, typer.Option(help="Write the frame as the images have it.")] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Measure a frame by its own images: balls beyond their tolerance, plates that are turned, what cannot be seen."""
    with Output(json=json, quiet=quiet) as output:
        from sightline.calibration.self_check import self_check as adjust
        from sightline.errors import FrameError
        from sightline.frame import Frame

        if out is not None and out.exists():
            raise FrameError(f"{out.name} exists; remove it, or name another file")
        known = Frame.load(frame)
        seen: list[Observations] = []
        with output.progress("finding and telling apart the beads", len(images)) as advance:
            for path in images:
                seen += _see(path, known)
                advance()
        with output.step("adjusting all images together"):
            found = adjust(seen, known)
        document = _document(found)
        _show(output, document)
        written = out if out is not None and all(check.passed for check in found.checks) else None
        if written is not None:
            found.frame.save(written)
            output.say(f"wrote {written}")
        output.result({"file": written, "images": len(seen), **document}, found.checks)


def _see(path: Path, frame: "Frame") -> "list[Observations]":
    """One view of an image; of observations in CSV all that the file holds."""
    if path.suffix.lower() == ".csv":
        from sightline.detection.files import read_observations

        return list(read_observations(path).values())
    from sightline.case.views import see

    return [see(path, frame).observations]


def _document(found: "SelfCheck") -> dict[str, Any]:
    from sightline.calibration.plate_motion import MOTIONS
    from sightline.frame.deviations import fiducials

    beside = found.in_plate
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
                fiducials(found.frame),
                found.images,
                found.moved_mm,
                beside.moved_mm,
                beside.prior_sd_mm,
                beside.sd_mm,
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
        ("ball", "images", "moved mm", "sd mm", "s.d. off"),
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
