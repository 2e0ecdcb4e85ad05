"""Volumes cut, broken and moved, and hips that move."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation
from tests.twin.test_render import coarse

from sightline.errors import SetUpError
from sightline.imaging.volumes.beam import WEIGHTS, attenuation_per_mm
from sightline.imaging.volumes.rays import Rays, volume_integral
from sightline.imaging.volumes.volume import Volume, bored, fractured
from sightline.twin import Scene, draw_setup, hip_scene, write_truth
from sightline.twin.objects.things import Ball, BoneMotion, Box, Rod, SoftTissue, draw_motion, moved
from sightline.twin.scenes.specimens import broken, plastic_hip
from sightline.twin.xray.render import expose

VOXEL = np.array([0.7, 0.8, 1.0])


def block(shape=(60, 50, 40)) -> Volume:
    return Volume(np.ones(shape), np.array([-21.0, -20.0, -19.5]), VOXEL)


def filled_mm3(volume: Volume) -> float:
    return float(volume.values.sum(dtype=np.float64) * volume.voxel_mm.prod())


def share_at(volume: Volume, xyz_mm: np.ndarray) -> np.ndarray:
    i, j, k = np.rint((xyz_mm - volume.origin_mm) @ volume.axes.T / volume.voxel_mm).astype(int).T
    return volume.values[i, j, k]


def motion(seed: int = 5) -> RigidTransform:
    rng = np.random.default_rng(seed)
    return RigidTransform.from_components(rng.normal(0, 20, 3), Rotation.random(rng=rng))


def test_a_bore_takes_its_cylinder():
    ends = np.array([[-9.3, -6.2, -7.1], [8.4, 7.7, 9.9]])
    length = np.linalg.norm(ends[1] - ends[0])
    taken = filled_mm3(block()) - filled_mm3(bored(block(), ends, 8.0))
    assert taken == pytest.approx(np.pi * 16 * length, rel=0.01)
    on_axis = ends[0] + np.linspace(0.1, 0.9, 9)[:, None] * (ends[1] - ends[0])
    assert (share_at(bored(block(), ends, 8.0), on_axis) == 0).all()
    beyond = ends[1] + 2.0 * (ends[1] - ends[0]) / length
    assert share_at(bored(block(), ends, 8.0), beyond[None])[0] == 1.0


@pytest.mark.parametrize("gap", [0.0, 1.5])
def test_fragments_are_the_whole_less_the_gap(gap):
    at, normal = np.array([0.4, -1.3, 2.2]), np.array([0.3, 0.2, 1.0])
    behind, before = fractured(block(), at, normal, gap)
    area = 60 * 50 * 0.7 * 0.8 * np.linalg.norm(normal) / normal[2]
    left = filled_mm3(behind) + filled_mm3(before)
    assert filled_mm3(block()) - left == pytest.approx(gap * area, abs=0.03 * area)
    unit = normal / np.linalg.norm(normal)
    assert share_at(behind, (at - 3 * unit)[None])[0] == share_at(before, (at + 3 * unit)[None])[0] == 1.0
    assert share_at(behind, (at + 3 * unit)[None])[0] == share_at(before, (at - 3 * unit)[None])[0] == 0.0


@pytest.mark.parametrize(
    "cut",
    [
        lambda: bored(block(), np.zeros((2, 3)), 8.0),
        lambda: bored(block(), np.eye(3)[:2], 0.0),
        lambda: fractured(block(), np.zeros(3), np.zeros(3)),
        lambda: fractured(block(), np.zeros(3), np.ones(3), -1.0),
        lambda: Volume(np.ones((1, 4, 4)), np.zeros(3), VOXEL),
        lambda: Scene(tissue=SoftTissue()) + Scene(tissue=SoftTissue()),
    ],
)
def test_cuts_and_sums_without_meaning_are_refused(cut):
    with pytest.raises(SetUpError):
        cut()


def test_a_moved_volume_is_crossed_as_the_rays_moved_back(frame):
    """The renderer's own way through a moved volume: its image is that of a solid block, moved alike."""
    view = draw_setup(np.random.default_rng(3), frame).views["pa"]
    small = RigidTransform.from_components(np.array([3.0, -4.0, 6.0]), Rotation.from_rotvec([0.2, -0.3, 0.4]))
    whole = moved(Volume(np.ones((60, 50, 40)), np.array([-21.0, -20.0, -19.5]), VOXEL, within=None), small)
    middle = np.array([-21.0, -20.0, -19.5]) + VOXEL * (np.array([60, 50, 40]) - 1) / 2
    cuboid = Box(middle, np.eye(3), VOXEL * (np.array([60, 50, 40]) - 1) / 2, material="bone")
    by_volume = expose(view, Scene(volumes=(whole,))).quanta
    by_box = expose(view, Scene(boxes=(moved(cuboid, small),))).quanta
    u, v = np.rint(view.project(small.apply(middle))).astype(int)
    part = (slice(v - 50, v + 50), slice(u - 50, u + 50))
    assert np.abs(by_volume[part] / by_box[part] - 1).max() < 0.003


def test_finely_voxelled_volumes_are_cast_for_every_pixel(frame):
    view = coarse(draw_setup(np.random.default_rng(3), frame).views["pa"])
    rays = Rays(np.array([0.0, 0, -600]), np.array([[[0.0, 0, 400]]]), np.ones((1, 1), dtype=bool))
    fine = Volume(np.ones((80, 80, 80)), np.full(3, -8.0), np.full(3, 0.2), within=None)
    way = volume_integral(rays, fine.values, fine.origin_mm, fine.voxel_mm)[0, 0]
    assert way == pytest.approx(15.8, abs=0.01)
    left = expose(view, Scene(volumes=(fine,)), even_scatter=True).quanta
    open_field = expose(view, Scene(), even_scatter=True).quanta
    u, v = np.rint(view.project(np.array([-0.1, -0.1, -0.1]))).astype(int)
    taken = left[v, u] / left.max() / (open_field[v, u] / open_field.max())
    primary = float(WEIGHTS @ np.exp(-15.8 * attenuation_per_mm("bone")))
    assert primary < taken < primary + 0.4  # and the scatter of 0.6 of the mean


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_a_motion_and_its_inverse_leave_things_where_they_were(seed):
    there = motion(seed)
    axis = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()[0]
    rod = Rod((1.0, 2.0, 3.0), (float(axis[0]), float(axis[1]), float(axis[2])), 1.0, 5.0)
    scene = Scene(
        solids=(Ball((4.0, 5.0, 6.0), 1.5), rod),
        boxes=(Box(np.array([7.0, 8, 9]), np.eye(3), np.ones(3)),),
        volumes=(block((4, 4, 4)),),
        tissue=SoftTissue(),
    )
    back = moved(moved(scene, there), there.inv())
    assert np.allclose(back.solids[0].centre_mm, scene.solids[0].centre_mm)
    assert np.allclose(back.solids[1].axis, rod.axis)
    assert np.allclose(back.boxes[0].axes, scene.boxes[0].axes)
    assert np.allclose(back.volumes[0].origin_mm, scene.volumes[0].origin_mm)
    assert np.allclose(back.volumes[0].axes, np.eye(3))
    assert back.tissue == scene.tissue
    end = np.array(rod.centre_mm) + rod.half_mm * np.array(rod.axis)
    after = moved(rod, there)
    assert np.allclose(np.array(after.centre_mm) + after.half_mm * np.array(after.axis), there.apply(end))


def test_drawn_motions_are_as_large_as_said():
    rng, about = np.random.default_rng(8), np.array([30.0, -20.0, 10.0])
    drawn = [draw_motion(rng, about, BoneMotion(2.0, 0.01)) for _ in range(2000)]
    shift = np.array([one.apply(about) - about for one in drawn])
    turn = np.array([one.rotation.as_rotvec() for one in drawn])
    assert shift.std(axis=0) == pytest.approx([2.0] * 3, rel=0.06)
    assert turn.std(axis=0) == pytest.approx([0.01] * 3, rel=0.06)
    assert np.abs(shift.mean(axis=0)).max() < 0.15


@pytest.fixture(scope="module")
def hip(frame):
    setup = draw_setup(np.random.default_rng(9), frame)
    return setup, hip_scene(setup, np.random.default_rng(10))


def test_a_bone_that_moves_takes_its_targets_along_and_leaves_the_frame(hip, tmp_path):
    from dataclasses import replace

    setup, still = hip
    small = RigidTransform.from_components(np.array([2.0, -1.0, 0.5]), Rotation.from_rotvec([0.01, 0.0, 0.02]))
    moving = replace(still, motions={"lateral": small, "drilling": small * small})
    then = moving.at("lateral")
    assert np.array_equal(moving.at("pa").wire_mm, still.wire_mm)
    assert np.allclose(then.wire_mm, small.apply(still.wire_mm))
    assert np.allclose(then.head_mm, small.apply(still.head_mm))
    assert np.allclose(moving.at("drilling").head_mm, small.apply(then.head_mm))
    assert then.scene.solids == still.scene.solids
    (bone,) = then.scene.volumes
    inside = still.head_mm + np.array([[0.0, 0, 0], [3, -2, 4]])
    assert np.array_equal(share_at(bone, small.apply(inside)), share_at(still.scene.volumes[0], inside))
    written = json.loads(write_truth(tmp_path / "truth.json", setup, moving).read_text())
    assert np.allclose(written["bone_moved"]["lateral"], small.as_matrix())
    assert np.allclose(written["entry_mm"], still.wire_mm[0])
    seen = {name: setup.views[name].project(moving.at(name).wire_mm[0]) for name in setup.views}
    assert np.allclose(written["views"]["lateral"]["entry_uv_px"], seen["lateral"])
    assert np.allclose(written["views"]["pa"]["entry_uv_px"], setup.views["pa"].project(still.wire_mm[0]))
    assert np.linalg.norm(seen["lateral"] - setup.views["lateral"].project(still.wire_mm[0])) > 3
    unmoved = json.loads(write_truth(tmp_path / "still.json", setup, still).read_text())
    assert "bone_moved" not in unmoved


def test_a_broken_hip_shows_its_gap_and_its_displacement(hip):
    _, whole = hip
    line = broken(whole, "right", gap_mm=2.0)
    shaft, head = line.bone.volumes
    assert share_at(head, whole.head_mm[None])[0] == share_at(whole.bone.volumes[0], whole.head_mm[None])[0]
    assert share_at(shaft, whole.head_mm[None])[0] == 0.0
    lost = filled_mm3(whole.bone.volumes[0]) - filled_mm3(shaft) - filled_mm3(head)
    assert 0 < lost < 0.05 * filled_mm3(whole.bone.volumes[0])
    slip = RigidTransform.from_translation([3.0, 0.0, -4.0])
    displaced = broken(whole, "right", 2.0, slip)
    assert np.allclose(displaced.bone.volumes[0].origin_mm, shaft.origin_mm + np.array([3.0, 0.0, -4.0]))
    assert np.array_equal(displaced.bone.volumes[1].origin_mm, head.origin_mm)


def test_the_plastic_femur_has_its_bore_along_the_wire(frame):
    setup = draw_setup(np.random.default_rng(11), frame, side="left")
    plastic = plastic_hip(setup)
    (bone,) = plastic.bone.volumes
    assert (bone.material, bone.within, plastic.scene.tissue) == ("composite", None, None)
    entry, end = plastic.wire_mm
    assert np.allclose((entry + end) / 2, 0.0)
    on_axis = entry + np.linspace(0.02, 0.98, 40)[:, None] * (end - entry)
    along = (end - entry) / np.linalg.norm(end - entry)
    across = np.linalg.svd(along[None])[2][1]
    assert (share_at(bone, on_axis) == 0).all()
    assert (share_at(bone, on_axis + 3.0 * across) == 0).all()
    assert (share_at(bone, on_axis[5:] + 5.5 * across) > 0.05).all()
    shell = entry + np.arange(0.0, 9.0, 0.5)[:, None] * along
    assert share_at(bone, np.concatenate([shell + 5.5 * across, shell - 5.5 * across])).max() > 0.7  # beside the bore
