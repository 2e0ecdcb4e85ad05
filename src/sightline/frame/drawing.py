"""A picture of a frame's plates, for manufacture and mounting."""

from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from sightline.atomic import write_whole
from sightline.frame.model import Frame
from sightline.frame.plate import ROLES, Plate

_ORDINARY, _DATUM = "#4c78a8", "#d62728"
_PANEL_INCHES = 5.5


def draw_frame(frame: Frame, path: str | Path) -> None:
    """Write a PNG of the plates, viewed against their normals, balls to scale, datums filled.

    Raises UnusableInputError.
    """
    figure = Figure(figsize=(_PANEL_INCHES * len(frame.views), 2 * _PANEL_INCHES), layout="constrained")
    panels = figure.subplots(2, len(frame.views), squeeze=False)
    for column, (name, view) in zip(panels.T, frame.views.items(), strict=True):
        for axes, role in zip(column, ROLES, strict=True):
            _draw_plate(axes, getattr(view, role), f"{name}, {'XRII' if role == 'xrii' else 'source'} plate")
    figure.suptitle(f"Frame {frame.name}" + (f", serial {frame.serial}" if frame.serial else ""))
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_whole(path, buffer.getvalue())


def _draw_plate(axes: Axes, plate: Plate, title: str) -> None:
    plane = plate.plane
    xy = plate.xyz_mm @ plane.axes.T
    balls = [Circle((x, y), f.diameter_mm / 2) for (x, y), f in zip(xy, plate.fiducials, strict=True)]
    colours = [_DATUM if f.datum else "white" for f in plate.fiducials]
    edges = [_DATUM if f.datum else _ORDINARY for f in plate.fiducials]
    axes.add_collection(PatchCollection(balls, facecolors=colours, edgecolors=edges))
    for (x, y), f in zip(xy, plate.fiducials, strict=True):
        weight = "bold" if f.datum else "normal"
        axes.annotate(f.id, (x, y), (0, 7), textcoords="offset points", ha="center", size=5, weight=weight)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.margins(0.06)
    axes.set_title(f"{title}: {len(plate.ids)} balls, {plate.is_datum.sum()} datums")
    axes.set_xlabel(_axis_name(plane.axes[0]))
    axes.set_ylabel(_axis_name(plane.axes[1]))


def _axis_name(axis: np.ndarray) -> str:
    leading = int(np.argmax(np.abs(axis)))
    return f"{'-' if axis[leading] < 0 else ''}{'XYZ'[leading]} of CFCS (mm)"
