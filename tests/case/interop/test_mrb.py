"""A plan as one `.mrb` of 3D Slicer: reopened as Slicer's own reader does, zip, scene, then each node's file."""

import io
import zipfile
from xml.etree.ElementTree import Element

import numpy as np
import pytest

from sightline.calibration.exchange.rtk import parsed_xml
from sightline.case.interop import slicer
from sightline.case.interop.formats import R_lps_cfcs
from sightline.case.interop.plan_file import PlanFile
from sightline.case.interop.slicer import tube
from sightline.imaging.volumes.nrrd import read_nrrd

SIDE = "left"
RAS = np.diag([-1.0, -1.0, 1.0])
IN_FILE = 1e-8  # mm and px: doubles written with all digits, over 1000 mm and 2000 px
OFF_GRID_PX = np.array([[311.37, 402.81], [17.2, 641.9], [560.05, 33.33]])


@pytest.fixture(scope="module")
def bundle(go_plan: PlanFile) -> zipfile.ZipFile:
    return zipfile.ZipFile(io.BytesIO(slicer.write_bundle(go_plan, SIDE)["plan.mrb"]))


@pytest.fixture(scope="module")
def scene(bundle: zipfile.ZipFile) -> Element:
    (name,) = [name for name in bundle.namelist() if name.endswith(".mrml")]  # Slicer opens the first it finds
    assert bundle.getinfo(name).file_size < 2**20
    return parsed_xml(bundle.read(name))


def model(data: bytes) -> tuple[np.ndarray, list[list[int]]]:
    """Return points, RAS, and faces of a legacy VTK file, by VTK's "File Formats"; `SPACE` by Slicer's model reader."""
    lines = data.decode("ascii").splitlines()
    assert lines[0] == "# vtk DataFile Version 3.0" and lines[2:4] == ["ASCII", "DATASET POLYDATA"]
    assert "SPACE=LPS" in lines[1] and len(lines[1]) < 256
    count = int(lines[4].split()[1])
    points = np.array([list(map(float, line.split())) for line in lines[5 : 5 + count]])
    _, faces, size = lines[5 + count].split()
    cells = [list(map(int, line.split())) for line in lines[6 + count :]]
    assert len(cells) == int(faces) and sum(map(len, cells)) == int(size)
    assert all(cell[0] == len(cell) - 1 and max(cell[1:]) < count for cell in cells)
    return points @ RAS, [cell[1:] for cell in cells]


def cfcs(ras_mm: np.ndarray) -> np.ndarray:
    return ras_mm @ RAS @ R_lps_cfcs(SIDE)


def test_the_bundle_is_one_folder_that_holds_every_file_a_node_names(bundle, scene: Element, go_plan: PlanFile) -> None:
    assert bundle.testzip() is None
    assert {name.split("/")[0] for name in bundle.namelist()} == {"plan"}
    named = [f"plan/{node.get('fileName')}" for node in scene if node.get("fileName")]
    assert sorted([*named, "plan/scene.mrml"]) == sorted(bundle.namelist())
    assert all(info.external_attr >> 16 == 0o644 for info in bundle.infolist())  # else Unix extracts unreadable files
    assert slicer.write_bundle(go_plan, SIDE) == slicer.write_bundle(go_plan, SIDE)
    for node in scene.findall("ModelStorage"):
        assert node.get("coordinateSystem") == "LPS"  # Slicer takes a node without it for RAS


def test_each_image_has_its_pixels_on_their_lines_of_sight(bundle, go_plan: PlanFile, tmp_path) -> None:
    """IJK-to-RAS of the file, off the grid, against the view's own lines of sight."""
    bundle.extractall(tmp_path)
    for view, pinhole in go_plan.plates.items():
        image = read_nrrd(tmp_path / "plan" / f"{view}-plate.nrrd")
        ijk_to_ras = RAS @ np.column_stack([image.steps_mm, image.origin_mm])
        ijk = np.column_stack([OFF_GRID_PX, np.zeros(3), np.ones(3)])
        places = cfcs(ijk @ ijk_to_ras.T)
        sight = pinhole.view().lines_of_sight(OFF_GRID_PX)
        along = sight.points_mm - sight.focal_point_mm
        off = np.cross(places - sight.focal_point_mm, along) / np.linalg.norm(along, axis=1, keepdims=True)
        assert np.abs(off).max() < IN_FILE
        assert ((places - sight.focal_point_mm) * along).sum(axis=1).min() > 0
        assert image.shape[1::-1] == pinhole.shape


def test_a_frustum_runs_from_the_source_to_the_images_edges(bundle, go_plan: PlanFile) -> None:
    for view, pinhole in go_plan.plates.items():
        points, faces = model(bundle.read(f"plan/{view}-frustum.vtk"))
        height, width = pinhole.stated_shape()
        edges = [(-0.5, -0.5), (width - 0.5, -0.5), (width - 0.5, height - 0.5), (-0.5, height - 0.5)]
        assert np.abs(cfcs(points[:1]) - pinhole.focal_point_mm).max() < IN_FILE
        assert np.abs(pinhole.view().project(cfcs(points[1:])) - edges).max() < IN_FILE
        corner, steps = slicer.plate_corner(pinhole)
        assert np.abs((cfcs(points[1:]) - corner) @ steps[2]).max() < IN_FILE  # in the image's plane
        assert sorted(map(sorted, faces)) == [[0, 1, 2], [0, 1, 4], [0, 2, 3], [0, 3, 4]]
        outwards(points, faces, points.mean(axis=0))


def test_a_camera_looks_from_the_source_at_the_image(scene: Element, go_plan: PlanFile) -> None:
    """Its view angle is that between the lines of sight of the image's top and bottom edge."""
    cameras = {(node.get("name") or "").split()[0]: node for node in scene.findall("Camera")}
    assert set(cameras) == set(go_plan.plates)
    for view, pinhole in go_plan.plates.items():
        node = cameras[view]
        position, at, up = (
            np.array(list(map(float, (node.get(key) or "").split()))) for key in ("position", "focalPoint", "viewUp")
        )
        height, width = pinhole.stated_shape()
        middle = [(width - 1) / 2, (height - 1) / 2]
        assert np.abs(cfcs(position) - pinhole.focal_point_mm).max() < IN_FILE
        assert np.abs(pinhole.view().project(cfcs(at)[None]) - middle).max() < IN_FILE
        upper = pinhole.view().project(cfcs(at + 5.0 * up)[None])[0]
        assert upper[1] < middle[1] and abs(upper[0] - middle[0]) < IN_FILE
        top, bottom = pinhole.view().lines_of_sight(np.array([[middle[0], -0.5], [middle[0], height - 0.5]])).points_mm
        a, b = (end - pinhole.focal_point_mm for end in (top, bottom))
        angle = np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
        assert float(node.get("viewAngle") or "nan") == pytest.approx(angle, abs=1e-9)


def outwards(points: np.ndarray, faces: list[list[int]], inside: np.ndarray) -> None:
    for face in faces:
        a, b, c = points[face[:3]]
        assert np.cross(b - a, c - a) @ (a - inside) > 0


def test_the_tube_holds_the_95_percent_error_of_both_ends(bundle, go_plan: PlanFile) -> None:
    """Nowhere nearer to the wire than the error, at most 1 % further; a tube of one radius, or ends exchanged, fail."""
    points, faces = model(bundle.read("plan/tube-95.vtk"))
    assert go_plan.errors_95_mm is not None
    holds(cfcs(points), go_plan.points_mm, go_plan.errors_95_mm)
    outwards(points, faces, points.mean(axis=0))
    ends, radii = np.array([[3.1, -20.7, 8.3], [40.9, 33.3, -61.7]]), (0.71, 2.93)
    holds(tube(ends, radii)[0], ends, radii)


def holds(points: np.ndarray, ends: np.ndarray, radii: tuple[float, float]) -> None:
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    for ring, end, radius in zip(np.split(points, 2), ends, radii, strict=True):
        assert np.abs((ring - end) @ along).max() < IN_FILE
        for place in (ring, 0.5 * (ring + np.roll(ring, 1, axis=0))):
            away = np.linalg.norm(place - end, axis=1)
            assert radius - IN_FILE < away.min() and away.max() < 1.01 * radius


def test_a_plan_of_unknown_error_has_no_tube(plan_folder, go_plan: PlanFile) -> None:
    document = go_plan.document.model_copy(
        update={"trajectory": go_plan.document.trajectory.model_copy(update={"covariance_mm2": None})}
    )
    files = slicer.write(PlanFile(document, plan_folder), SIDE)
    assert "tube-95.vtk" not in files and b"tube" not in files["scene.mrml"]


def test_a_no_go_plan_has_a_red_tube(go_plan: PlanFile, no_go_plan: PlanFile) -> None:
    for plan, colour in ((go_plan, slicer.GREEN), (no_go_plan, slicer.RED)):
        root = parsed_xml(slicer.write(plan, SIDE)["scene.mrml"])
        (shown,) = [node for node in root.findall("ModelDisplay") if node.get("name") == "tube-95.vtk display"]
        assert shown.get("color") == " ".join(map(repr, colour))
