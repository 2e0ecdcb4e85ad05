"""Interactive 3D drawing of the set-up: frame, focal points, lines of sight, wire, error ellipsoids."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from sightline.case.report import svg
from sightline.common.draw import round_down
from sightline.common.geometry.covariance import ellipsoid_factor
from sightline.common.geometry.planes import Plane

# Initial view: from the front, a little to the side and from above, so that both arms are visible [ours].
AZIMUTH_DEG, ELEVATION_DEG = -28.0, 20.0
WIDTH, HEIGHT, MARGIN = 540.0, 480.0, 30.0
AXIS_MM = 50.0
RING = 40  # points of an ellipse
NEAR_MM = 12.0  # approximate drawn size of an ellipsoid beside the wire, whatever its true size [ours]


@dataclass(frozen=True, eq=False)
class Shape:
    """A line, polygon, dot or label at points (N, 3), CFCS; `style`: its CSS class; `words`: its label or hint."""

    kind: str
    xyz_mm: np.ndarray
    style: str
    words: str = ""
    radius: float = 0.0  # of a circle; an attribute, because only browsers take a radius from CSS


def line(start_mm: np.ndarray, end_mm: np.ndarray, style: str, words: str = "") -> Shape:
    """Return a straight line."""
    return Shape("polyline", np.array([start_mm, end_mm]), style, words)


def dot(xyz_mm: np.ndarray, style: str, radius: float, words: str = "") -> Shape:
    """Return a round mark of constant `radius` on the page."""
    return Shape("circle", np.reshape(xyz_mm, (1, 3)), style, words, radius)


def label(xyz_mm: np.ndarray, words: str) -> Shape:
    """Return a label beside a point."""
    return Shape("text", np.reshape(xyz_mm, (1, 3)), "label", words)


def plate(xyz_mm: np.ndarray, style: str, words: str) -> list[Shape]:
    """Return the outline of a plate's beads (N, 3), and the beads."""
    plane = Plane.fit(xyz_mm)
    outline = xyz_mm[ConvexHull(plane.to_plane(xyz_mm)).vertices]
    return [Shape("polygon", outline, f"plate {style}", words), *beads(xyz_mm, style)]


def beads(xyz_mm: np.ndarray, style: str) -> list[Shape]:
    """Return beads (N, 3)."""
    return [dot(p, f"bead {style}", 1.7) for p in xyz_mm]


def magnification(covariances_mm2: np.ndarray, drawn_mm: float) -> float:
    """Return the magnification, 1, 2 or 5 times 10^k, at which the largest ellipsoid (N, 3, 3) is within `drawn_mm`."""
    largest = np.sqrt(np.linalg.eigvalsh(covariances_mm2).max()) * ellipsoid_factor(0.95, 3)
    return round_down(drawn_mm / max(largest, 1e-6))


def ellipsoid(centre_mm: np.ndarray, covariance_mm2: np.ndarray, times: float, words: str) -> list[Shape]:
    """Return the three principal ellipses of the 95 % ellipsoid, magnified `times`."""
    values, vectors = np.linalg.eigh(covariance_mm2)
    axes = vectors * np.sqrt(np.clip(values, 0.0, None)) * ellipsoid_factor(0.95, 3) * times
    angles = np.linspace(0.0, 2 * np.pi, RING)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    return [
        Shape("polyline", centre_mm + (axes[:, list(pair)] @ circle).T, "ellipsoid", words)
        for pair in ((0, 1), (0, 2), (1, 2))
    ]


def _page(xyz_mm: np.ndarray) -> np.ndarray:
    """Project points (N, 3), CFCS, to the page (N, 2): x right, y down, in mm. space.js uses the same formula."""
    a, e = np.radians([AZIMUTH_DEG, ELEVATION_DEG])
    x = xyz_mm[:, 0] * np.cos(a) - xyz_mm[:, 1] * np.sin(a)
    depth = xyz_mm[:, 0] * np.sin(a) + xyz_mm[:, 1] * np.cos(a)
    return np.stack([x, -xyz_mm[:, 2] * np.cos(e) - depth * np.sin(e)], axis=1)


def _drawn(shape: Shape, xy: np.ndarray) -> str:
    at = ";".join(",".join(svg.number(v) for v in p) for p in shape.xyz_mm)
    marks = {"class_": shape.style, "data_xyz": at}
    if shape.kind == "text":
        return svg.text(shape.words, xy[0, 0], xy[0, 1], **marks)
    hint = (svg.hint(shape.words),) if shape.words else ()
    if shape.kind == "circle":
        return svg.element("circle", *hint, cx=float(xy[0, 0]), cy=float(xy[0, 1]), r=shape.radius, **marks)
    return svg.element(shape.kind, *hint, points=svg.points(xy), **marks)


def _axes() -> Iterable[Shape]:
    for tip, words in zip(np.eye(3) * AXIS_MM, ("X lateral", "Y", "Z anterior"), strict=True):
        yield line(np.zeros(3), tip, "axis")
        yield label(tip * 1.08, words)


def space(shapes: Sequence[Shape], description: str) -> str:
    """Draw the shapes with CFCS axes of 50 mm at the origin; `space.js` rotates the drawing."""
    everything = [*shapes, *_axes()]
    points_mm = np.vstack([shape.xyz_mm for shape in everything])
    middle_mm = (points_mm.min(axis=0) + points_mm.max(axis=0)) / 2
    pages = [_page(shape.xyz_mm - middle_mm) for shape in everything]
    half = np.array([WIDTH, HEIGHT]) / 2
    scale = float(((half - MARGIN) / np.abs(np.vstack(pages)).max(axis=0)).min())
    drawn = [_drawn(shape, xy * scale + half) for shape, xy in zip(everything, pages, strict=True)]
    view = f"{AZIMUTH_DEG},{ELEVATION_DEG},{scale:.5f}"
    return svg.figure((0, 0, WIDTH, HEIGHT), description, drawn, class_="space", data_view=view)
