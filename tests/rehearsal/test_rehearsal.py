"""A rehearsal is drawn from its seed: part by part the same, in any order, and its truth agrees with its images."""

import time

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

import sightline as sl
from sightline.common.checks import Limits, failed
from sightline.errors import UnusableInputError
from sightline.frame import Frame
from sightline.from_images.pipeline import check_shot, label_beads
from sightline.planning import plan
from sightline.planning.check.shot import Landmarks
from sightline.rehearsal.operation import registered
from sightline.rehearsal.patient import PARTS, VIEWS
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.robot.kinematics.target import PlanIdentity, robot_target
from sightline.robot.link.record import SimulatedWire
from sightline.twin import render

SEED = 9  # in its lateral image the femur's outline crosses the wire and pulls a piece of it aside by half a pixel


@pytest.fixture(scope="module")
def rehearsal() -> Rehearsal:
    return Rehearsal.draw(SEED, Frame.load("gamma"))


@pytest.mark.slow
def test_each_part_is_the_same_when_drawn_again_alone(rehearsal):
    again = Rehearsal.draw(SEED, Frame.load("gamma"))
    alone = render(again.setup, "lateral", again.hip.scene, again.generator("lateral"))
    np.testing.assert_array_equal(alone.pixels, rehearsal.images["lateral"].pixels)
    np.testing.assert_array_equal(again.hip.wire_mm, rehearsal.hip.wire_mm)
    assert list(again.landmarks) == list(rehearsal.landmarks)
    firsts = [again.generator(part).random() for part in PARTS]
    assert firsts == [rehearsal.generator(part).random() for part in PARTS]
    assert len(set(firsts)) == len(PARTS)
    assert Rehearsal.draw(SEED + 1, Frame.load("gamma")).generator("robot").random() not in firsts


def test_landmarks_and_wire_lie_in_both_images(rehearsal):
    assert rehearsal.landmarks.keys() <= rehearsal.hip.landmarks_mm.keys()
    for name, uv in rehearsal.landmarks.items():
        np.testing.assert_allclose(uv, rehearsal.pixels(rehearsal.hip.landmarks_mm[name][None])[:, 0], atol=1e-9)
    for view, uv in zip(("pa", "lateral"), rehearsal.pixels(rehearsal.hip.wire_mm), strict=True):
        assert rehearsal.setup.views[view].in_field(uv, 0.0).all()
    entry, end = rehearsal.hip.wire_mm
    assert np.linalg.norm(rehearsal.surface_mm("guide-wire") - entry) == pytest.approx(
        np.linalg.norm(end - entry) + 8.0
    )


@pytest.mark.slow
def test_check_images_show_the_wire_that_was_drilled(rehearsal):
    """The shadow is where the truth has the wire; the frame came back to within the arm's play."""
    entry, end = rehearsal.hip.wire_mm
    off = np.array([0.6, -0.4, 0.3])
    T_mcs_cfcs = RigidTransform.from_translation([400.0, 12.0, 300.0])
    held = np.stack([entry - 20 * (end - entry) / np.linalg.norm(end - entry), entry, end]) + off
    shot = rehearsal.check_images(SimulatedWire(T_mcs_cfcs.apply(held), T_mcs_cfcs, np.zeros(5)))
    moved = shot.landmarks_mm["head centre"] - rehearsal.hip.head_mm
    assert 0.0 < np.linalg.norm(moved) < 0.5
    along = held[1] + np.linspace(0.1, 0.9, 80)[:, None] * (held[2] - held[1]) + moved
    for view in ("pa", "lateral"):
        uv = shot.setup.views[view].project(along)
        across = np.array([uv[0, 1] - uv[-1, 1], uv[-1, 0] - uv[0, 0]]) / np.linalg.norm(uv[-1] - uv[0])
        beside = [np.rint(uv + px * across).astype(int) for px in (0.0, 14.0, -14.0)]
        on, *others = (shot.images[view].pixels[at[:, 1], at[:, 0]].mean() for at in beside)
        assert on < 0.95 * min(others)


def test_a_simulated_wire_survives_the_link():
    wire = SimulatedWire(np.arange(9.0).reshape(3, 3), RigidTransform.identity(), np.arange(5.0))
    again = SimulatedWire.of(wire.text())
    np.testing.assert_array_equal(again.wire_mm, wire.wire_mm)
    np.testing.assert_array_equal(again.imaged, wire.imaged)
    np.testing.assert_array_equal(again.T_mcs_cfcs.as_matrix(), wire.T_mcs_cfcs.as_matrix())


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"wire_mm": [[1]], "T_mcs_cfcs": [[1]]}', '{"wire_mm": "x"}'])
def test_texts_that_are_no_wire(text):
    with pytest.raises(UnusableInputError):
        SimulatedWire.of(text)


@pytest.fixture(scope="module")
def beside_a_block() -> Rehearsal:
    """Of a left hip, which lies on the other side of the block than a right one."""
    return Rehearsal.draw(4, Frame.load("block60"), "left")


def test_the_robot_holds_a_block_where_the_images_show_it(beside_a_block):
    """The bone is ahead of the true wire, and the shown wire is the plant's; with another sign it is 160 mm off."""
    pytest.importorskip("mujoco")
    theatre, (entry, end) = beside_a_block.theatre(), beside_a_block.hip.wire_mm
    assert theatre.plant.wire is not None
    along = theatre.T_mcs_cfcs.apply(entry + np.linspace(0.1, 0.9, 9)[:, None] * (end - entry))
    assert (theatre.plant.wire.bone.density(along) > 0.0).all()
    shown = beside_a_block.robot_wire_mm
    assert shown is not None
    np.testing.assert_allclose(theatre.wire.axis_mm[1], shown[1], atol=0.02)  # the feed's play
    nominal_mm = beside_a_block.setup.hip_mm + 75.0 * np.array([1.0, -1.0, 0.0]) / np.sqrt(2)  # lateral, caudal
    assert np.linalg.norm(shown[1] - nominal_mm) < 1.0  # the mounts' errors
    assert theatre.setup.hip_mm == pytest.approx(beside_a_block.setup.hip_mm)
    assert not theatre.setup.frame_mounted
    assert theatre.setup.frame == Frame.load("block60").fingerprint


def test_images_of_a_block_show_the_tip_of_the_robots_wire(beside_a_block, rehearsal):
    shown = beside_a_block.robot_wire_mm
    assert shown is not None and rehearsal.robot_wire_mm is None
    assert 25.0 <= np.linalg.norm(shown[1] - shown[0]) <= 60.0 + 1e-9
    for view, uv in zip(VIEWS, beside_a_block.pixels(shown), strict=True):
        assert beside_a_block.setup.views[view].in_field(uv, 29.9).all()


@pytest.mark.slow
@pytest.mark.parametrize("short_mm", [0.0, 0.4])
def test_a_wire_where_it_was_planned_passes_at_any_depth(rehearsal: Rehearsal, short_mm: float) -> None:
    """Where the pieces of its centre line begin and end follows from the tip."""
    frame, wire = rehearsal.setup.frame, rehearsal.hip.wire_mm
    views = []
    for name in VIEWS:
        image = rehearsal.images[name]
        views.append(sl.calibrate(label_beads(image, sl.detect(image), frame, name), frame))
    uv, names = rehearsal.pixels(wire), list(rehearsal.landmarks)
    marks = np.stack([rehearsal.landmarks[name] for name in names], axis=1)
    made = plan(views, uv[:, 0], uv[:, 1], landmarks_uv_px=marks)
    along = (wire[1] - wire[0]) / np.linalg.norm(wire[1] - wire[0])
    drilled = np.stack([wire[0], wire.mean(axis=0), wire[1] - short_mm * along])
    taken = rehearsal.check_images(SimulatedWire(drilled, RigidTransform.identity(), np.zeros(5)))
    landmarks = Landmarks(marks, taken.landmarks_px(names, 0.0, np.random.default_rng(0)), 0.5)
    found = check_shot(made, views, [taken.images[name] for name in VIEWS], frame, landmarks=landmarks)
    assert not failed(found.checks), [check.sentence for check in failed(found.checks)]
    assert found.deviation_mm[4] == pytest.approx(-short_mm, abs=3 * np.sqrt(found.covariance_mm2[4, 4]))


def test_images_that_are_taken_again_show_another_place_of_the_c_arm(
    rehearsal: Rehearsal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fails where a refused check shot would be refused for ever, because each one is the first again."""
    noise = lambda setup, names, scene, rng: {name: rng.standard_normal(9) for name in names}  # noqa: E731
    monkeypatch.setattr("sightline.rehearsal.patient.render_views", noise)
    monkeypatch.setattr("sightline.rehearsal.patient.tagged", lambda setup, name, image: image)
    entry, tip = rehearsal.hip.wire_mm
    wire = SimulatedWire(np.stack([entry, (entry + tip) / 2, tip]), RigidTransform.identity(), np.zeros(5))
    first, second, third, again = (rehearsal.check_images(wire, retake=n) for n in (0, 1, 2, 1))
    tips = [taken.pixels(wire.axis_mm, 0.0, np.random.default_rng(0))[:, -1] for taken in (first, second, third)]
    for one, other in ((0, 1), (1, 2), (0, 2)):
        assert np.linalg.norm(tips[one] - tips[other], axis=1).min() > 5.0
    for name in VIEWS:
        np.testing.assert_array_equal(again.images[name], second.images[name])


@pytest.mark.slow
def test_an_arm_that_holds_a_guide_stands_at_the_block_without_a_wire_in_the_images(few_pixels):
    pytest.importorskip("mujoco")
    rehearsed = Rehearsal.draw(SEED, Frame.load("block60"), arm="six-axis")
    assert rehearsed.robot_wire_mm is None
    theatre = rehearsed.theatre()
    ideal_mm = rehearsed.ideal_mm["guide-wire"]
    target = robot_target(
        PlanIdentity("1", "right", rehearsed.serial, go=True, frame=theatre.setup.frame),
        ideal_mm,
        {"planning": 0.01 * np.eye(6)},
        registered(theatre.robot, theatre.imaged, time.monotonic()),
        Limits(),
    )
    theatre.drill(target, target.depth_mm + 3.0)
    outcome = theatre.outcome(ideal_mm)
    assert outcome.entry_mm < 1.0
    assert np.rad2deg(outcome.angle_rad) < 0.6
    assert theatre.plant.wire.entry_mm is not None  # it is in the bone
    taken = rehearsed.check_images(theatre.wire)
    assert taken.setup.views.keys() == set(VIEWS)
