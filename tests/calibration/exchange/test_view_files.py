"""Views to other programs' files and back; and each format against its own program's formulas, written out here."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from tests.calibration.exchange.cameras import pinholes, points_about_hip, project, rtk_ray

from sightline.calibration.exchange import rtk
from sightline.calibration.exchange.formats import FORMATS, read_view, write_view
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.calibration.exchange.reading import image_shape
from sightline.errors import UnusableInputError

POINTS = points_about_hip()
# Doubles written with all their digits; the longest way (RTK's angles in degrees) keeps 1e-12 of 2000 px.
ROUND_TRIP_PX = 1e-8
MIRRORED = [kind for kind in FORMATS if kind != "rtk"]


def there_and_back(pinhole: Pinhole, kind: str, folder: Path) -> list[Pinhole]:
    files = write_view(pinhole, kind)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return [read_view(folder / name, name="pa") for name in files if not name.endswith(".mha")]


@pytest.mark.parametrize("kind", FORMATS)
def test_a_view_comes_back(kind: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp(kind)

    @settings(max_examples=15, deadline=None, database=None)
    @given(pinholes(mirrored=None if kind in MIRRORED else False))
    def check(pinhole: Pinhole) -> None:
        wanted = project(pinhole, POINTS)
        for back in there_and_back(pinhole, kind, folder):
            assert np.abs(back.view().project(POINTS) - wanted).max() < ROUND_TRIP_PX
            assert back.mirrored == pinhole.mirrored
            assert back.shape in (pinhole.shape, None)
            if back.pixel_mm is not None:
                assert np.allclose(back.pixel_mm, pinhole.pixel_mm, rtol=1e-12)

    check()


@settings(max_examples=15, deadline=None, database=None)
@given(pinholes())
def test_rtk_sees_the_written_image_as_its_documentation_says(pinhole: Pinhole) -> None:
    """Source and detector as points in space, from RTK's drawing of its parameters: no matrix of ours."""
    p = rtk.parameters(pinhole)
    assert p["SourceToIsocenterDistance"] > 0 and p["SourceToDetectorDistance"] > 0
    u, v = 13.0, 47.0  # a pixel of ours: column 13, row 47; RTK's image holds it in row H - 1 - 47
    across, down = pinhole.pixel_mm or (0.0, 0.0)
    source, pixel = rtk_ray(p, (u * across, ((pinhole.shape or (0, 0))[0] - 1 - v) * down))
    on_ray = source + 0.6 * (pixel - source)
    assert np.abs(project(pinhole, on_ray[None]) - [u, v]).max() < 1e-6


@settings(max_examples=15, deadline=None, database=None)
@given(pinholes(mirrored=None))
def test_diffdrr_casts_each_pixels_ray_where_ours_runs(pinhole: Pinhole) -> None:
    """Its detector as `_initialize_carm` and `calibration` make it."""
    d = json.loads(write_view(pinhole, "diffdrr")["pa.diffdrr.json"])
    row, column = 21, 34
    down = -(row - (d["height"] - 1) / 2)
    right = -(column - (d["width"] - 1) / 2) * (1 if d["reverse_x_axis"] else -1)
    pose = np.array(d["pose"])
    target = pose @ [right * d["delx"] + d["x0"], down * d["dely"] + d["y0"], d["sdd"], 1.0]
    on_ray = pose[:3, 3] + 0.6 * (target[:3] - pose[:3, 3])
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert np.abs(project(pinhole, on_ray[None]) - [column, row]).max() < 1e-6


@settings(max_examples=15, deadline=None, database=None)
@given(pinholes())
def test_deepdrr_samples_a_pixel_at_its_index_and_a_half(pinhole: Pinhole) -> None:
    d = json.loads(write_view(pinhole, "deepdrr")["pa.deepdrr.json"])
    world = np.column_stack([POINTS, np.ones(len(POINTS))]) @ np.array(d["extrinsic"]).T
    index = world[:, :3] @ np.array(d["intrinsic"]).T
    assert np.abs(index[:, :2] / index[:, 2:] - (project(pinhole, POINTS) + 0.5)).max() < 1e-8


@settings(max_examples=15, deadline=None, database=None)
@given(pinholes())
def test_autoscoper_turns_mayacam_into_a_camera_that_looks_along_its_minus_z(pinhole: Pinhole) -> None:
    """Its reader: x right, y up, the image's rows counted from the bottom (size - 1 - cy)."""
    lines = write_view(pinhole, "mayacam2")["pa.mayacam2.txt"].decode().splitlines()
    (width, height) = map(int, lines[1].split(","))
    k, r = ([[float(x) for x in line.split(",")] for line in lines[at : at + 3]] for at in (4, 9))
    t = np.array([float(line) for line in lines[14:17]])
    x, y, z = (POINTS @ np.array(r).T + t).T
    right, up, towards = x, -y, -z
    u = k[0][2] + k[0][0] * right / -towards
    from_bottom = (height - 1 - k[1][2]) + k[1][1] * up / -towards
    wanted = project(pinhole, POINTS)
    assert (height, width) == pinhole.shape
    assert np.abs(u - wanted[:, 0]).max() < 1e-8
    assert np.abs((height - 1 - from_bottom) - wanted[:, 1]).max() < 1e-8


VTKCAM = {
    "@schema": "https://autoscoperm.slicer.org/vtk-schema-1.0.json",
    "version": 1.0,
    "focal-point": [-8.3, -245.5, -186.65],
    "camera-position": [704.7, -255.2, -79.7],
    "view-up": [0.1, 0.9, 0.2],
    "view-angle": 23.7,
    "image-width": 1761,
    "image-height": 1761,
    "clipping-range": [0.1, 1000],
}


def test_a_vtkcam_file_is_read_as_vtks_camera_projects(tmp_path: Path) -> None:
    """By gluLookAt and gluPerspective, whose matrices VTK and Autoscoper build: clip coordinates to pixels' corners."""
    (tmp_path / "cam0.vtkcam.json").write_text(json.dumps(VTKCAM))
    at, eye, up = (np.array(VTKCAM[key]) for key in ("focal-point", "camera-position", "view-up"))
    forward = (at - eye) / np.linalg.norm(at - eye)
    side = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    look = np.eye(4)
    look[:3, :3] = [side, np.cross(side, forward), -forward]
    look[:3, 3] = -look[:3, :3] @ eye
    f = 1 / np.tan(np.deg2rad(23.7) / 2)
    points = np.column_stack([at + POINTS, np.ones(len(POINTS))])
    x, y, towards, _ = look @ points.T
    x, y, w = f * x, f * y, -towards
    wanted = np.column_stack([(x / w + 1) / 2 * 1761 - 0.5, (1 - y / w) / 2 * 1761 - 0.5])
    view = read_view(tmp_path / "cam0.vtkcam.json")
    assert np.abs(view.view().project(points[:, :3]) - wanted).max() < 1e-8
    assert view.shape == (1761, 1761) and not view.mirrored


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"version": 2.0}, "another version"),
        ({"image-width": 1760}, "not square"),
        ({"view-angle": 180.0}, "below 180 degrees"),
        ({"view-angle": -3.0}, "above zero"),
        ({"view-up": [1426.0, -19.4, 213.9]}, "along the beam"),
        ({"view-up": [0.0, 0.0, 0.0]}, "along the beam"),
        ({"camera-position": VTKCAM["focal-point"]}, "along the beam"),
        ({"focal-point": [1.0, 2.0]}, "focal-point must be"),
    ],
)
def test_a_vtkcam_file_that_programs_would_read_differently_is_refused(
    tmp_path: Path, changes: dict, words: str
) -> None:
    (tmp_path / "cam0.vtkcam.json").write_text(json.dumps(VTKCAM | changes))
    with pytest.raises(UnusableInputError, match=words):
        read_view(tmp_path / "cam0.vtkcam.json")


def test_a_covariance_travels_with_the_matrix_whatever_its_scale(tmp_path: Path) -> None:
    camera = np.array([[5000.0, 0, 500], [0, 5000, 480], [0, 0, 1]])
    pinhole = Pinhole("pa", camera, np.eye(3), np.array([3.0, -5.0, 620.0]), (1000, 1024), (0.2, 0.2))
    spread = np.random.default_rng(4).normal(size=(12, 12)) * 1e-3
    covariance = spread @ spread.T
    doubled = Pinhole.of_matrix(-2 * pinhole.matrix, "pa", pinhole.shape, pinhole.pixel_mm, 4 * covariance)
    (tmp_path / "pa.opencv.json").write_bytes(write_view(doubled, "opencv")["pa.opencv.json"])
    back = read_view(tmp_path / "pa.opencv.json")
    assert back.covariance is not None
    assert np.allclose(back.covariance, covariance, rtol=1e-9, atol=1e-15)
    assert back.view().lines_of_sight(np.array([[400.0, 300.0]])).covariance is not None


BOMB = b"""<?xml version="1.0"?><!DOCTYPE lolz [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>
<RTKThreeDCircularGeometry><Projection><GantryAngle>&b;</GantryAngle></Projection></RTKThreeDCircularGeometry>"""
GOOD = {"matrix": [[5000.0, 0, 500, 310000], [0, 5000, 480, 290000], [0, 0, 1, 620]]}


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.rtk.xml", BOMB, "document type"),
        ("a.rtk.xml", b"<a>" * 40 + b"</a>" * 40, "too deeply"),
        ("a.rtk.xml", b"<RTKThreeDCircularGeometry/>", "one projection"),
        ("a.rtk.xml", b"not xml", "not XML"),
        (
            "a.rtk.xml",
            b"<RTKThreeDCircularGeometry><Projection/></RTKThreeDCircularGeometry>",
            "does not state the pixels",
        ),
        ("a.opencv.json", b'{"matrix": [[NaN,0,0,0],[0,1,0,0],[0,0,1,5]]}', "NaN"),
        ("a.opencv.json", b'{"matrix": 1, "matrix": 2}', "'matrix' occurs twice"),
        ("a.opencv.json", b'{"matrix": [[1,0,0],[0,1,0],[0,0,1]]}', "3 x 4"),
        ("a.opencv.json", b'{"matrix": [["1","x",0,0],[0,1,0,0],[0,0,1,5]]}', "3 x 4"),
        ("a.opencv.json", b'{"matrix": [[1,0,0,0],[2,0,0,0],[0,0,1,620]]}', "no focal point"),
        ("a.opencv.json", b'{"camera_matrix": 1}', "'rotation' is missing"),
        ("a.opencv.json", json.dumps(GOOD | {"distortion": [0.1, 0, 0, 0, 0]}).encode(), "lens distortion"),
        ("a.opencv.json", json.dumps(GOOD | {"image_size": [1e9, 5]}).encode(), "image size"),
        ("a.opencv.json", json.dumps(GOOD | {"pixel_mm": [0, 0.2]}).encode(), "above zero"),
        ("a.opencv.json", json.dumps(GOOD | {"covariance_of_matrix": [[-1.0] * 12] * 12}).encode(), "covariance"),
        (
            "a.opencv.json",
            json.dumps(
                GOOD
                | {
                    "camera_matrix": [[4000.0, 0, 500], [0, 5000, 480], [0, 0, 1]],
                    "rotation": np.eye(3).tolist(),
                    "translation_mm": [0, 0, 620],
                }
            ).encode(),
            "disagrees with",
        ),
        ("a.opencv.csv", b"1,2,3,4\n5,6,7\n", "3 x 4"),
        ("a.opencv.csv", b"1,0,0,inf\n0,1,0,0\n0,0,1,5\n", "3 x 4"),
        ("a.opencv.csv", b"\xff\xfe\x00", "not a text file"),
        ("a.opencv.npy", b"\x93NUMPY\x01\x00", "NumPy"),
        ("a.opencv.csv", b"0" * (2**22 + 1), "larger than 4 MiB"),
        ("a.mayacam2.txt", b"image size\n1,2\n", "14 lines"),
        ("a.mayacam2.txt", b"x\n" * 14, "heading 'image size' was expected"),
        ("a.diffdrr.json", b'{"sdd": -1}', "above zero"),
        ("a.diffdrr.json", b'{"orientation": "AP"}', "orientation=None: pose @ reorient"),
        ("a.diffdrr.json", b'{"reverse_x_axis": 1}', "reverse_x_axis as true or false"),
        ("a.deepdrr.json", b"[]", "one JSON object"),
        ("a.deepdrr.json", b"{}", "'intrinsic' is missing; the file has: nothing"),
        ("a.xreg.h5", b'{"cam-coord-frame-type": "up"}', "not readable HDF5"),
    ],
)
def test_what_is_no_view_is_refused_with_its_reason(tmp_path: Path, name: str, data: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(UnusableInputError, match=words) as refused:
        read_view(tmp_path / name)
    assert name in str(refused.value)
    assert len(str(refused.value)) < 500


def test_rtks_own_example_is_read_to_its_own_matrix() -> None:
    """From RTK's documentation: parameters and matrix of a projection."""
    given = {
        "SourceToIsocenterDistance": 1000.0,
        "SourceToDetectorDistance": 1536.0,
        "GantryAngle": 271.847274780273,
        "ProjectionOffsetX": -117.056503295898,
        "ProjectionOffsetY": -1.01195001602173,
    }
    wanted = [
        [-166.5093078829, 0, -1531.42837748039, -117056.503295898],
        [-1.01142410874151, -1536, 0.0326206557691505, -1011.95001602173],
        [-0.999480303105996, 0, 0.0322354417240802, -1000],
    ]
    assert np.allclose(rtk.matrix_mm(given), wanted, rtol=1e-11, atol=1e-9)


def test_rtks_parameters_and_matrix_must_agree(tmp_path: Path) -> None:
    files = write_view(Pinhole.of_matrix(np.array(GOOD["matrix"]), "a", (90, 80), (0.2, 0.2)), "rtk")
    (tmp_path / "a.rtk.mha").write_bytes(files["a.rtk.mha"])
    (tmp_path / "a.rtk.xml").write_bytes(files["a.rtk.xml"].replace(b"<InPlaneAngle>", b"<InPlaneAngle>1"))
    with pytest.raises(UnusableInputError, match="disagrees with"):
        read_view(tmp_path / "a.rtk.xml")


def test_what_a_format_cannot_state_is_refused() -> None:
    skew = np.array([[5000.0, 40, 500, 310000], [0, 5000, 480, 290000], [0, 0, 1, 620]])
    for kind in ("rtk", "diffdrr", "xreg"):
        with pytest.raises(UnusableInputError, match="skew"):
            write_view(Pinhole.of_matrix(skew, "a", (90, 80), (0.2, 0.2)), kind)
        with pytest.raises(UnusableInputError, match="size of a pixel"):
            write_view(Pinhole.of_matrix(np.array(GOOD["matrix"]), "a", (90, 80)), kind)
    with pytest.raises(UnusableInputError, match="image's size"):
        write_view(Pinhole.of_matrix(skew, "a"), "mayacam2")
    with pytest.raises(UnusableInputError, match="mirrored"):
        write_view(Pinhole.of_matrix(np.diag([-1.0, 1, 1]) @ GOOD["matrix"], "a", (90, 80), (0.2, 0.2)), "rtk")
    for unknown in ("maya", "vtkcam"):  # the latter is only read
        with pytest.raises(UnusableInputError, match="unknown format"):
            write_view(Pinhole.of_matrix(skew, "a"), unknown)


@pytest.mark.parametrize("sides", [(0, 512), (512, 0), (65537, 1), (1.5, 2), (None, 1)])
def test_an_image_has_whole_sides_of_1_to_65536_pixels(sides) -> None:
    with pytest.raises(UnusableInputError):
        image_shape(*sides)
    assert image_shape(1, 65536.0) == (1, 65536)
