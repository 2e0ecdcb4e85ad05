"""The 3-D scene: its objects as plain data (mm, CFCS), and the surface of a bone. Its worker needs no NiceGUI.

Kinds: spheres, points, lines, mesh, picture, ellipsoid, cylinder, label, axes, note. `style` names a style in
space_objects.js. `reach` is "hip", "frame" (the default) or "room": the smallest view that includes the object.
"""

from base64 import b64encode
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.ndimage import binary_fill_holes, gaussian_filter
from scipy.spatial import ConvexHull
from scipy.spatial.transform import RigidTransform

from sightline.app.session.rehearsing import Patient, rehearsal_of
from sightline.calibration.view import CalibratedView
from sightline.case.report.scene import NEAR_MM, magnification
from sightline.common.geometry.covariance import ellipsoid_factor
from sightline.frame import Frame
from sightline.frame.plate import Plate, RigidBody
from sightline.imaging import Radiograph
from sightline.planning import Trajectory
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.kinematics.reach import part_axes

if TYPE_CHECKING:
    from sightline.imaging.volumes.volume import Volume

Object = dict[str, Any]

PICTURE_PX = 256  # [ours] longest side of an image in the scene; the X-ray views show the detail
PICTURE_CELLS = 16  # [calc] across a plate; a pincushion distortion of 5 % deviates 0.05 mm within one cell
PICTURE_PERCENTILES = (1.0, 99.0)  # shown as black and white
ROUND_DECIMALS = 2  # 0.01 mm is less than a pixel of the scene
TOOL_RADIUS_MM = 2.5  # [calc] twice that of a guide wire of 2.5 mm, for visibility
GUIDE_RADIUS_MM = 8.0  # of a drill guide and its holder, as they are drawn [ours]
PART_SHARE = 0.4  # of the radius for the collision check: the parts as they look, without the clearance [ours]
WIRE_BEHIND_MM = 200.0  # drawn behind the tip on the robot: the length of the wire [paper]
# Length of the drawn axes of CFCS, between wire and plates, and distance of the side labels from the hip, beside it and
# within the frame, so that neither hides another thing [ours].
AXIS_MM, SIDE_LABELS_MM = 40.0, 130.0

SIDES = {
    "right": {"lateral": (1, 0, 0), "medial": (-1, 0, 0), "caudal": (0, 1, 0), "cranial": (0, -1, 0)},
    "left": {"lateral": (1, 0, 0), "medial": (-1, 0, 0), "cranial": (0, 1, 0), "caudal": (0, -1, 0)},
}
UPRIGHT = {"anterior": (0, 0, 1), "posterior": (0, 0, -1)}


def frame_objects(frame: Frame) -> list[Object]:
    """Return the plates' outlines, the balls at their true size, and rings around the datum markers."""
    made: list[Object] = []
    for name, view in frame.views.items():
        for plate in (view.xrii, view.source):
            outline = _outline(plate)
            made.append({"kind": "lines", "style": name, "lines": [_list([*outline, outline[0]])]})
            made.append(_balls(plate, name))
            rings = [_ring(f.xyz_mm, 1.6 * f.diameter_mm, plate) for f in plate.fiducials if f.datum]
            made.append({"kind": "lines", "style": "quiet", "lines": rings})
    return made if frame.solid is None else [*made, _balls(frame.solid, "pa")]


def view_objects(view: CalibratedView, plate: Plate | None, image: Radiograph) -> list[Object]:
    """Return the focal point of a view, its rays through the corners of its XRII `plate`, and the image on that
    plate; of a view of a solid, which has no plate, the focal point."""
    focus = view.focal_point_mm
    made: list[Object] = [
        {"kind": "spheres", "style": view.name, "at": [_list(focus)], "radius": 4.0, "reach": "room"},
        _label(focus, f"focal point, {view.name}", view.name),
    ]
    if plate is None:
        return made
    outline = _outline(plate)
    made += [
        {
            "kind": "lines",
            "style": "quiet",
            "lines": [_list([focus, p]) for p in _corners(outline, plate)],
            "reach": "room",
        },
    ]
    return [*made, *_picture(view, plate, image)]


def sight_objects(view: CalibratedView, uv_px: np.ndarray) -> list[Object]:
    """Return the lines of sight of picks (N, 2) px, from the focal point to the reference plane. Raises
    OutsideRegionError."""
    if not len(uv_px):
        return []
    rays = view.lines_of_sight(np.asarray(uv_px, dtype=np.float64))
    lines = [_list([rays.focal_point_mm, point]) for point in rays.points_mm]
    return [{"kind": "lines", "style": view.name, "lines": lines, "reach": "room"}]


def point_objects(xyz_mm: np.ndarray, words: Sequence[str]) -> list[Object]:
    """Return reconstructed points (N, 3) with their names."""
    labels = [_label(at, text, "quiet") for at, text in zip(xyz_mm, words, strict=True)]
    return [{"kind": "points", "style": "quiet", "at": _list(xyz_mm)}, *labels] if len(xyz_mm) else []


def wire_objects(trajectory: Trajectory, diameter_mm: float, name: str = "") -> list[Object]:
    """Return the planned wire at its true width, with the 95 % ellipsoids of entry and tip if the errors are known; one
    that is not the current one with its `name` only.

    The ellipsoids are magnified by a round factor, which a note states.
    """
    ends = (trajectory.entry_mm, trajectory.end_mm)
    if name:
        return [_cylinder(*ends, diameter_mm / 2, "quiet"), _label(ends[0], name, "quiet")]
    made: list[Object] = [_cylinder(*ends, diameter_mm / 2, "wire")]
    made += [_label(at, word, "wire") for at, word in zip(ends, ("entry", "tip"), strict=True)]
    if not trajectory.error_stated:
        return [*made, {"kind": "note", "text": "the error of the wire's ends is unknown"}]
    covariances = trajectory.points.covariance_mm2
    times = magnification(covariances, NEAR_MM)
    made += [_ellipsoid(at, covariance, times) for at, covariance in zip(ends, covariances, strict=True)]
    return [
        *made,
        {"kind": "note", "text": f"Ellipsoids hold 95 % of the error of entry and tip, {times:g} times as large"},
    ]


def drilled_objects(entry_mm: np.ndarray, tip_mm: np.ndarray, diameter_mm: float) -> list[Object]:
    """Return a drilled wire as a check measured it, between two points (3,)."""
    middle = (np.asarray(entry_mm) + np.asarray(tip_mm)) / 2  # where the planned wire has no label
    return [_cylinder(entry_mm, tip_mm, diameter_mm / 2, "drilled"), _label(middle, "measured", "drilled")]


def bone_objects(volume: "Volume") -> list[Object]:
    """Return the outer surface of a bone volume, from the twin or from CT. Takes some tenths of a second."""
    from sightline.app.drawing.space import (
        outer_surface,  # with the twin, which the first page does not wait for
    )

    vertices, triangles = outer_surface(volume)
    return [
        {
            "kind": "mesh",
            "style": "bone",
            "reach": "hip",
            "vertices": _list(vertices, 1),
            "triangles": triangles.tolist(),
        }
    ]


def rehearsed_bone(patient: Patient) -> list[Object]:
    """Return the bone of a rehearsed patient; takes seconds, so run it in the worker process."""
    return [bone for volume in rehearsal_of(patient).bone.bone.volumes for bone in bone_objects(volume)]


def robot_objects(robot: Manipulator, q: np.ndarray, T_mcs_cfcs: RigidTransform) -> list[Object]:
    """Return the arm at its joints (n,): its parts, and its wire, or the guide that it holds.

    `T_mcs_cfcs`: the registration, pose of CFCS (the frame as imaged) in MCS.
    """
    to_cfcs, tool = T_mcs_cfcs.inv(), robot.T_mcs_tool(q)
    lines = to_cfcs.apply(part_axes(robot, q[None], robot.parts)[0].reshape(-1, 3)).reshape(-1, 2, 3)
    made: list[Object] = []
    for part, ends in zip(robot.parts, lines, strict=True):
        radius = PART_SHARE * part.radius_mm
        if np.linalg.norm(ends[1] - ends[0]) > 1e-6:
            made.append(_cylinder(ends[0], ends[1], radius, "robot"))
        made.append({"kind": "spheres", "style": "robot", "at": _list(ends), "radius": radius})
    if robot.has_feed:
        behind_mm, radius = WIRE_BEHIND_MM, TOOL_RADIUS_MM
    else:
        behind_mm, radius = robot.guide_mm, GUIDE_RADIUS_MM
        flange = to_cfcs.apply(robot.T_mcs_flange(q).translation)
        made.append(_cylinder(flange, to_cfcs.apply(tool.apply([0.0, 0.0, -behind_mm])), GUIDE_RADIUS_MM, "robot"))
    back, tip = to_cfcs.apply(tool.apply([[0.0, 0.0, -behind_mm], [0.0, 0.0, 0.0]]))
    made.append(_cylinder(back, tip, radius, "tool"))
    made = [{**part, "reach": "room"} for part in made]
    return [*made, _label(to_cfcs.apply(np.zeros(3)), "robot", "robot")]


def axis_objects() -> list[Object]:
    """Return the axes of CFCS."""
    axes = {"kind": "axes", "style": "quiet", "at": [0.0, 0.0, 0.0], "axes": _list(AXIS_MM * np.eye(3))}
    return [{**axes, "labels": ["X", "Y", "Z"]}]


def side_objects(side: str | None, about_mm: np.ndarray) -> list[Object]:
    """Return the axes of CFCS between plates, and labels for the sides of the patient around a point (3,); for an
    unknown `side` only those common to both. The axes of a block say nothing of the patient.

    Anterior is +Z, lateral +X; caudal is +Y for a right hip and -Y for a left one.
    """
    words = {**UPRIGHT, **SIDES.get(side or "", {"lateral": (1, 0, 0), "medial": (-1, 0, 0)})}
    labels = [_label(about_mm + SIDE_LABELS_MM * np.array(way), word, "quiet") for word, way in words.items()]
    return [*axis_objects(), *labels]


def _balls(body: RigidBody, style: str) -> Object:
    radii = [f.diameter_mm / 2 for f in body.fiducials]
    return {"kind": "spheres", "style": style, "at": _list(body.xyz_mm), "radius": radii}


def _ring(xyz_mm: Sequence[float], diameter_mm: float, plate: Plate) -> list[Any]:
    angle = np.linspace(0.0, 2 * np.pi, 25)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) * diameter_mm / 2
    return _list(np.asarray(xyz_mm) + circle @ plate.plane.axes)


def _outline(plate: Plate) -> np.ndarray:
    return plate.xyz_mm[ConvexHull(plate.plane.to_plane(plate.xyz_mm)).vertices]


def _corners(outline_mm: np.ndarray, plate: Plate) -> list[np.ndarray]:
    """Return the four outermost points of an outline, along the diagonals of its plane."""
    xy = plate.plane.to_plane(outline_mm)
    return [outline_mm[np.argmax(xy @ way)] for way in ((1, 1), (1, -1), (-1, -1), (-1, 1))]


def _picture(view: CalibratedView, plate: Plate, image: Radiograph) -> list[Object]:
    """Return the image on the plate's plane, with distortion corrected: a grid over the beads, textured at each node by
    its pixel."""
    xy = plate.plane.to_plane(plate.xyz_mm)
    sides = [
        np.linspace(low, high, PICTURE_CELLS + 1) for low, high in zip(xy.min(axis=0), xy.max(axis=0), strict=True)
    ]
    grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1)
    nodes = plate.plane.to_space(grid.reshape(-1, 2))
    uv_px, seen = view.project_seen(nodes)
    height, width = image.shape
    uv = np.zeros((len(nodes), 2))
    uv[seen] = (uv_px + 0.5) / [width, height]
    inside = seen & (uv >= 0).all(axis=1) & (uv <= 1).all(axis=1)
    number = np.arange(len(nodes)).reshape(grid.shape[:2])
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    quads = quads[inside[quads].all(axis=1)]
    if plate.plane.height_mm(view.focal_point_mm) < 0:  # it faces the source
        quads = quads[:, ::-1]
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    if not len(triangles):
        return []
    return [
        {
            "kind": "picture",
            "style": view.name,
            "vertices": _list(nodes),
            "triangles": triangles.tolist(),
            "uv": _list(uv, 4),
            "image": _thumbnail(image),
        }
    ]


def _thumbnail(image: Radiograph) -> Object:
    pixels = image.pixels.astype(np.float32)
    scale = min(PICTURE_PX / max(pixels.shape), 1.0)
    small = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    black, white = np.percentile(small, PICTURE_PERCENTILES)
    grey = (np.clip((small - black) / max(white - black, 1e-6), 0, 1) * 255).astype(np.uint8)
    return {"width": grey.shape[1], "height": grey.shape[0], "grey": b64encode(grey.tobytes()).decode()}


def _ellipsoid(at_mm: np.ndarray, covariance_mm2: np.ndarray, times: float) -> Object:
    values, vectors = np.linalg.eigh(covariance_mm2)
    half = vectors * np.sqrt(np.clip(values, 0.0, None)) * ellipsoid_factor(0.95, 3) * times
    return {"kind": "ellipsoid", "style": "ellipsoid", "at": _list(at_mm), "axes": _list(half.T, 4), "reach": "hip"}


def _cylinder(start_mm: np.ndarray, end_mm: np.ndarray, radius_mm: float, style: str) -> Object:
    ends = {"from": _list(start_mm), "to": _list(end_mm)}
    return {"kind": "cylinder", "style": style, **ends, "radius": radius_mm, "reach": "hip"}


def _label(at_mm: np.ndarray, text: str, style: str) -> Object:
    return {"kind": "label", "style": style, "at": _list(at_mm), "text": text}


def _list(values: Any, decimals: int = ROUND_DECIMALS) -> list[Any]:
    return np.round(np.asarray(values, dtype=np.float64), decimals).tolist()


# The bone's surface [ours]: some 10,000 triangles of a proximal femur, which any computer draws; smoothed over the
# steps between cells, but not over the bone's grooves.
CELL_MM, SMOOTHING_CELLS = 3.0, 0.7
BONE_SHARE = 0.03  # [calc] below the 0.041 of osteoporotic spongiosa: 99 HU less noise, with nothing around it
# [calc] a cell touched by bone counts as bone, on average half a cell too far out; there a smoothed step is 0.76.
LEVEL = 0.76


def outer_surface(volume: "Volume") -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) mm, CFCS, and triangles (T, 3), counter-clockwise seen from outside. Empty without
    bone."""
    step = max(round(CELL_MM / float(volume.voxel_mm.mean())), 1)
    shape = [n // step for n in volume.values.shape]
    blocks = volume.values[tuple(slice(n * step) for n in shape)]
    means = blocks.reshape(shape[0], step, shape[1], step, shape[2], step).mean(axis=(1, 3, 5))
    # Filled slice by slice along the shaft: the canal is open where the volume ends.
    filled = means > BONE_SHARE
    for section in np.moveaxis(filled, 1, 0):
        binary_fill_holes(section, output=section)
    field = gaussian_filter(np.pad(filled.astype(np.float32), 2), SMOOTHING_CELLS) - LEVEL
    vertices, triangles = surface_net(field)
    at = (vertices - 2.0) * step + (step - 1) / 2  # in voxels
    return volume.origin_mm + (at * volume.voxel_mm) @ volume.axes, triangles


def surface_net(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the zero surface of a field (nx, ny, nz): vertices (V, 3) in cells, triangles (T, 3) facing the negative
    side.

    Each crossed cell has a vertex at the mean of the crossings of its edges; each crossed edge has a quadrilateral
    (Gibson, Constrained Elastic Surface Nets, 1998). The field must be negative at its border.
    """
    inside = field > 0
    cells = tuple(n - 1 for n in field.shape)
    total, count = np.zeros((*cells, 3)), np.zeros(cells, dtype=np.int64)
    edges = [_crossings(field, inside, axis) for axis in range(3)]
    around = [[np.array(corner) for corner in _around(axis)] for axis in range(3)]
    for (at, crossing, _), corners in zip(edges, around, strict=True):
        for corner in corners:
            cell = tuple((at - corner).T)
            np.add.at(total, cell, crossing)
            np.add.at(count, cell, 1)
    number = np.cumsum(count.reshape(-1) > 0).reshape(cells) - 1
    quads = [
        np.where(rising[:, None], ring[:, ::-1], ring)
        for (at, _, rising), corners in zip(edges, around, strict=True)
        for ring in [np.stack([number[tuple((at - corner).T)] for corner in corners], axis=1)]
    ]
    all_quads = np.concatenate(quads)
    triangles = np.concatenate([all_quads[:, [0, 1, 2]], all_quads[:, [0, 2, 3]]])
    crossed = count > 0
    return total[crossed] / count[crossed][:, None], triangles


def _crossings(field: np.ndarray, inside: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the crossed edges along an axis: first nodes (E, 3), crossing points (E, 3), and whether the field
    rises."""
    first, second = (np.take(inside, range(s, s + inside.shape[axis] - 1), axis) for s in (0, 1))
    at = np.argwhere(first != second)
    ahead = at + np.eye(3, dtype=np.int64)[axis]
    low, high = field[tuple(at.T)], field[tuple(ahead.T)]
    where = at + np.eye(3)[axis] * (low / (low - high))[:, None]
    return at, where, high > low


def _around(axis: int) -> list[list[int]]:
    """Return the four cells around an edge, in order about the axis, as offsets back from its first node."""
    b, c = (axis + 1) % 3, (axis + 2) % 3
    ring = []
    for step_b, step_c in ((0, 0), (1, 0), (1, 1), (0, 1)):
        step = [0, 0, 0]
        step[b], step[c] = step_b, step_c
        ring.append(step)
    return ring
