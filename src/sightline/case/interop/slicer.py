"""Files for 3D Slicer: the plan, lines of sight, beads, the undistorted images in space, and a scene that loads them.

Everything is in patient LPS, mm, with the CFCS origin. Slicer uses RAS inside and converts the files on reading.
"""

from collections.abc import Sequence
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from sightline.calibration.exchange.pinhole import Pinhole
from sightline.calibration.exchange.reading import json_bytes
from sightline.case.interop.formats import T_cfcs_wire, T_lps_cfcs, transform_bytes
from sightline.case.interop.plan_file import PlanFile
from sightline.common.geometry.lines import unit
from sightline.imaging.volumes.nrrd import nrrd_bytes

RAS_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
_SLICES = ("Red", "Yellow", "Green")


def write(plan: PlanFile, side: str | None) -> dict[str, bytes]:
    """Return the files by name. Raises UnusableInputError without a side, or if the plan has no geometry of images."""
    to_lps = T_lps_cfcs(side)
    description = f"{plan.statement}; {side} hip; LPS mm, origin of the calibration frame (CFCS)"
    files = _markups(plan, to_lps[:3, :3], description)
    images = {}
    for view, pinhole in plan.plates.items():
        pixels = plan.pixels(view)
        if pixels is not None:
            images[view] = pinhole
            files[f"{view}-plate.nrrd"] = plate_bytes(pixels[0], pinhole, to_lps, description)
    # Slicer places objects by the inverse of the mapping in a file, so these files map to the wire and to CFCS.
    wire = to_lps @ T_cfcs_wire(plan.points_mm)
    files["wire.tfm"] = transform_bytes(
        np.linalg.inv(wire), f"3D Slicer: places a wire (tip at its origin, +z); {description}"
    )
    files["cfcs.tfm"] = transform_bytes(np.linalg.inv(to_lps), f"3D Slicer: places what is in CFCS; {description}")
    return files | {"scene.mrml": _scene(sorted(files), images, to_lps, description)}


def _markups(plan: PlanFile, rotation: np.ndarray, description: str) -> dict[str, bytes]:
    colour = GREEN if plan.go else RED
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


def _scene(names: list[str], images: dict[str, Pinhole], to_lps: np.ndarray, description: str) -> bytes:
    """Return the MRML scene: a node and a storage node per file, and a slice viewer in the plane of each image."""
    root = Element("MRML", version="Slicer4.4.0", userTags="")
    for k, name in enumerate(names, 1):
        if name.endswith(".mrk.json"):
            _markup(root, name, k, description)
        elif name.endswith(".tfm"):
            storage = f"vtkMRMLTransformStorageNode{k}"
            _node(root, "TransformStorage", storage, name, fileName=name)
            _node(root, "LinearTransform", f"vtkMRMLLinearTransformNode{k}", name[:-4], description, storage=storage)
        else:
            view = name.removesuffix("-plate.nrrd")
            _volume(root, name, k, description)
            _slice(root, _SLICES[list(images).index(view)], f"vtkMRMLScalarVolumeNode{k}", images[view], to_lps)
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


def _slice(root: Element, layout: str, volume: str, pinhole: Pinhole, to_lps: np.ndarray) -> None:
    """Add a slice viewer in the plane of an image: first axis along a row, second axis up, centred on the image."""
    corner, steps = plate_corner(pinhole)
    height, width = pinhole.stated_shape()
    middle = corner + 0.5 * (width - 1) * steps[0] + 0.5 * (height - 1) * steps[1]
    placed = np.eye(4)
    across, up = (unit(axis) for axis in (steps[0], -steps[1]))
    placed[:3] = np.column_stack([across, up, np.cross(across, up), middle])
    matrix = RAS_LPS @ to_lps @ placed
    laid = {"orientation": "Reformat", "sliceToRAS": " ".join(repr(float(x) + 0.0) for x in matrix.ravel())}
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


def plate_bytes(pixels: np.ndarray, pinhole: Pinhole, T_lps_cfcs: np.ndarray, statement: str) -> bytes:
    """Return an undistorted image (H, W) at the position of its plate, one voxel thick. Raises UnusableInputError."""
    corner, steps = plate_corner(pinhole)
    rotation = T_lps_cfcs[:3, :3]
    pixels = pinhole.own_image(pixels)
    return nrrd_bytes(pixels.T[:, :, None], rotation @ corner + T_lps_cfcs[:3, 3], steps @ rotation.T, statement)
