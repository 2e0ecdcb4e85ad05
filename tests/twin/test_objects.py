"""Implants, the theatre's things, the Perspex object and frames as they are used: dimensions, places, refusals."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.errors import SetUpError, UnusableInputError
from sightline.frame import Tolerances
from sightline.frame.tolerances import DRAPE_N, EXPANSION_PER_K, MOISTURE_EXPANSION
from sightline.twin import Scene
from sightline.twin.objects.things import (
    RAIL_MM,
    SHEET_MM,
    WIRE_DIAMETER_MM,
    Ball,
    Rod,
    SoftTissue,
    angled_plate,
    drape,
    drill_guide,
    guide_wire,
    lag_screw,
    pack,
    rod_between,
    table_rail,
)
from sightline.twin.scenes.specimens import perspex_object
from sightline.twin.xray.projector import chord
from sightline.twin.xray.setup import Handling, in_use

WIRE = np.array([[41.3, 32.2, -8.1], [-22.4, -35.7, 6.6]])  # entry, end
ALONG = (WIRE[1] - WIRE[0]) / np.linalg.norm(WIRE[1] - WIRE[0])
ACROSS = np.linalg.svd(ALONG[None])[2][1]


def steel_mm(scene: Scene, through_mm: np.ndarray, along: np.ndarray = ACROSS) -> float:
    """Length in the solids of a scene on the line through a point."""
    shapes, _ = pack(scene.solids)
    start = through_mm - 500 * along
    return sum(chord(start, along, shapes, m) for m in range(len(shapes)))


def test_a_wire_has_its_length_diameter_and_tip():
    wire = guide_wire(WIRE)
    ends = [np.array(r.centre_mm) + s * r.half_mm * np.array(r.axis) for r in wire.solids for s in (-1, 1)]
    behind = [float((WIRE[1] - end) @ ALONG) for end in ends]
    assert min(behind) == pytest.approx(0.0, abs=1e-9)
    assert max(behind) == pytest.approx(200.0)
    assert steel_mm(wire, WIRE[0]) == pytest.approx(WIRE_DIAMETER_MM)
    assert steel_mm(wire, WIRE[1] + 0.01 * ALONG) == 0.0


@pytest.mark.parametrize("diameter_mm", [WIRE_DIAMETER_MM, 4.0])
def test_a_wires_point_is_a_cone_to_a_fifth_of_a_pixel(diameter_mm):
    """Five discs were half a millimetre wide in a drill: the tip of its shadow lay 0.1 mm from that of a cone."""
    wire = guide_wire(WIRE, diameter_mm)
    for behind_mm in np.linspace(0.071, 1.5 * diameter_mm - 0.037, 41):
        cone_mm = behind_mm / 1.5
        assert steel_mm(wire, WIRE[1] - behind_mm * ALONG) == pytest.approx(cone_mm, abs=0.11)


def test_a_lag_screw_is_hollow_threaded_and_as_long_as_its_way():
    screw = lag_screw(WIRE)
    assert steel_mm(screw, WIRE[0] + 5 * ALONG) == pytest.approx(8.0 - 3.2)
    assert steel_mm(screw, WIRE[1] - 0.3 * ALONG) == pytest.approx(12.5 - 3.2)
    assert steel_mm(screw, WIRE[1] - 1.4 * ALONG) == pytest.approx(8.0 - 3.2)
    assert steel_mm(screw, WIRE[0] - 0.1 * ALONG) == 0.0


def test_an_angled_plate_lies_on_the_cortex_and_its_barrel_about_the_wire():
    plate = angled_plate(WIRE, np.array([0.0, 1.0, 0.0]))
    (blade,) = plate.boxes
    gap = (WIRE[0] - blade.centre_mm) @ blade.axes.T
    assert gap[0] == pytest.approx(-blade.half_mm[0])  # the entry lies on its inner face
    assert gap[1] == pytest.approx(0.0, abs=1e-9)
    assert abs(gap[2]) < blade.half_mm[2]
    assert np.allclose(blade.axes @ blade.axes.T, np.eye(3))
    assert steel_mm(plate, WIRE[0] + 10 * ALONG) == pytest.approx(13.0 - 8.0)
    assert steel_mm(plate + lag_screw(WIRE), WIRE[0] + 10 * ALONG) == pytest.approx(13.0 - 3.2)  # one in the other
    screws = [one for one in plate.solids if isinstance(one, Rod) and one.hole_mm == 0]
    assert len(screws) == 4
    for screw in screws:
        assert np.allclose(np.array(screw.axis), -blade.axes[0])
        head = (np.array(screw.centre_mm) - screw.half_mm * np.array(screw.axis) - blade.centre_mm) @ blade.axes.T
        assert abs(head[2]) < blade.half_mm[2]


def test_a_guide_stands_on_the_skin():
    body = SoftTissue()
    guide = drill_guide(WIRE, body)
    tube, _ = guide.solids
    assert isinstance(tube, Rod)
    skin = np.array(tube.centre_mm) - tube.half_mm * np.array(tube.axis)
    radius = np.hypot(*((skin[[0, 2]] - body.centre_mm) / body.half_mm))
    assert radius == pytest.approx(1.0)
    assert np.linalg.norm(np.cross(skin - WIRE[0], ALONG)) < 1e-9
    assert (WIRE[0] - skin) @ ALONG > 0
    assert steel_mm(guide, skin - 50 * ALONG) == pytest.approx(10.0 - 2.7)
    with pytest.raises(SetUpError, match="within"):
        drill_guide(WIRE + np.array([300.0, 0.0, 0.0]), body)


def test_a_drape_is_a_sheet_with_thicker_folds_upon_it():
    folded = drape(np.random.default_rng(3), np.array([1.0, 2.0, 120.0]), np.array([0.1, 0.0, 1.0]), folds=5)
    sheet, *folds = folded.boxes
    assert len(folds) == 5
    normal = np.array([0.1, 0.0, 1.0]) / np.linalg.norm([0.1, 0.0, 1.0])
    for fold in folds:
        assert np.allclose(fold.axes @ fold.axes.T, np.eye(3))
        sheets = 2 * fold.half_mm[2] / SHEET_MM
        assert sheets == pytest.approx(round(sheets))
        assert 2 <= round(sheets) <= 8
        above = (fold.centre_mm - sheet.centre_mm) @ normal
        assert above == pytest.approx(fold.half_mm[2] + sheet.half_mm[2])
    assert {box.material for box in folded.boxes} == {"polyethylene"}


def test_a_rail_is_of_steel_and_lies_where_it_is_put():
    (rail,) = table_rail(np.array([150.0, 0.0, -30.0])).boxes
    assert tuple(2 * rail.half_mm[[0, 2]]) == RAIL_MM
    assert rail.material == "steel"
    np.testing.assert_array_equal(rail.centre_mm, [150.0, 0.0, -30.0])


def test_perspex_holds_its_four_balls():
    scene, balls = perspex_object(np.array([7.0, -80.0, 3.0]))
    (block,) = scene.boxes
    assert block.material == "pmma"
    assert (np.abs(balls - block.centre_mm) + 1.5 < block.half_mm).all()
    assert block.centre_mm[1] == pytest.approx(-80.0, abs=5.0)
    assert all(isinstance(one, Ball) and one.within == "pmma" for one in scene.solids)


def test_a_rod_needs_two_points_and_a_thing_a_known_material():
    with pytest.raises(SetUpError, match="two different"):
        rod_between(np.zeros(3), np.zeros(3), 1.0)
    with pytest.raises(SetUpError, match="two different"):
        guide_wire(np.zeros((2, 3)))
    with pytest.raises(SetUpError, match="angle"):
        angled_plate(np.array([[0.0, 50.0, 0.0], [0.0, -50.0, 0.0]]), np.array([0.0, 1.0, 0.0]))
    with pytest.raises(UnusableInputError, match="steel, bone"):
        pack([Ball((0.0, 0.0, 0.0), 1.0, material="cheese")])


def plates(frame):
    return [plate for view in frame.views.values() for plate in (view.xrii, view.source)]


def test_heat_and_water_stretch_each_plate_about_its_middle(frame):
    used = in_use(frame, Handling(warmer_k=8.0, water_share=0.005))
    stretch = 1 + 8.0 * EXPANSION_PER_K + 0.005 * MOISTURE_EXPANSION
    for before, after in zip(plates(frame), plates(used), strict=True):
        assert np.allclose(after.xyz_mm.mean(axis=0), before.xyz_mm.mean(axis=0))
        assert np.allclose(np.ptp(after.xyz_mm, axis=0), stretch * np.ptp(before.xyz_mm, axis=0))
    assert stretch - 1 == pytest.approx(1.56e-3)


def test_a_drape_sags_a_plate_by_its_tolerance(frame):
    loose = replace(frame, tolerances=Tolerances(plate_mm=0.2, plate_rad=1e-3))
    used = in_use(loose, Handling(drape_n=2 * DRAPE_N))
    for before, after in zip(plates(loose), plates(used), strict=True):
        move = after.xyz_mm - before.xyz_mm
        assert np.allclose(move.mean(axis=0), [0.0, 0.0, -0.4])
        expected = np.array([0.0, 0.0, -0.4]) + np.cross([0.0, 2e-3, 0.0], before.xyz_mm - before.xyz_mm.mean(axis=0))
        assert np.allclose(move, expected)


def test_a_frame_without_handling_errors_is_unchanged(frame):
    for before, after in zip(plates(frame), plates(in_use(frame, Handling())), strict=True):
        assert np.allclose(after.xyz_mm, before.xyz_mm)


@pytest.mark.parametrize("wrong", [{"drape_n": -1.0}, {"warmer_k": 300.0}, {"water_share": 0.5}, {"warmer_k": np.nan}])
def test_an_impossible_handling_is_refused(wrong):
    with pytest.raises(SetUpError, match="cannot be used"):
        Handling(**wrong)
