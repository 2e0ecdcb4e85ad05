"""A wire in bone, against thrust and bending worked out by hand on blocks whose truth is simple."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import SetUpError
from sightline.imaging.volumes.volume import Volume, bored
from sightline.twin.anatomy.femur import BONE_PER_HU, Femur, to_cfcs, voxelise
from sightline.twin.robot.drilling import AXIAL_N_PER_MM, Bone, Wire, sensed

STEP_S = 0.005
VOXEL_MM = 0.5
UPRIGHT = np.eye(3)  # the tool's axes: the wire along +z


def block(share=1.0, slope_deg=0.0, thick_mm=60.0, **kwargs):
    """Bone below the plane through the origin whose normal is tilted in XZ, `thick_mm` deep along it: partial volumes
    at its faces."""
    grid = np.stack(np.meshgrid(*[np.arange(-20, 20, VOXEL_MM)] * 2, np.arange(-10, 70, VOXEL_MM), indexing="ij"), -1)
    normal = np.array([np.sin(np.deg2rad(slope_deg)), 0.0, np.cos(np.deg2rad(slope_deg))])
    depth = grid @ normal
    inside = np.clip(depth / VOXEL_MM + 0.5, 0, 1) * np.clip((thick_mm - depth) / VOXEL_MM + 0.5, 0, 1)
    volume = Volume(share * inside, np.array([-20.0, -20.0, -10.0]), np.full(3, VOXEL_MM), **kwargs)
    return Bone((volume,), RigidTransform.identity())


def drill(
    wire, to_mm, from_mm=-5.0, feed_mm_s=1.0, guide_mm=-10.0, axes=UPRIGHT, through=(0.0, 0.0, 0.0), turning=True
):
    """The wire fed along its axis through a point; what it felt and where it was at every step."""
    at = np.arange(from_mm, to_mm, feed_mm_s * STEP_S)
    thrust, tip = [], []
    for s in at:
        thrust.append(wire.step(np.array(through) + s * axes[2], axes, s - guide_mm, turning, STEP_S))
        tip.append(wire.tip_mm)
    return SimpleNamespace(at_mm=at, thrust_n=np.array(thrust), tip_mm=np.array(tip))


@pytest.mark.parametrize(("feed", "expected"), [(1.0, 35.0), (0.5, 35.0 * 0.5**0.6)])
def test_thrust_in_cortex_follows_the_feed(feed, expected):
    """1 mm/s at 1000 rpm is 0.06 mm a turn: 35 N by the formula."""
    run = drill(Wire(block()), 15.0, feed_mm_s=feed)
    assert run.thrust_n[-1] == pytest.approx(expected, rel=0.01)
    assert run.tip_mm[-1, 2] == pytest.approx(run.at_mm[-1] - expected / AXIAL_N_PER_MM, abs=0.01)


def test_thrust_goes_with_the_square_of_density_and_with_the_diameter():
    soft = drill(Wire(block(share=0.3)), 15.0).thrust_n[-1]
    assert soft == pytest.approx(35.0 * 0.3**2, rel=0.01)
    assert drill(Wire(block(), diameter_mm=3.2), 15.0).thrust_n[-1] == pytest.approx(35.0 * 3.2 / 2.5, rel=0.01)


def test_a_drill_that_does_not_turn_pushes_like_a_spring_and_stays():
    run = drill(Wire(block()), 3.0, turning=False)
    assert run.tip_mm[-1, 2] < 1.0
    assert run.thrust_n[-1] == pytest.approx(AXIAL_N_PER_MM * (run.at_mm[-1] - run.tip_mm[-1, 2]), rel=1e-9)


def test_behind_the_far_cortex_the_spring_plunges():
    run = drill(Wire(block(thick_mm=10.0)), 14.0)
    assert run.thrust_n[-1] == 0.0
    assert run.tip_mm[-1, 2] == pytest.approx(run.at_mm[-1], abs=1e-9)
    through = run.tip_mm[(run.at_mm > 9.0) & (run.at_mm < 13.0), 2]
    speed = np.diff(through) / STEP_S
    assert speed.max() > 1.2  # faster than the feed, while the thrust falls


def test_a_square_entry_neither_skives_nor_bends():
    wire = Wire(block())
    run = drill(wire, 15.0)
    assert np.abs(run.tip_mm[:, :2]).max() < 0.01
    assert wire.entry_mm is not None


def test_an_oblique_cortex_leads_the_wire_down_its_slope_as_far_as_the_wire_bends():
    ends, bound = [], []
    for free in (20.0, 40.0):
        wire = Wire(block(slope_deg=45.0))
        run = drill(wire, 30.0, guide_mm=-free)
        assert wire.entry_mm is not None
        at_entry = wire.entry_mm[0]
        bound.append(35.0 * np.tan(np.deg2rad(45.0)) * (free + 5.0) ** 3 / (3 * wire.bending_n_mm2))
        assert -bound[-1] < at_entry < 0  # the bone falls away towards -X
        # Beyond the entry straight on, at the cantilever's end slope of 1.5 times its deflection over its length.
        beyond = run.tip_mm[-1] - wire.entry_mm
        assert beyond[0] / beyond[2] == pytest.approx(1.5 * at_entry / (free + wire.entry_mm[2]), rel=0.05)
        assert abs(run.tip_mm[-1, 1]) < 0.05
        ends.append(at_entry)
    assert ends[1] / ends[0] > 4.0  # nearly as the cube of the free length


def test_a_wire_drawn_back_and_fed_again_meets_its_own_hole():
    wire = Wire(block())
    drill(wire, 15.0)
    drill(wire, 5.0, from_mm=15.0, feed_mm_s=-2.0)
    again = drill(wire, 14.0, from_mm=5.0)
    assert again.thrust_n.max() == 0.0
    assert drill(wire, 18.0, from_mm=14.0).thrust_n[-1] == pytest.approx(35.0, rel=0.01)


def test_drawn_out_it_is_free_and_straight_again():
    wire = Wire(block(slope_deg=45.0))
    drill(wire, 15.0)
    drill(wire, -8.0, from_mm=15.0, feed_mm_s=-2.0)
    assert wire.entry_mm is None
    assert np.allclose(wire.tip_mm[:2], 0.0, atol=1e-6)


@pytest.mark.parametrize(("aside_mm", "felt_n"), [(0.0, 0.0), (0.2, 0.0), (0.6, 3.0), (1.0, 10.0), (3.0, 30.0)])
def test_a_hole_that_it_was_drawn_out_of_stays_open(aside_mm, felt_n):
    """Fed again it feels nothing down to the bottom, and beside the hole what is left of the bone."""
    wire = Wire(block())
    drill(wire, 15.0)
    drill(wire, -8.0, from_mm=15.0, feed_mm_s=-2.0)
    again = drill(wire, 14.0, from_mm=-8.0, through=(aside_mm, 0.0, 0.0))
    assert again.thrust_n.max() >= felt_n
    assert (again.thrust_n.max() > 0.0) == (felt_n > 0.0)
    if felt_n == 0.0:
        at_bottom = drill(wire, 20.0, from_mm=14.0, through=(aside_mm, 0.0, 0.0))
        assert at_bottom.thrust_n[-1] == pytest.approx(35.0, rel=0.01)
        assert at_bottom.at_mm[np.argmax(at_bottom.thrust_n > 1.0)] == pytest.approx(15.0, abs=0.5)


@pytest.fixture(scope="module")
def plastic():
    """The paper's femur with its bore of 8 mm: bone, entry and end point, tool axes."""
    femur = replace(Femur(), socket=False, cancellous_hu=0.14 / BONE_PER_HU)
    wire = to_cfcs(np.stack(femur.wire_mm()), "right", np.zeros(3))
    along = (wire[1] - wire[0]) / np.linalg.norm(wire[1] - wire[0])
    whole = replace(voxelise(femur, "right", np.zeros(3), None), material="composite", within=None)
    turn, _ = Rotation.align_vectors(along[None], [[0.0, 0.0, 1.0]])
    bone = Bone((bored(whole, np.stack([wire[0] - 5 * along, wire[1]]), 8.0),), RigidTransform.identity())
    return SimpleNamespace(bone=bone, entry=wire[0], length=np.linalg.norm(wire[1] - wire[0]), axes=turn.as_matrix().T)


def radial(plastic, xyz):
    from_entry = xyz - plastic.entry
    return np.linalg.norm(np.cross(from_entry, plastic.axes[2]), axis=-1)


def test_in_the_bore_a_wire_within_the_papers_limits_touches_nothing(plastic):
    wire, turn = Wire(plastic.bone), Rotation.from_rotvec(np.deg2rad(0.6) * plastic.axes[1])
    through = plastic.entry + plastic.axes[0]
    run = drill(
        wire,
        plastic.length - 3.0,
        feed_mm_s=4.0,
        guide_mm=-15.0,
        axes=turn.apply(plastic.axes),
        through=through,
        turning=False,
    )
    assert run.thrust_n.max() == 0.0


def test_the_wall_of_the_bore_bends_a_wire_that_is_tilted_too_far(plastic):
    turned = Rotation.from_rotvec(np.deg2rad(3.0) * plastic.axes[1]).apply(plastic.axes)
    run = drill(
        Wire(plastic.bone), plastic.length - 3.0, guide_mm=-15.0, axes=turned, through=plastic.entry, turning=False
    )
    straight = radial(plastic, plastic.entry + run.at_mm[-1] * turned[2])
    assert straight > 4.5
    assert radial(plastic, run.tip_mm[-1]) == pytest.approx(4.0 - 1.25, abs=0.375)  # bore less wire; half a voxel
    assert run.thrust_n.max() > 1.0


@pytest.mark.slow
def test_the_femurs_cortex_is_felt_and_its_spongy_bone_hardly():
    femur = Femur(cancellous_hu=132.0)
    wire_mm = to_cfcs(np.stack(femur.wire_mm()), "left", np.zeros(3))
    volume = voxelise(femur, "left", np.zeros(3), np.random.default_rng(5))
    moved = RigidTransform.from_components([300.0, -200.0, 50.0], Rotation.from_rotvec([0.1, 0.2, -0.4]))
    entry, end = moved.apply(wire_mm)
    along = (end - entry) / np.linalg.norm(end - entry)
    axes = Rotation.align_vectors(along[None], [[0.0, 0.0, 1.0]])[0].as_matrix().T
    bone = Bone((volume,), moved)
    assert bone.first_met_mm(entry - 20 * along, end) == pytest.approx(20.0, abs=0.6)
    run = drill(Wire(bone), 40.0, axes=axes, through=entry)
    assert 20.0 < run.thrust_n[run.at_mm < 8.0].max() < 36.0
    assert run.thrust_n[(run.at_mm > 20.0) & (run.at_mm < 40.0)].max() < 3.0


def test_several_volumes_add_up_and_flesh_is_no_bone():
    bone = block().volumes[0]
    both = Bone(
        (replace(bone, values=bone.values / 2), replace(bone, values=bone.values / 4)), RigidTransform.identity()
    )
    assert both.density(np.array([[0.0, 0.0, 5.0], [0.0, 0.0, -5.0], [0.0, 0.0, 500.0]])) == pytest.approx(
        [0.75 * 1.9, 0, 0]
    )
    with pytest.raises(SetUpError, match="drilled"):
        block(material="tissue")
    with pytest.raises(SetUpError, match="meets no bone"):
        both.first_met_mm(np.array([0.0, 0.0, -9.0]), np.array([0.0, 0.0, -5.0]))


def test_the_force_sensor_errs_by_a_tenth_and_by_a_constant():
    rng = np.random.default_rng(7)
    for thrust in (0.0, 30.0):
        read = np.array([sensed(thrust, rng) for _ in range(20_000)])
        assert read.mean() == pytest.approx(thrust, abs=5 * np.hypot(0.1 * thrust, 0.3) / np.sqrt(20_000))
        assert read.std() == pytest.approx(np.hypot(0.1 * thrust, 0.3), rel=0.03)
