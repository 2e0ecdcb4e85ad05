"""Meshes: read, refused, and crossed as the solids they stand for."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import OutsideRegionError, UnusableInputError
from sightline.imaging.volumes.meshes import Mesh, read_mesh
from sightline.imaging.volumes.rays import Rays
from sightline.twin import Scene, draw_setup
from sightline.twin.objects.things import Ball, Box, moved
from sightline.twin.xray.projector import box_length, mesh_lengths
from sightline.twin.xray.render import expose

FOCAL = np.array([3.0, -7.0, -600.0])
POINT = np.zeros((2, 3))  # a focal spot without size
EVERYWHERE = np.array([-1e9, -1e9, 1e9, 1e9])


def rays(side: int = 48, half_mm: float = 60.0) -> Rays:
    x, y = np.meshgrid(np.linspace(-half_mm, half_mm, side), np.linspace(-half_mm, half_mm, side))
    inside = np.zeros((side, side), dtype=bool)
    inside[1:-1, 1:-1] = True
    return Rays(FOCAL, np.stack([x, y, np.full_like(x, 300.0)], -1), inside)


def lengths(mesh: Mesh, cast: Rays) -> np.ndarray:
    """(4, H, W) mm, no triangle left out."""
    shadows = np.tile(EVERYWHERE, (len(mesh.triangles), 1))
    return mesh_lengths(cast, cast.points[..., :2].copy(), POINT, (mesh.vertices_mm, mesh.triangles), shadows)


def box_mesh(low_mm: np.ndarray, high_mm: np.ndarray, material: str, within: str | None) -> Mesh:
    """Return a cuboid between two corners (3,), with sides along the axes, such as a metal plate."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([[(a, b, c), (a, c, d)] for a, b, c, d in quads]).reshape(-1, 3)
    return Mesh(np.where(corners, high_mm, low_mm), triangles, material, within)


def sphere(radius_mm: float, points: int) -> Mesh:
    """The convex hull of points spread evenly over a sphere."""
    k = np.arange(points) + 0.5
    z, turn = 1 - 2 * k / points, np.pi * (1 + 5**0.5) * k
    at = radius_mm * np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], -1)
    hull = ConvexHull(at)
    a, b, c = np.moveaxis(at[hull.simplices], 1, 0)
    outwards = (np.cross(b - a, c - a) * a).sum(-1) > 0
    return Mesh(at, np.where(outwards[:, None], hull.simplices, hull.simplices[:, ::-1]))


def sub_rays(cast: Rays) -> np.ndarray:
    """(4, H - 2, W - 2, 3): the points that the sub-rays of an undistorted image go to, in their order."""
    pitch = cast.points[0, 1, 0] - cast.points[0, 0, 0]
    offsets = [(u, v) for v in (-0.25, 0.25) for u in (-0.25, 0.25)]
    return np.stack([cast.points[1:-1, 1:-1] + pitch * np.array([u, v, 0.0]) for u, v in offsets])


@settings(max_examples=10, deadline=None)
@given(
    at=st.tuples(*[st.floats(-15, 15)] * 3),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    half=st.tuples(*[st.floats(0.6, 20)] * 3),
)
def test_a_cuboid_of_triangles_has_the_lengths_of_a_cuboid(at, turn, half):
    motion = RigidTransform.from_components(np.array(at), Rotation.from_rotvec(turn))
    mesh = moved(box_mesh(-np.array(half), np.array(half), "steel", None), motion)
    box = moved(Box(np.zeros(3), np.eye(3), np.array(half)), motion)
    cast = rays()
    found = lengths(mesh, cast)
    for points, one in zip(sub_rays(cast), found, strict=True):
        fine = Rays(FOCAL, points, np.ones(points.shape[:2], dtype=bool))
        exact = box_length(fine, box.centre_mm[None], box.axes[None], box.half_mm[None])
        assert np.abs(one[1:-1, 1:-1] - exact).max() < 1e-4  # float32 of the cuboid's


def test_no_ray_slips_between_triangles_or_meets_both():
    """Rays exactly through the diagonals of two faces: each length is a cuboid's, never that of one crossing alone."""
    mesh = box_mesh(np.array([-10.0, -10.0, -5.0]), np.array([10.0, 10.0, 5.0]), "steel", None)
    cast = Rays(np.array([0.0, 0.0, -600.0]), *rays(61, 30.0)[1:])
    found = lengths(mesh, cast)
    assert found.min() == 0.0
    assert found.max() < 10.1
    assert np.abs(found[:, 30, 30] - 10.0).max() < 1e-4


def test_a_sphere_of_triangles_has_its_chords():
    mesh = sphere(20.0, 1500)
    assert mesh.volume_mm3 == pytest.approx(4 / 3 * np.pi * 20**3, rel=5e-3)
    cast = rays()
    found = lengths(mesh, cast)[:, 1:-1, 1:-1]
    d = sub_rays(cast) - FOCAL
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    across = np.linalg.norm(FOCAL - (d @ FOCAL)[..., None] * d, axis=-1)
    exact = 2 * np.sqrt(np.maximum(20.0**2 - across**2, 0.0))
    a, b, c = np.moveaxis(mesh.vertices_mm[mesh.triangles], 1, 0)
    sides = np.prod([np.linalg.norm(p - q, axis=-1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    circumradius = sides / (2 * np.linalg.norm(np.cross(b - a, c - a), axis=-1))
    sagitta = circumradius.max() ** 2 / 40.0
    assert sagitta < 0.08
    deep = exact > 10  # its error: the sagitta at either end, over the cosine at the surface
    assert np.abs(found - exact)[deep].max() < (2 * sagitta * 40.0 / exact[deep]).max()
    assert found[across > 20.0].max() == 0.0


def test_a_mesh_in_the_image_takes_what_its_ball_takes(frame):
    """Steel, the focal spot and distortion in it: a fine sphere against the exact ball, over the whole shadow."""
    view = draw_setup(np.random.default_rng(3), frame).views["pa"]
    at = np.array([8.0, -11.0, 20.0])
    mesh = sphere(6.0, 4000)
    steel = Mesh(mesh.vertices_mm + at, mesh.triangles, "steel", None)
    by_mesh = expose(view, Scene(meshes=(steel,))).quanta
    by_ball = expose(view, Scene(solids=(Ball((8.0, -11.0, 20.0), 6.0, within=None),))).quanta
    v, u = np.mgrid[:1024, :1024]
    middle = view.project(at)
    far = np.hypot(u - middle[0], v - middle[1])
    missed, taken = by_mesh - by_ball, np.median(by_ball[(far > 55) & (far < 60)]) - by_ball
    near = far < 60
    assert np.abs(missed[near]).max() < 0.25 * taken.max()  # one of four sub-rays at the edge, of sixteen the ball's
    assert abs(missed[near].sum()) < 2e-3 * taken[near].sum()  # facets lie within the ball
    for axis, at_px in zip((u, v), middle, strict=True):
        shift_px = (missed * (axis - at_px))[near].sum() / taken[near].sum()
        assert abs(shift_px) < 0.02


def test_a_mesh_behind_the_source_is_refused(frame):
    view = draw_setup(np.random.default_rng(4), frame).views["pa"]
    behind = moved(BOX, RigidTransform.from_translation(2 * view.focal_point_mm))
    with pytest.raises(OutsideRegionError):
        expose(view, Scene(meshes=(behind,)))


def written(mesh: Mesh, file_type: str) -> bytes:
    data = trimesh.Trimesh(mesh.vertices_mm, mesh.triangles, process=False).export(file_type=file_type)
    return data.encode() if isinstance(data, str) else data


BOX = box_mesh(np.array([-3.25, 1.5, -7.0]), np.array([4.5, 9.125, 11.0]), "bone", "tissue")
FILES = {"a.stl": "stl_ascii", "b.STL": "stl", "c.obj": "obj", "d.ply": "ply"}


@pytest.mark.parametrize("name", FILES)
def test_a_mesh_is_read_as_written(name, tmp_path):
    (tmp_path / name).write_bytes(written(BOX, FILES[name]))
    again = read_mesh(tmp_path / name, "titanium", None)
    assert (again.material, again.within) == ("titanium", None)
    assert len(again.vertices_mm) == 8
    assert again.volume_mm3 == pytest.approx(BOX.volume_mm3)
    assert np.abs(lengths(again, rays()) - lengths(BOX, rays())).max() < 1e-5


def test_a_mesh_that_faces_inwards_is_turned():
    inwards = Mesh(BOX.vertices_mm, BOX.triangles[:, ::-1])
    assert inwards.volume_mm3 == pytest.approx(BOX.volume_mm3)


def test_a_hollow_is_left_out():
    inner = box_mesh(np.array([-1.0, 3.0, -5.0]), np.array([2.0, 7.0, 9.0]), "bone", "tissue")
    hollow = Mesh(
        np.concatenate([BOX.vertices_mm, inner.vertices_mm]),
        np.concatenate([BOX.triangles, inner.triangles[:, ::-1] + 8]),
    )
    assert hollow.volume_mm3 == pytest.approx(BOX.volume_mm3 - inner.volume_mm3)
    left = lengths(BOX, rays()) - lengths(inner, rays())
    assert np.abs(lengths(hollow, rays()) - left).max() < 1e-9


V, T = BOX.vertices_mm, BOX.triangles
one_turned = np.concatenate([T[:-1], T[-1:, ::-1]])
BAD = {
    "not closed: 3": (V, T[:-1]),
    "all face outwards": (V, one_turned),
    "no triangles": (V, T[:0]),
    "not finite": (np.where(np.arange(8)[:, None] == 3, np.nan, V), T),
    "missing vertex": (V, T + 1),
    "give it in mm": (V / 1000, T),
    "10 mm long|1.8e.04 mm long": (V * 1000, T),
    "encloses nothing": (V * [1, 1, 0], T),
    "limit is": (V, np.tile(T, (200_000, 1))),
}


@pytest.mark.parametrize("why", BAD)
def test_what_bounds_no_solid_is_refused(why):
    with pytest.raises(UnusableInputError, match=why):
        Mesh(*BAD[why])


def test_files_that_hold_no_mesh_are_refused(tmp_path):
    whole = written(BOX, "stl")
    holed = Mesh.__new__(Mesh)
    object.__setattr__(holed, "vertices_mm", V)
    object.__setattr__(holed, "triangles", T[:-1])
    for name, data, why in [
        ("cut.stl", whole[:200], "damaged|no triangles"),  # as trimesh decodes it, with or without charset-normalizer
        ("empty.stl", b"", "damaged|no triangles"),
        ("noise.ply", bytes(range(256)) * 4, "damaged"),
        ("noise.obj", b"f 1 2 3\n", "damaged|not there|no triangles"),
        ("holed.stl", written(holed, "stl"), "holed.stl: the mesh is not closed"),
        ("box.step", whole, "stl, ply, obj"),
    ]:
        (tmp_path / name).write_bytes(data)
        with pytest.raises(UnusableInputError, match=why):
            read_mesh(tmp_path / name)
    with pytest.raises(UnusableInputError, match="cannot read"):
        read_mesh(tmp_path / "none.stl")
