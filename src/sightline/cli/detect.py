"""`sightline detect`: find the beads of one image."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.options import FrameIndex, Invert, command, commands
from sightline.cli.output import Output

if TYPE_CHECKING:
    from sightline.detection import Detections
    from sightline.imaging import Radiograph

# Colours (blue, green, red) of the marks drawn over the image.
_BEAD, _REJECTED = (80, 220, 80), (60, 60, 255)
_SCALE = 2  # of the picture, so that rings do not hide small beads


@command(commands, "detect", "sightline detect out/demo/demo_pa.dcm --picture out/beads.png")
def detect(
    out: Output,
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
    from sightline.imaging import image_checks, read_image

    radiograph = read_image(image, frame_index, invert=invert)
    with out.step("finding beads"):
        beads = find(radiograph)
    if csv is not None:
        _write_csv(beads, csv)
    if picture is not None:
        _write_picture(radiograph, beads, picture)
    _show(out, beads)
    out.result(_document(beads), image_checks(radiograph))


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


def _show(out: Output, beads: "Detections") -> None:
    out.table(
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
        out.table(f"{len(reasons)} candidates rejected", ("count", "reason"), counts)


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
