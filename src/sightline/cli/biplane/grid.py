"""`sightline grid`: the distortion map of an image of a dot grid or a perforated sheet."""

from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.base import FrameIndex, Invert, Output, command, commands


@command(commands, "grid", "sightline grid out/grid.dcm --pitch 10 --out out/map.json")
def grid(
    output: Output,
    *,
    image: Annotated[Path, typer.Argument(help="Image of the sheet on the intensifier's face.")],
    pitch: Annotated[float, typer.Option(help="Distance of nearest balls or holes, mm.")],
    out: Annotated[Path, typer.Option(help="File for the map, JSON.")],
    picture: Annotated[
        Path | None, typer.Option(help="Write a PNG of the image with the residual of each point as an arrow.")
    ] = None,
    frame_index: FrameIndex = None,
    invert: Invert = False,
) -> None:
    """Map an intensifier's distortion from a dot grid.

    Balls or holes stand on a square or hexagonal lattice, without ids (docs/biplane.md).
    """
    from sightline.calibration.maps.grid import map_grid
    from sightline.case.saved import save
    from sightline.common.atomic import write_whole
    from sightline.detection import detect
    from sightline.imaging import image_checks, read_image

    radiograph = read_image(image, frame_index, invert=invert)
    with output.step("finding the sheet"):
        found = map_grid(detect(radiograph), pitch)
    document = found.document()
    files = [save(found, out)]
    if picture is not None:
        files.append(write_whole(picture, found.png()))
    left_out = f", {found.left_out} left out" if found.left_out else ""
    output.say(f"{len(found.uv_px)} {found.kind}s on a {document['pattern']} lattice of {pitch:g} mm{left_out}")
    output.say(
        f"error of the map {document['sd_rms_px']:.3f} px rms per axis, at most {document['sd_max_px']:.3f} px (s.d.); "
        f"leave-one-out {document['leave_one_out_rms_px']:.3f} px; distortion up to "
        f"{document['largest_distortion_px']:.1f} px"
    )
    stated = radiograph.tags.imager_pixel_spacing_mm
    beside = "" if stated is None else f"; the file states {stated[1]:.4f} mm on the detector"
    output.say(f"an undistorted pixel is {found.spacing_mm:.4f} mm on the sheet: by --pitch alone{beside}")
    output.say("the map is of this zoom and place, on the sheet's plane, up to a similarity: it knows no depth")
    output.written(files)
    output.result({**document, "files": files}, image_checks(radiograph))
