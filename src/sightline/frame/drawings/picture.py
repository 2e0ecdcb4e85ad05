"""A picture of a frame's plates, or of its solid's faces, for manufacture and mounting."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from sightline.common.atomic import write_whole
from sightline.common.geometry.lines import unit
from sightline.frame.drawings.part import Part, faces_of
from sightline.frame.model import Frame
from sightline.frame.plate import ROLES, Fiducial, Plate

_ORDINARY, _DATUM, _EDGE = "#4c78a8", "#d62728", "#8a8f98"
_PANEL_INCHES = 5.5
_MANY = 20  # balls of a panel with small names
_TOWARDS = np.array([0.62, -0.64, 0.46])  # from the solid to the eye of its picture: to the faces +X, -Y and +Z


def draw_frame(frame: Frame, path: str | Path) -> None:
    """Write a PNG of the plates, viewed against their normals, balls to scale, datums filled; or of a solid's faces.

    Raises UnusableInputError.
    """
    write_whole(path, frame_png(frame))


def frame_png(frame: Frame) -> bytes:
    """Return the PNG of `draw_frame`."""
    columns = len(frame.views) if frame.solid is None else 4 if frame.detector is None else 6
    figure = Figure(figsize=(_PANEL_INCHES * columns, 2 * _PANEL_INCHES), layout="constrained")
    if frame.solid is not None:
        faces = faces_of(frame.solid)
        beside = ["whole"] if frame.detector is None else ["whole", "plate", "plate"]
        panels = figure.subplot_mosaic([["+X", "+Y", "+Z", *beside], ["-X", "-Y", "-Z", *beside]])
        for face in faces:
            _draw_face(panels[face.front], face)
        _draw_whole(panels["whole"], faces)
        if frame.detector is not None:
            _draw_plate(panels["plate"], frame.detector, "plate on the detector")
    else:
        for column, (name, view) in zip(figure.subplots(2, columns, squeeze=False).T, frame.views.items(), strict=True):
            for axes, role in zip(column, ROLES, strict=True):
                _draw_plate(axes, getattr(view, role), f"{name}, {'XRII' if role == 'xrii' else 'source'} plate")
    figure.suptitle(f"Frame {frame.name}" + (f", serial {frame.serial}" if frame.serial else ""))
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _draw_plate(axes: Axes, plate: Plate, title: str) -> None:
    plane = plate.plane
    _draw_balls(axes, plate.fiducials, plate.xyz_mm @ plane.axes.T)
    axes.set_title(f"{title}: {len(plate.ids)} balls, {plate.is_datum.sum()} datums")
    axes.set_xlabel(_axis_name(plane.axes[0]))
    axes.set_ylabel(_axis_name(plane.axes[1]))


def _draw_face(axes: Axes, face: Part) -> None:
    """Draw a face of a solid as its workshop drawing has it, with the balls that are bored from it."""
    axes.add_patch(Polygon(face.outline, fill=False, edgecolor=_EDGE))
    _draw_balls(axes, [b.ball for b in face.bores], np.array([(b.x_mm, b.y_mm) for b in face.bores]).reshape(-1, 2))
    axes.set_title(f"{face.title}: {len(face.bores)} balls")
    axes.set_xlabel(f"towards {face.right}, from the corner (mm)")
    axes.set_ylabel(f"towards {face.up} (mm)")


def _draw_whole(axes: Axes, faces: Sequence[Part]) -> None:
    """Draw the solid in parallel projection, the balls of the three faces in front filled."""
    towards = unit(_TOWARDS)
    right = unit(np.cross([0.0, 0.0, 1.0], towards))
    onto = np.array([right, np.cross(towards, right)]).T
    for face in sorted(faces, key=lambda part: part.axes[2] @ towards):
        before = bool(face.axes[2] @ towards > 0)
        corners = face.corner_mm + np.array(face.outline) @ face.axes[:2]
        axes.add_patch(Polygon(corners @ onto, fill=False, edgecolor=_EDGE, linestyle="-" if before else ":"))
        for bore in face.bores:
            at = np.array(bore.ball.xyz_mm) @ onto
            axes.add_patch(
                Circle(tuple(at), bore.ball.diameter_mm / 2, facecolor=_ORDINARY if before else "none",
                       edgecolor=_ORDINARY, alpha=1.0 if before else 0.5)
            )  # fmt: skip
            if before:
                _name(axes, bore.ball, at, 9, "normal")
        if before:
            x, y = (corners.mean(axis=0) @ onto).tolist()
            axes.text(x, y, face.front, color=_EDGE, size=22, ha="center", va="center")
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()
    axes.set_title("assembly: balls of the faces in front are filled")


def _draw_balls(axes: Axes, fiducials: Sequence[Fiducial], xy_mm: np.ndarray) -> None:
    balls = [Circle((x, y), f.diameter_mm / 2) for (x, y), f in zip(xy_mm, fiducials, strict=True)]
    colours = [_DATUM if f.datum else "white" for f in fiducials]
    edges = [_DATUM if f.datum else _ORDINARY for f in fiducials]
    axes.add_collection(PatchCollection(balls, facecolors=colours, edgecolors=edges))
    for (x, y), f in zip(xy_mm, fiducials, strict=True):
        _name(axes, f, (x, y), 5 if len(fiducials) > _MANY else 9, "bold" if f.datum else "normal")
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.margins(0.06)


def _name(axes: Axes, ball: Fiducial, at: Sequence[float] | np.ndarray, size: float, weight: str) -> None:
    """Write a ball's id above it."""
    top = float(at[0]), float(at[1]) + ball.diameter_mm / 2
    axes.annotate(ball.id, top, (0, 2), textcoords="offset points", ha="center", size=size, weight=weight)


def _axis_name(axis: np.ndarray) -> str:
    leading = int(np.argmax(np.abs(axis)))
    return f"{'-' if axis[leading] < 0 else ''}{'XYZ'[leading]} of CFCS (mm)"
