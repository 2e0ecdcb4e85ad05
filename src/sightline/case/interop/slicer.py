"""Files for 3D Slicer: the plan with its 95 % tube, lines of sight, beads, the undistorted images in space with the
frusta of their views, and a scene that loads them; as a folder, or in one file.

Files are in patient LPS, mm, with the CFCS origin. Slicer uses RAS inside and converts the files on reading; the scene
itself is in RAS.
"""

import io
from collections.abc import Sequence
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np

from sightline.calibration.exchange.pinhole import Pinhole
from sightline.calibration.exchange.reading import json_bytes
from sightline.case.interop.formats import T_cfcs_wire, T_lps_cfcs, transform_bytes
from sightline.case.interop.plan_file import PlanFile
from sightline.common.geometry.lines import unit
from sightline.imaging.volumes.nrrd import nrrd_bytes

RAS_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
_SLICES = ("Red", "Yellow", "Green")
Surface = tuple[np.ndarray, list[list[int]]]  # vertices (N, 3), and each face's vertices, anticlockwise from outside
_SIDES = 32  # [ours] of the tube: its edges lie 0.5 % outside the circles
_MAX_TITLE = 255  # VTK's file formats: the second line has at most 256 characters with its end


def write(plan: PlanFile, side: str | None) -> dict[str, bytes]:
    """Return the files by name. Raises UnusableInputError without a side, or if the plan has no geometry of images."""
    to_lps = T_lps_cfcs(side)
    description = f"{plan.statement}; {side} hip; LPS mm, origin of the calibration frame (CFCS)"
    files = _markups(plan, to_lps[:3, :3], description)
    files |= _models(plan, to_lps[:3, :3], description)
    for view, pinhole in plan.plates.items():
        pixels = plan.pixels(view)
        if pixels is not None:
            files[f"{view}-plate.nrrd"] = plate_bytes(pixels[0], pinhole, to_lps, description)
    # Slicer places objects by the inverse of the mapping in a file, so these files map to the wire and to CFCS.
    wire = to_lps @ T_cfcs_wire(plan.points_mm)
    files["wire.tfm"] = transform_bytes(
        np.linalg.inv(wire), f"3D Slicer: places a wire (tip at its origin, +z); {description}"
    )
    files["cfcs.tfm"] = transform_bytes(np.linalg.inv(to_lps), f"3D Slicer: places what is in CFCS; {description}")
    return files | {"scene.mrml": _scene(sorted(files), plan, to_lps, description)}


def write_bundle(plan: PlanFile, side: str | None) -> dict[str, bytes]:
    """Return `plan.mrb`: the files of `write` and their scene in one zip file. Raises UnusableInputError as `write`."""
    stream = io.BytesIO()
    with ZipFile(stream, "w", ZIP_DEFLATED) as bundle:
        for name, data in write(plan, side).items():
            entry = ZipInfo(f"plan/{name}")  # its fixed date makes equal plans equal files
            entry.external_attr = 0o644 << 16  # else programs on Unix extract files that nobody may read
            bundle.writestr(entry, data, ZIP_DEFLATED)
    return {"plan.mrb": stream.getvalue()}


def _models(plan: PlanFile, rotation: np.ndarray, description: str) -> dict[str, bytes]:
    """Return the frustum of each view, and the tube where the errors are known."""
    models = {f"{view}-frustum.vtk": _frustum(*_outline(pinhole)) for view, pinhole in plan.plates.items()}
    if plan.errors_95_mm is not None:
        models["tube-95.vtk"] = tube(plan.points_mm, plan.errors_95_mm)
    return {name: _model_bytes(places @ rotation.T, faces, description) for name, (places, faces) in models.items()}


def _frustum(source_mm: np.ndarray, corners_mm: np.ndarray) -> Surface:
    """Return the four sides of the pyramid from the X-ray source (3,) to the corners (4, 3) of an image."""
    return np.vstack([source_mm, corners_mm]), [[0, 1 + (k + 1) % 4, 1 + k] for k in range(4)]


def tube(points_mm: np.ndarray, radii_mm: tuple[float, float]) -> Surface:
    """Return the closed tube between two points (2, 3) that holds a circle of a given radius about each.

    Its sides touch the circles from outside, so that it is nowhere narrower than they are.
    """
    angles = 2 * np.pi * np.arange(_SIDES) / _SIDES
    ring = np.column_stack([np.cos(angles), np.sin(angles)]) / np.cos(np.pi / _SIDES)
    across = T_cfcs_wire(points_mm)[:3, :2]
    places = np.vstack([point + radius * ring @ across.T for point, radius in zip(points_mm, radii_mm, strict=True)])
    sides = [[k, (k + 1) % _SIDES, _SIDES + (k + 1) % _SIDES, _SIDES + k] for k in range(_SIDES)]
    return places, [*sides, list(range(_SIDES))[::-1], list(range(_SIDES, 2 * _SIDES))]


def _model_bytes(places_lps_mm: np.ndarray, faces: list[list[int]], statement: str) -> bytes:
    """Return a surface as a `.vtk` file; its title states the axes, as 3D Slicer writes them, and the statement."""
    lines = [
        "# vtk DataFile Version 3.0",
        f"SPACE=LPS; mm; {statement}"[:_MAX_TITLE],
        "ASCII",
        "DATASET POLYDATA",
        f"POINTS {len(places_lps_mm)} double",
        *(" ".join(repr(float(x) + 0.0) for x in place) for place in places_lps_mm),
        f"POLYGONS {len(faces)} {sum(map(len, faces)) + len(faces)}",
        *(" ".join(map(str, (len(face), *face))) for face in faces),
    ]
    return ("\n".join(lines) + "\n").encode("ascii", "replace")


def _markups(plan: PlanFile, rotation: np.ndarray, description: str) -> dict[str, bytes]:
    colour = _colour(plan)
    name = "planned wire" if plan.go else "NO-GO planned wire"
    points = plan.points_mm @ rotation.T
    files = {
        "wire.mrk.json": markup_bytes("Line", name, points, ("entry", "tip"), colour=colour, description=description)
    }
    for line in plan.document.lines_of_sight:
        ends = np.array([line.focal_point_mm, line.plate_mm]) @ rotation.T
        what = f"{line.view} line of sight of {line.point}"
        files[f"sight-{line.view}-{line.point}.mrk.json"] = markup_bytes(
            "Line", what, ends, ("X-ray source", "on the plate"), colour=YELLOW, description=description, labelled=False
        )
    if plan.document.frame is not None:
        beads = plan.document.frame.beads
        files["beads.mrk.json"] = markup_bytes(
            "Fiducial",
            f"beads of {plan.document.frame.name}",
            np.array([bead.xyz_mm for bead in beads]).reshape(-1, 3) @ rotation.T,
            [bead.id for bead in beads],
            colour=BLUE,
            description=description,
            labelled=False,
        )
    return files


def _colour(plan: PlanFile) -> tuple[float, float, float]:
    return GREEN if plan.go else RED


def _scene(names: list[str], plan: PlanFile, to_lps: np.ndarray, description: str) -> bytes:
    """Return the MRML scene: a node and a storage node per file, a camera at the X-ray source of each view, and a slice
    viewer in the plane of each image."""
    plates = plan.plates
    images = [view for view in plates if f"{view}-plate.nrrd" in names]
    root = Element("MRML", version="Slicer4.4.0", userTags="")
    for k, name in enumerate(names, 1):
        if name.endswith(".mrk.json"):
            _markup(root, name, k, description)
        elif name.endswith(".tfm"):
            storage = f"vtkMRMLTransformStorageNode{k}"
            _node(root, "TransformStorage", storage, name, fileName=name)
            _node(root, "LinearTransform", f"vtkMRMLLinearTransformNode{k}", name[:-4], description, storage=storage)
        elif name.endswith(".vtk"):
            colour, opacity = (YELLOW, 0.1) if name.endswith("-frustum.vtk") else (_colour(plan), 0.35)
            shown = {"color": _numbers(colour), "opacity": repr(opacity), "backfaceCulling": "0", "visibility": "true"}
            _model(root, name, k, description, shown)
        else:
            view = name.removesuffix("-plate.nrrd")
            _volume(root, name, k, description)
            _slice(root, _SLICES[images.index(view)], f"vtkMRMLScalarVolumeNode{k}", plates[view], to_lps)
    for view, pinhole in plates.items():
        _camera(root, view, pinhole, to_lps)
    indent(root, " ")
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root)


def _node(root: Element, tag: str, identity: str, name: str, description: str = "", **given: str) -> Element:
    """Add a node; `display` and `storage` become references."""
    references = "".join(f"{role}:{given.pop(role)};" for role in ("display", "storage") if role in given)
    attributes = {"id": identity, "name": name} | ({"description": description} if description else {}) | given
    return SubElement(root, tag, attributes | ({"references": references} if references else {}))


def _markup(root: Element, name: str, k: int, description: str) -> None:
    kind = "Fiducial" if name.startswith("beads") else "Line"
    display, storage = f"vtkMRMLMarkupsDisplayNode{k}", f"vtkMRMLMarkupsJsonStorageNode{k}"
    _node(root, "MarkupsDisplay", display, f"{name} display", visibility="true")
    _node(root, "MarkupsJsonStorage", storage, name, fileName=name, coordinateSystem="LPS")
    label = name.removesuffix(".mrk.json")
    _node(root, f"Markups{kind}", f"vtkMRMLMarkups{kind}Node{k}", label, description, display=display, storage=storage)


def _volume(root: Element, name: str, k: int, description: str) -> None:
    display, storage = f"vtkMRMLScalarVolumeDisplayNode{k}", f"vtkMRMLVolumeArchetypeStorageNode{k}"
    grey = {"colorNodeID": "vtkMRMLColorTableNodeGrey", "autoWindowLevel": "1", "interpolate": "1"}
    _node(root, "VolumeDisplay", display, f"{name} display", **grey)
    _node(root, "VolumeArchetypeStorage", storage, name, fileName=name, centerImage="0", UseOrientationFromFile="1")
    _node(root, "Volume", f"vtkMRMLScalarVolumeNode{k}", name[:-5], description, display=display, storage=storage)


def _model(root: Element, name: str, k: int, description: str, shown: dict[str, str]) -> None:
    display, storage = f"vtkMRMLModelDisplayNode{k}", f"vtkMRMLModelStorageNode{k}"
    _node(root, "ModelDisplay", display, f"{name} display", **shown)
    _node(root, "ModelStorage", storage, name, fileName=name, coordinateSystem="LPS")
    _node(root, "Model", f"vtkMRMLModelNode{k}", name[:-4], description, display=display, storage=storage)


def _camera(root: Element, view: str, pinhole: Pinhole, to_lps: np.ndarray) -> None:
    """Add a camera at the X-ray source that looks at the middle of the image, and sees its height.

    Slicer's cameras have no principal point, so only a centred image is seen as it was taken; the frustum is exact.
    """
    _, corners = _outline(pinhole)
    middle, above, below = corners.mean(axis=0), corners[:2].mean(axis=0), corners[2:].mean(axis=0)
    source = pinhole.focal_point_mm
    to_ras = RAS_LPS[:3, :3] @ to_lps[:3, :3]
    angle = np.arccos(np.clip(unit(above - source) @ unit(below - source), -1.0, 1.0))
    placed = {"position": source, "focalPoint": middle, "viewUp": unit(above - below)}
    looks = {key: _numbers(to_ras @ place) for key, place in placed.items()}
    looks |= {"viewAngle": repr(float(np.rad2deg(angle))), "parallelProjection": "false"}
    _node(root, "Camera", f"vtkMRMLCameraNode{view}", f"{view} X-ray source", **looks)


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(repr(float(x) + 0.0) for x in values)


def _slice(root: Element, layout: str, volume: str, pinhole: Pinhole, to_lps: np.ndarray) -> None:
    """Add a slice viewer in the plane of an image: first axis along a row, second axis up, centred on the image."""
    corner, steps = plate_corner(pinhole)
    height, width = pinhole.stated_shape()
    middle = corner + 0.5 * (width - 1) * steps[0] + 0.5 * (height - 1) * steps[1]
    placed = np.eye(4)
    across, up = (unit(axis) for axis in (steps[0], -steps[1]))
    placed[:3] = np.column_stack([across, up, np.cross(across, up), middle])
    matrix = RAS_LPS @ to_lps @ placed
    laid = {"orientation": "Reformat", "sliceToRAS": _numbers(matrix.ravel())}
    common = {"singletonTag": layout, "layoutName": layout}
    _node(root, "Slice", f"vtkMRMLSliceNode{layout}", layout, sliceVisibility="true", **common, **laid)
    _node(root, "SliceComposite", f"vtkMRMLSliceCompositeNode{layout}", layout, backgroundVolumeID=volume, **common)


# Slicer compares this identifier; it does not fetch the address.
_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
GREEN, RED, YELLOW, BLUE = (0.2, 0.8, 0.3), (0.9, 0.1, 0.1), (0.95, 0.85, 0.2), (0.3, 0.6, 1.0)


def markup_bytes(
    kind: str,
    name: str,
    points_lps_mm: np.ndarray,
    labels: Sequence[str],
    *,
    colour: tuple[float, float, float],
    description: str,
    labelled: bool = True,
) -> bytes:
    """Return a markup file. `kind`: "Line" (two points) or "Fiducial"; each control point carries the description."""
    points: list[dict[str, Any]] = [
        {
            "id": str(k + 1),
            "label": label,
            "description": description,
            "position": [float(x) + 0.0 for x in place],
            "selected": True,
            "locked": True,
            "visibility": True,
            "positionStatus": "defined",
        }
        for k, (label, place) in enumerate(zip(labels, points_lps_mm, strict=True))
    ]
    markup = {
        "type": kind,
        "name": name,
        "description": description,
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": True,
        "fixedNumberOfControlPoints": True,
        "controlPoints": points,
        "display": {
            "visibility": True,
            "color": list(colour),
            "selectedColor": list(colour),
            "pointLabelsVisibility": labelled,
        },
    }
    return json_bytes({"@schema": _SCHEMA, "markups": [markup]})


def plate_corner(pinhole: Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """Return the centre (3,) of the plate image's first pixel, CFCS mm, and the steps (3, 3) to the next column, to the
    next row, and of 1 mm along the beam."""
    distance, across, down = pinhole.detector_mm()
    cu, cv = pinhole.camera_matrix[:2, 2]
    corner = pinhole.focal_point_mm + pinhole.rotation.T @ [-cu * across, -cv * down, distance]
    return corner, np.diag([across, down, 1.0]) @ pinhole.rotation


def _outline(pinhole: Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """Return the X-ray source (3,) and the outer corners (4, 3) of the plate image along its edge, CFCS mm."""
    corner, steps = plate_corner(pinhole)
    height, width = pinhole.stated_shape()
    left, top, right, bottom = -0.5, -0.5, width - 0.5, height - 0.5  # pixels reach half a pixel beyond their centres
    corners_px = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
    return pinhole.focal_point_mm, corner + corners_px @ steps[:2]


def plate_bytes(pixels: np.ndarray, pinhole: Pinhole, T_lps_cfcs: np.ndarray, statement: str) -> bytes:
    """Return an undistorted image (H, W) at the position of its plate, one voxel thick. Raises UnusableInputError."""
    corner, steps = plate_corner(pinhole)
    rotation = T_lps_cfcs[:3, :3]
    pixels = pinhole.own_image(pixels)
    return nrrd_bytes(pixels.T[:, :, None], rotation @ corner + T_lps_cfcs[:3, 3], steps @ rotation.T, statement)
