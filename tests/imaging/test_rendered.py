"""What a view sees of a CT: exact chords, the convention of matrices, distortion, poses; and what cannot be seen."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import RigidTransform, Rotation

import sightline as sl
from sightline.calibration.exchange.pose_file import read_pose
from sightline.case.interop.formats import transform_bytes
from sightline.errors import OutsideRegionError, UnusableInputError
from sightline.frame import Frame
from sightline.imaging.volumes import CtScan, Mesh, filled
from sightline.studies.scenes import measure
from sightline.twin import draw_setup

WATER_PER_MM = 0.0206  # at 60 keV [calc, xraydb]
RADIUS_MM, HU = 14.0, 700
CENTRE_MM = np.array([11.3, -7.9, 5.2])
TURN = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()
K = np.array([[3100.0, 0, 270.4], [0, 3000.0, 230.8], [0, 0, 1]])
SHAPE = (470, 520)


def ball(axes: np.ndarray = TURN) -> CtScan:
    """A ball about CENTRE_MM, off the voxels, which are not cubes; its edge is a voxel wide."""
    voxel, counts = np.array([0.7, 0.9, 1.3]), (60, 50, 34)
    origin = CENTRE_MM - (voxel * np.array([30.3, 24.6, 16.8])) @ axes
    xyz = origin + (np.moveaxis(np.indices(counts), 0, -1) * voxel) @ axes
    share = np.clip(RADIUS_MM - np.linalg.norm(xyz - CENTRE_MM, axis=-1) + 0.5, 0, 1)
    return CtScan(np.rint(-1000 + share * (HU + 1000)).astype(np.int16), origin, voxel, axes)


def camera(rotation: np.ndarray, distance_mm: float = 640.0) -> np.ndarray:
    return K @ np.column_stack([rotation, [3.0, -2.0, distance_mm]])


def depth(image: sl.Radiograph) -> np.ndarray:
    return -np.log(np.maximum(image.pixels, 1) / image.white)


def chord(matrix: np.ndarray, centre_mm: np.ndarray, uv: np.ndarray, radius_mm: float) -> np.ndarray:
    """The ball's chords along the rays of pixels by OpenCV's convention, computed by hand."""
    source = -np.linalg.inv(matrix[:, :3]) @ matrix[:, 3]
    d = np.column_stack([uv, np.ones(len(uv))]) @ np.linalg.inv(matrix[:, :3]).T
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    across = np.linalg.norm(np.cross(d, centre_mm - source), axis=1)
    return 2 * np.sqrt(np.maximum(radius_mm**2 - across**2, 0))


def projected(matrix: np.ndarray, xyz_mm: np.ndarray) -> np.ndarray:
    u, v, w = matrix @ np.append(xyz_mm, 1.0)
    return np.array([u / w, v / w])


@pytest.mark.parametrize("sign", [1.0, -2.5], ids=["positive", "of the other sign and scale"])
def test_a_pixel_holds_the_chord_of_its_ray(sign):
    matrix = camera(Rotation.from_rotvec([1.1, 0.5, -0.8]).as_matrix())
    image = sl.render(ball(), sl.view_from_matrix(sign * matrix), shape=SHAPE)
    uv = projected(matrix, CENTRE_MM) + np.array([[0, 0], [31, 0], [0, 40], [-25, -22]])
    at = np.rint(uv).astype(int)
    exact = WATER_PER_MM * (HU + 1000) / 1000 * chord(matrix, CENTRE_MM, at, RADIUS_MM)
    assert exact.min() > 0.6
    assert depth(image)[at[:, 1], at[:, 0]] == pytest.approx(exact, rel=0.01)  # voxels of 1.3 mm round the edge off
    assert image.shape == SHAPE
    assert image.pixels[0, 0] == image.white == 65535


def test_a_pose_takes_the_ct_into_the_view(tmp_path: Path):
    """The same image as of a CT that lies there."""
    pose = RigidTransform.from_components([12.0, -9.0, 14.0], Rotation.from_rotvec([0.3, 0.2, -0.5]))
    view = sl.view_from_matrix(camera(np.eye(3)))
    scan = ball()
    there = replace(scan, origin_mm=pose.apply(scan.origin_mm), axes=scan.axes @ pose.rotation.as_matrix().T)
    expected = sl.render(there, view, shape=SHAPE).pixels
    assert np.abs(sl.render(scan, view, pose, SHAPE).pixels.astype(int) - expected).max() <= 1
    (tmp_path / "pose.json").write_text(json.dumps(pose.as_matrix().tolist()))
    (tmp_path / "pose.tfm").write_bytes(transform_bytes(pose.as_matrix(), "CFCS from CT"))
    centre = np.array([4.0, 5.0, 6.0])
    shifted = pose.as_matrix()
    shifted[:3, 3] += shifted[:3, :3] @ centre - centre
    text = transform_bytes(shifted, "about a centre").replace(b"FixedParameters: 0 0 0", b"FixedParameters: 4 5 6")
    (tmp_path / "centre.tfm").write_bytes(text)
    for name in ("pose.json", "pose.tfm", "centre.tfm"):
        assert np.allclose(read_pose(tmp_path / name).as_matrix(), pose.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("method", ["smooth", "localized"])
def test_a_distorted_view_sees_along_its_lines_of_sight(method):
    frame = Frame.load("gamma")
    setup = draw_setup(np.random.default_rng(21), frame)
    view = sl.calibrate(measure(np.random.default_rng(3), setup, 0.1)["pa"], frame, view="pa", method=method)
    at = np.array([[661, 610], [678, 617], [647, 590], [642, 621]])  # off the middle and off the interpolated grid
    lines = view.lines_of_sight(at.astype(np.float64))
    centre = lines.points_mm[0]
    image = sl.render(ball(), view, RigidTransform.from_translation(centre - CENTRE_MM), (1024, 1024))
    assert view.project(centre[None])[0] == pytest.approx(at[0], abs=1e-3)
    across = np.linalg.norm(np.cross(lines.directions, centre - view.focal_point_mm), axis=1)
    exact = WATER_PER_MM * (HU + 1000) / 1000 * 2 * np.sqrt(RADIUS_MM**2 - across**2)
    assert depth(image)[at[:, 1], at[:, 0]] == pytest.approx(exact, rel=0.01)
    assert image.pixels[0, 0] == 0  # not calibrated


def test_a_mesh_is_seen_through_its_cortex():
    shell = trimesh.creation.icosphere(5, RADIUS_MM)
    scan = filled(Mesh(shell.vertices + CENTRE_MM, shell.faces), 2.5)
    matrix = camera(TURN)
    image = sl.render(scan, sl.view_from_matrix(matrix), shape=SHAPE)
    at = np.rint(projected(matrix, CENTRE_MM) + np.array([[0, 0], [20, 11], [-30, 20]])).astype(int)
    outer, inner = (chord(matrix, CENTRE_MM, at, radius) for radius in (RADIUS_MM, RADIUS_MM - 2.5))
    exact = 0.0604 * (outer - inner) + WATER_PER_MM * 1.132 * inner  # cortical bone at 60 keV, cancellous of 132 HU
    assert depth(image)[at[:, 1], at[:, 0]] == pytest.approx(exact, rel=0.03)  # 0.1 mm of cortex on each side


def test_a_filled_mesh_has_the_mesh_s_volume_and_its_hollow():
    outer, inner = trimesh.creation.icosphere(3, 15.0), trimesh.creation.box([9.0, 8.0, 7.0])
    vertices = np.concatenate([outer.vertices, inner.vertices + 0.3]) @ TURN
    mesh = Mesh(vertices, np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]))
    scan = filled(mesh, 100.0)
    share = (scan.hu + 1000) / (scan.hu.max() + 1000)
    assert share.sum() * scan.voxel_mm.prod() == pytest.approx(mesh.volume_mm3, rel=2e-3)
    assert share[tuple(np.rint((0.3 * TURN.sum(axis=0) - scan.origin_mm) / scan.voxel_mm).astype(int))] == 0
    with pytest.raises(UnusableInputError, match="cortex is -1 mm"):
        filled(mesh, -1.0)


@pytest.mark.parametrize(
    ("shape", "shift_mm", "why"),
    [
        (None, 0, "does not state the size of its image"),
        ((0, 40), 0, "40 x 0 pixels"),
        ((30000, 30000), 0, "cannot be made"),
        (SHAPE, 400, "does not show the volume"),
    ],
)
def test_what_cannot_be_seen_is_refused(shape, shift_mm, why):
    pose = RigidTransform.from_translation([shift_mm, 0.0, 0.0])
    with pytest.raises((UnusableInputError, OutsideRegionError), match=why):
        sl.render(ball(), sl.view_from_matrix(camera(np.eye(3))), pose, shape)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (json.dumps(np.diag([1.1, 1, 1, 1]).tolist()), "not a rigid pose"),
        (json.dumps(np.diag([-1.0, 1, 1, 1]).tolist()), "left-handed"),
        ("[[1, 0, 0], [0, 1, 0], [0, 0, 1]]", "4 x 4 finite numbers"),
        ('{"pose": []}', "'matrix' is missing"),
        ("#Insight Transform File V1.0\nTransform: BSplineTransform_double_3_3\n", "it holds BSpline"),
        ("#Insight Transform File V1.0\nTransform: AffineTransform_double_3_3\nParameters: 1 2\n", "FixedParam|12"),
    ],
)
def test_what_is_no_pose_is_refused(text, why, tmp_path):
    (tmp_path / "pose").write_text(text)
    with pytest.raises(UnusableInputError, match=why):
        read_pose(tmp_path / "pose")
