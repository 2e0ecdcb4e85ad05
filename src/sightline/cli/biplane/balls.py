"""`sightline balls`: the pose of a rigid body of balls in every frame of two runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.base import Invert, Output, command, commands
from sightline.cli.biplane.reconstruct import Views

if TYPE_CHECKING:
    from collections.abc import Generator

    from sightline.calibration.view import CalibratedView
    from sightline.detection import Detections
    from sightline.imaging import Radiograph
    from sightline.planning.points.body import BallBody, BodyPose

_HEADER = "frame,x_mm,y_mm,z_mm,qx,qy,qz,qw,sd_x_mm,sd_y_mm,sd_z_mm,sd_rx_rad,sd_ry_rad,sd_rz_rad,rms_mm,reason"
_MEASURED_SD_MM = 0.05  # [ours] of a body's balls whose file states no error: a caliper, or a CT of 0.3 mm voxels


@command(
    commands, "balls", "sightline balls out/cam1 out/cam2 --views views.json \\", "  --body body.csv --out poses.csv"
)
def balls(
    output: Output,
    *,
    runs: Annotated[list[Path], typer.Argument(help="A folder or multi-frame file for each view, in their order.")],
    views: Views,
    body: Annotated[
        Path | None,
        typer.Option(help="CSV of its balls: id, x_mm, y_mm, z_mm, sd_mm; by default learnt from the run."),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="FILE", help="CSV to write: a row for each frame.")],
    invert: Invert = False,
) -> None:
    """Follow a rigid body of balls through two runs.

    Writes its pose with errors. A frame whose pose is not certain has none, and a reason.
    """
    from sightline.case.saved.files import read_views
    from sightline.common.atomic import write_whole
    from sightline.errors import ReconstructionRefusedError, UnusableInputError
    from sightline.planning.points.body import BodyFinder, BodyPose

    known = read_views(views)
    finder = BodyFinder(known, None if body is None else _body(body))
    if len(runs) != 2:
        raise UnusableInputError(f"{len(runs)} runs are given; give one for each of the two views")
    with output.step("following the balls"):
        found = [finder.find(seen) for seen in _frames(runs, known, invert=invert)]
    if not found:
        raise UnusableInputError("the runs have no frames; copy them again")
    poses = [each for each in found if isinstance(each, BodyPose)]
    lines = [f"{k},{_row(each)}" for k, each in enumerate(found, 1)]
    write_whole(out, "\n".join([_HEADER, *lines, ""]).encode())
    output.say(f"{len(poses)} of {len(found)} frames have a pose")
    if not poses or finder.body is None:
        raise ReconstructionRefusedError(
            f"no frame shows the body; {out.name} says why for each: give the runs in the order of the views, without "
            "distortion and of the size of the calibrated images"
        )
    distances = _distances(finder.body, poses)
    title = "Distances between the balls, mm: mean and standard deviation over the frames"
    output.table(title, ("balls", "mean", "s.d."), [(a, f"{b:.3f}", f"{c:.3f}") for a, b, c in distances])
    precision = sum(sd**2 for _, _, sd in distances) ** 0.5 / len(distances) ** 0.5
    output.say(f"precision (s.d. of the distances, rms): {precision:.3f} mm")
    output.written([out])
    listed = [{"balls": a, "mean_mm": b, "sd_mm": c} for a, b, c in distances]
    output.result(
        {"frames": len(found), "poses": len(poses), "distances": listed, "precision_mm": precision, "file": out}
    )


def _body(path: Path) -> "BallBody":
    """Return the body in a table of measured balls. Raises FrameError, UnusableInputError."""
    import numpy as np

    from sightline.frame.tables import read_measurements
    from sightline.planning.points.body import BallBody

    series = read_measurements(path)[0]
    stated = series.covariance_mm2
    default = _MEASURED_SD_MM**2 * np.eye(3 * len(series.ids))
    return BallBody(series.ids, series.xyz_mm, default if stated is None else stated)


def _frames(runs: list[Path], views: "list[CalibratedView]", *, invert: bool) -> "Generator[list[Detections]]":
    """Yield the balls in both images of each frame.

    Raises UnusableInputError for runs of different lengths, and for images of another size than the views'.
    """
    from itertools import zip_longest

    from sightline.errors import UnusableInputError
    from sightline.imaging.sources import open_source

    for pair in zip_longest(*(open_source(str(run), invert=invert) for run in runs)):
        if None in pair:
            raise UnusableInputError("one run has fewer frames than the other; give the same frames of both")
        for view, frame in zip(views, pair, strict=True):
            wanted, given = getattr(view, "image_shape", None) or frame.image.shape, frame.image.shape
            if given != wanted:
                raise UnusableInputError(
                    f"an image has {given[1]} x {given[0]} pixels, view {view.name} is of {wanted[1]} x {wanted[0]}; "
                    "give the runs in the order of the views, as large as their images"
                )
        yield [_seen(frame.image) for frame in pair]


def _seen(image: "Radiograph") -> "Detections":
    """Return the balls of an image; none where none is found."""
    import numpy as np

    from sightline.detection import Detections, detect
    from sightline.errors import DetectionRefusedError

    try:
        found = detect(image)
    except DetectionRefusedError:
        return Detections(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2)), (), np.zeros(0), image.shape)
    return found


def _row(found: "BodyPose | str") -> str:
    """Return the cells of a frame."""
    import numpy as np

    if isinstance(found, str):
        return "," * 14 + found
    sd = np.sqrt(np.diag(found.covariance))
    mm, turns = [*found.centre_mm, *found.pose.rotation.as_quat(canonical=True)], [*sd[3:], *sd[:3], found.rms_mm]
    return ",".join(f"{x:.6f}" for x in [*mm, *turns]) + ","


def _distances(body: "BallBody", poses: "list[BodyPose]") -> list[tuple[str, float, float]]:
    """Return for each two balls the mean and the standard deviation of their distance, mm."""
    from itertools import combinations

    import numpy as np

    xyz = np.array([pose.xyz_mm for pose in poses])
    lengths = {(i, j): np.linalg.norm(xyz[:, i] - xyz[:, j], axis=1) for i, j in combinations(range(xyz.shape[1]), 2)}
    return [(f"{body.ids[i]}-{body.ids[j]}", float(d.mean()), float(d.std())) for (i, j), d in lengths.items()]
