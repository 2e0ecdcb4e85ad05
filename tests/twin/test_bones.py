"""Bones built of shapes: dimensions, exact distances, wires, landmarks, and what images show of them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from sightline.errors import SetUpError, UnusableInputError
from sightline.frame import Frame
from sightline.imaging.volumes.rays import Rays, volume_integral
from sightline.twin.anatomy.bone_model import BoneModel, PlaneAid, SphereAid
from sightline.twin.anatomy.bones import DOME_MM, GrowingFemur, Pelvis, Vertebra
from sightline.twin.anatomy.femur import to_cfcs
from sightline.twin.anatomy.shapes import ball, box, cone, half_space, plate
from sightline.twin.scenes.bone_scene import BONES, bone_document, draw_origin, placed_bone, shown_bone_scene
from sightline.twin.scenes.specimens import SetUpSpec, specimen
from sightline.twin.xray.setup import with_errors

BLOCK, NAILED = Frame.load("block60"), "nailed-femur"
BARE = [name for name in BONES if name != NAILED]
MIDDLE = {name: kind.draw(np.random.default_rng(11)).bone() for name, kind in BONES.items()}
WIDE = np.random.default_rng(5).uniform(-30, 30, (200, 3))


def brute(points: np.ndarray, samples: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - samples, axis=-1).min(axis=1)


def test_distances_of_shapes_are_those_of_their_points():
    a, b, c = np.array([[-9.0, 3.0, 5.0], [8.0, -6.0, 11.0], [2.0, 14.0, -7.0]])
    t = np.linspace(0, 1, 801)[:, None]
    balls = np.linalg.norm(WIDE[:, None] - (a + t * (b - a)), axis=-1) - (2.5 + 5.0 * t[:, 0])
    outside = balls.min(axis=1) > 0
    assert np.abs(cone(a, b, 2.5, 7.5).distance_mm(WIDE) - balls.min(axis=1))[outside].max() < 1e-3
    assert ball(a, 4.0).distance_mm(WIDE) == pytest.approx(np.linalg.norm(WIDE - a, axis=1) - 4.0)
    v, w = (s.ravel() for s in np.meshgrid(*2 * [np.linspace(0, 1, 101)]))
    inside = v + w <= 1
    triangle = a + v[inside, None] * (b - a) + w[inside, None] * (c - a)
    assert np.abs(plate(a, b, c, 1.5).distance_mm(WIDE) + 1.5 - brute(WIDE, triangle)).max() < 0.1  # steps of 0.2 mm
    core = np.stack(np.meshgrid(*(np.linspace(-h, h, 21) for h in (5.0, 2.0, 8.0)), indexing="ij"), -1).reshape(-1, 3)
    turned = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    found = box(a, [8.0, 5.0, 11.0], 3.0, turned).distance_mm(WIDE)
    assert np.abs(found + 3.0 - brute(WIDE, a + core @ turned))[found > 0].max() < 0.4  # steps of 0.8 mm
    assert half_space(a, [0.0, 0.0, 1.0]).distance_mm(WIDE) == pytest.approx(WIDE[:, 2] - 5.0)


def test_a_moved_shape_is_the_shape_elsewhere():
    a, b, c = np.array([[-9.0, 3.0, 5.0], [8.0, -6.0, 11.0], [2.0, 14.0, -7.0]])
    by = np.array([3.0, -2.0, 7.5])
    for shape in (cone(a, b, 2.5, 7.5), box(a, b + 10.0, 1.0), plate(a, b, c, 2.0)):
        assert shape.shifted(by).distance_mm(WIDE + by) == pytest.approx(shape.distance_mm(WIDE))


@pytest.mark.parametrize(("name", "of"), [("vertebra", "surface"), ("growing-femur", "cancellous")])
def test_distances_are_those_of_voxels(name: str, of: str):
    """A voxel on the other side of the surface is never nearer than the surface, and at most 1.5 voxels farther."""
    bone, side = MIDDLE[name], 0.35
    middle = bone.wires_mm[0].mean(axis=0) + 6.0 * np.eye(3)[2]
    steps = side * np.arange(-22, 23)
    grid = middle + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1)
    inside = bone.depth_mm(grid, of) < 0
    voxels = side * np.maximum(distance_transform_edt(~inside), distance_transform_edt(inside))
    reach = 22 * side - np.abs(grid - middle).max(axis=-1)
    known = np.argwhere(voxels < reach)  # nothing outside the box is nearer
    picked = tuple(np.random.default_rng(6).choice(known, 40).T)
    exact = bone.distance_mm(grid[picked], of)
    assert ((exact < 0) == inside[picked]).all()
    beyond = voxels[picked] - np.abs(exact)
    assert beyond.min() > -1e-3
    assert beyond.max() < 1.5 * side


def test_the_field_of_the_growth_plate_is_its_gap():
    """Along the wire, which crosses the plate at a right angle, bone is missing over the plate's width."""
    for femur in (GrowingFemur(physis_mm=2.0), GrowingFemur(physis_mm=3.0, slip_deg=40.0)):
        bone = femur.bone()
        entry, end = bone.wires_mm[0]
        at = entry + np.linspace(0.2, 0.99, 8001)[:, None] * (end - entry)
        step = 0.79 * np.linalg.norm(end - entry) / 8000
        assert (bone.depth_mm(at, "gap") < 0).sum() * step == pytest.approx(femur.physis_mm, abs=2 * step)
        assert (bone.depth_mm(at, "outline") < 0).all()
        plane = bone.aids["growth plate"]
        assert isinstance(plane, PlaneAid)
        assert np.abs(np.cross(plane.normal, end - entry)).max() < 1e-9
        edges = [bone.landmarks_mm[f"growth plate, {edge} edge"] for edge in ("upper", "lower")]
        assert np.mean(edges, axis=0) == pytest.approx(plane.point_mm)  # the plane through them
        assert np.linalg.norm(edges[0] - edges[1]) == pytest.approx(2 * plane.half_mm)
        off = (at[bone.depth_mm(at, "gap") < 0] - plane.point_mm) @ plane.normal
        assert off.max() == pytest.approx(DOME_MM - np.sqrt(DOME_MM**2 - plane.half_mm**2), abs=2 * step)


def test_a_head_slips_by_its_angle_towards_posterior_and_inferior():
    for angle, towards in ((0.0, 0.0), (20.0, 0.0), (40.0, 90.0)):
        femur = GrowingFemur(slip_deg=angle, slip_towards_deg=towards)
        assert np.degrees(np.arccos(min(femur.along @ femur.along_neck, 1.0))) == pytest.approx(angle, abs=1e-5)
        shift = femur.along - femur.along_neck
        if angle:
            assert (shift[2] if towards == 0.0 else -shift[1]) < -0.3
    edges = GrowingFemur().bone().landmarks_mm
    rim = np.linalg.norm(edges["growth plate, upper edge"] - edges["growth plate, lower edge"])
    assert DOME_MM * np.radians(30) / rim == pytest.approx(1 / 3, abs=0.06)  # both limits of a mild slip


def chord(bone: BoneModel, middle: np.ndarray, across: np.ndarray) -> float:
    return float(np.linalg.norm(bone.surface_near(middle, across) - bone.surface_near(middle, -across)))


def test_a_vertebra_has_its_dimensions():
    """The ranges are those of the sources in docs/bones.md."""
    rng = np.random.default_rng(7)
    for _ in range(2):
        drawn = BONES["vertebra"].draw(rng)
        assert isinstance(drawn, Vertebra)
        bone, axis = drawn.bone(), np.eye(3)
        width = np.array([drawn.along[2], 0.0, -drawn.along[0]])
        along = [drawn.pedicle_mm + t * drawn.along for t in np.linspace(-4, 4, 9)]
        narrowest = [min(chord(bone, at, across) for at in along) for across in (width, axis[1])]
        assert narrowest == pytest.approx([drawn.pedicle_width_mm, drawn.pedicle_height_mm], abs=0.05)
        assert chord(bone, np.zeros(3), axis[1]) == pytest.approx(drawn.body_height_mm, abs=0.01)
        upper = np.array([0.0, 2.5 - drawn.body_height_mm / 2, 0.0])
        assert chord(bone, upper, axis[0]) == pytest.approx(drawn.body_width_mm, rel=0.05)  # above the waist
        canal = np.array([0.0, -5.0, -(drawn.body_depth_mm + drawn.canal_depth_mm) / 2])
        assert 2 * bone.surface_near(canal, axis[0])[0] == pytest.approx(drawn.canal_width_mm, abs=0.01)
        assert 7.2 < drawn.pedicle_width_mm < 17.8
        assert 13.9 <= drawn.pedicle_height_mm <= 16.7


def test_a_pelvis_has_its_dimensions():
    """The corridor to 1.5 mm: it blends into ala and body. The ranges are those of the sources in docs/bones.md."""
    rng = np.random.default_rng(10)
    for _ in range(2):
        drawn = BONES["pelvis"].draw(rng)
        assert isinstance(drawn, Pelvis)
        bone, (_, down, forwards) = drawn.bone(), drawn.axes
        along = [drawn.corridor_mm + np.array([x, 0.0, 0.0]) for x in np.linspace(-4, 4, 9)]
        height, depth = (min(chord(bone, at, across) for at in along) for across in (down, forwards))
        assert height == pytest.approx(drawn.corridor_height_mm, abs=1.5)
        assert depth == pytest.approx(drawn.corridor_depth_mm, abs=1.5)
        assert 16.5 < height < 21.5
        front = bone.surface_near(drawn.at(0.0, 3.0 - drawn.body_height_mm / 2, 0.0), forwards) @ forwards
        assert front == pytest.approx(drawn.body_depth_mm / 2, rel=0.05)  # above the waist
        side = np.array([drawn.sacrum_width_mm / 2 - 3.0, 4.0, -8.0])  # the joint is crossed about straight here
        at = side + np.linspace(0.0, 12.0, 2401)[:, None] * np.array([1.0, 0.0, 0.0])
        gap = at[bone.depth_mm(at, "gap") < 0]
        assert bone.distance_mm(gap[[0, -1]], "gap") == pytest.approx(0.0, abs=0.01)
        assert gap[0, 0] == pytest.approx(drawn.sacrum_width_mm / 2, abs=2.5)
        assert drawn.joint_mm - 0.1 < gap[-1, 0] - gap[0, 0] < 1.5 * drawn.joint_mm


@pytest.mark.parametrize("name", BARE)
def test_wires_lie_in_their_corridors_and_landmarks_on_the_surface(name: str):
    for bone in (MIDDLE[name], BONES[name].draw(np.random.default_rng(8)).bone()):
        for wire in bone.wires_mm:
            assert abs(bone.depth_mm(wire[0], "outline")) < 1e-6  # the entry lies on the surface
            assert bone.clearance_mm(wire) > 3.4  # room for an implant of 6.8 mm
            for of in bone.keep_out:
                assert bone.clearance_mm(wire, of, from_entry_mm=0.0) > 3.4
            assert 40 < np.linalg.norm(wire[1] - wire[0]) < 110
        centres = [aid.centre_mm for aid in bone.aids.values() if isinstance(aid, SphereAid)]
        points = [at for at in bone.landmarks_mm.values() if not any(np.array_equal(at, c) for c in centres)]
        assert len(points) >= 4
        assert np.abs(bone.distance_mm(np.stack(points))).max() < 1e-6


def test_wires_of_a_nailed_femur_pass_the_middle_of_its_nails_holes():
    rng = np.random.default_rng(10)
    drawn = BONES[NAILED].draw(rng)
    bone, half = drawn.bone(), drawn.diameter_mm / 2
    for wire, (at, axis) in zip(bone.wires_mm, drawn.nail.holes[::-1], strict=True):
        assert wire[0, 0] > wire[1, 0] + 9.0  # from lateral
        assert np.abs(wire - at + np.outer([half, -half], axis)).max() < 1e-9
        assert bone.distance_mm(wire).min() > 0.3  # in the reamed canal
    epicondyles = [at for name, at in bone.landmarks_mm.items() if "epicondyle" in name]
    assert np.abs(bone.distance_mm(np.stack(epicondyles))).max() < 1e-6
    setup = BONES[NAILED].setup(rng, BLOCK, "left")
    scene = placed_bone(setup, NAILED, drawn, setup.hip_mm, rng)
    (nail,) = scene.bone.meshes
    assert np.abs(nail.vertices_mm - to_cfcs(drawn.nail.mesh().vertices_mm, "left", setup.hip_mm)).max() < 1e-9
    assert nail.volume_mm3 > 0


@pytest.mark.parametrize(("name", "side"), [("growing-femur", "left")])
def test_landmarks_lie_on_the_edge_of_the_shadow(name: str, side: str):
    """Where the surface turns away from the beam, rays 1.5 mm inside a landmark pass bone that those outside miss."""
    bone = replace(MIDDLE[name], around=(), voxel_mm=1.0)
    setup = BONES[name].setup(np.random.default_rng(12), BLOCK, side)
    origin = setup.hip_mm + draw_origin(bone, side, np.random.default_rng(13))
    volume = bone.volume(side, origin, None)
    seen = 0
    for at in bone.landmarks_mm.values():
        slope = np.array([bone.depth_mm(at + 0.01 * e) - bone.depth_mm(at - 0.01 * e) for e in np.eye(3)]) / 0.02
        normal = to_cfcs(slope / np.linalg.norm(slope), side, np.zeros(3))
        for view in setup.views.values():
            placed = to_cfcs(at, side, origin)
            beam = (placed - view.focal_point_mm) / np.linalg.norm(placed - view.focal_point_mm)
            if abs(normal @ beam) > 0.25 or abs(np.linalg.norm(slope) - 1) > 0.1:  # not on the outline; a corner
                continue
            points = view.focal_point_mm + 1.6 * (placed + np.outer([-1.5, 1.5], normal) - view.focal_point_mm)
            rays = Rays(view.focal_point_mm, points[:, None], np.ones((2, 1), dtype=bool))
            inside, outside = volume_integral(rays, volume.values, volume.origin_mm, volume.voxel_mm)[:, 0]
            assert inside > outside + 0.4
            seen += 1
    assert seen >= 3


def test_a_scene_states_its_truth_in_cfcs():
    setup, scene = shown_bone_scene(np.random.default_rng(14), BLOCK, "growing-femur", "left")
    assert scene.scene.solids[: len(BLOCK.fiducials)] == scene.still.solids
    assert scene.wires_mm == pytest.approx(to_cfcs(scene.truth.wires_mm, "left", scene.origin_mm))
    for view in setup.views.values():
        assert view.in_field(view.project(scene.wires_mm), 60.0).all()
    ours, theirs = (np.stack(list(one.landmarks_mm.values())) for one in (scene, scene.truth))
    by = np.array([3.0, -3.0, 3.0])  # caudal is -Y of a left side
    assert scene.distance_mm(ours + 3.0) == pytest.approx(scene.truth.distance_mm(theirs + by), abs=1e-6)
    for key, aid in scene.aids.items():
        if isinstance(aid, PlaneAid):
            original = scene.truth.aids[key]
            assert isinstance(original, PlaneAid)
            assert aid.normal == pytest.approx(original.normal * [1, -1, 1])
    document = bone_document(setup, scene)
    assert json.loads(json.dumps(document))["dimensions"] == document["dimensions"]
    for view in setup.views:
        there = setup.views[view].project(scene.wires_mm)
        assert np.allclose(document["views"][view]["wires_uv_px"], there)


def test_what_is_not_there_is_refused():
    with pytest.raises(SetUpError, match="surface, outline, cancellous, gap, canal"):
        MIDDLE["vertebra"].distance_mm(np.zeros(3), "foramen")
    with pytest.raises(SetUpError, match="start it inside"):
        MIDDLE["vertebra"].surface_mm(np.array([0.0, 0.0, 90.0]), np.array([0.0, 0.0, 1.0]))


def test_views_that_plates_do_not_show_are_refused(frame: Frame):
    with pytest.raises(SetUpError, match="inlet, outlet; use a solid frame"):
        BONES["pelvis"].setup(np.random.default_rng(1), frame)
    views = BONES["pelvis"].setup(np.random.default_rng(1), BLOCK, "left").views
    towards = {name: view.detector.normal for name, view in views.items()}  # of a left side the head is at +Y
    assert towards["inlet"][1] == pytest.approx(np.sin(np.radians(24.9)), abs=0.2)  # beams vary by 3.6° s.d.
    assert towards["outlet"][1] == pytest.approx(-np.sin(np.radians(42.4)), abs=0.2)


def test_a_specimen_keeps_the_manufactured_frame_and_refuses_what_its_views_do_not_have():
    made = with_errors(BLOCK, np.random.default_rng(2))
    drawn = specimen("growing-femur", np.random.default_rng(3), SetUpSpec(BLOCK, made=made))
    assert drawn.setup.true_frame is made
    assert drawn.setup.frame is BLOCK
    assert drawn.shown
    assert drawn.wire_mm == pytest.approx(np.array(drawn.truth["wires_mm"][0]))
    assert drawn.truth["aids"]["head"]["kind"] == "sphere"
    with pytest.raises(UnusableInputError, match="leave it out"):
        specimen("growing-femur", np.random.default_rng(3), SetUpSpec(BLOCK, oblique=True))
    with pytest.raises(UnusableInputError, match="fixed position"):
        specimen("pelvis", np.random.default_rng(3), SetUpSpec(BLOCK), np.zeros(3))
