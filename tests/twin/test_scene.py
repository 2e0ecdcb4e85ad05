"""Hips, hard images and the truth written beside them."""

import json

import numpy as np
import pytest

from sightline.errors import SetUpError, UnusableInputError
from sightline.twin import shown_hip_scene, write_truth
from sightline.twin.anatomy.femur import (
    BOX_LOW_MM,
    LONG_HIGH_MM,
    VOXEL_MM,
    Femur,
    _femur_distance,
    _medial_limit,
    _socket,
    _without_socket,
    draw_femur,
    voxelise,
)
from sightline.twin.scenes.hard import hard_scene, hard_views
from sightline.twin.xray.presets import preset


@pytest.fixture(scope="module")
def femur_and_volume():
    femur = Femur()
    return femur, voxelise(femur, "right", np.zeros(3), np.random.default_rng(1))


def share_at(volume, xyz_mm):
    i, j, k = np.rint((np.asarray(xyz_mm) - volume.origin_mm) / volume.voxel_mm).astype(int).T
    return volume.values[i, j, k]


def test_the_wire_runs_from_the_lateral_cortex_into_the_head():
    rng = np.random.default_rng(2)
    for _ in range(20):
        femur = draw_femur(rng)
        entry, end = femur.wire_mm()
        along = (end - entry) / np.linalg.norm(end - entry)
        assert np.degrees(np.arccos(along[1])) == pytest.approx(135.0)
        assert np.linalg.norm(end) == pytest.approx(femur.head_radius_mm - 8.0)
        assert np.linalg.norm(np.cross(entry, along)) < 1e-9  # through the centre of the head
        assert 70 < np.linalg.norm(end - entry) < 120
        assert entry[0] > femur.base_mm[0]


def test_three_cannulated_wires_are_an_inverted_triangle_in_the_neck():
    rng = np.random.default_rng(3)
    for _ in range(20):
        femur = draw_femur(rng)
        wires = femur.cannulated_wires_mm()
        along = wires[:, 1] - wires[:, 0]
        along /= np.linalg.norm(along, axis=1)[:, None]
        assert np.abs(along - femur.towards_head).max() < 1e-9  # parallel
        assert np.linalg.norm(wires[:, 1], axis=1) == pytest.approx(femur.head_radius_mm - 5.0)
        inferior, posterior, anterior = wires[:, 1] - (wires[:, 1] @ along[0])[:, None] * along[0]
        sides = [np.linalg.norm(a - b) for a, b in ((inferior, posterior), (posterior, anterior), (anterior, inferior))]
        assert max(sides) - min(sides) < 1e-9
        assert inferior[1] > max(posterior[1], anterior[1])  # caudal
        assert posterior[2] < min(inferior[2], anterior[2])
        # The neck's axis passes the head's centre, so a screw's surface is this far from that of the narrowest neck:
        gap = 0.96 * femur.neck_radius_mm - np.linalg.norm(inferior) - 7.3 / 2
        assert gap == pytest.approx(3.0)
        for entry, end in wires:
            at = entry + np.linspace(0.02, 1.0, 80)[:, None] * (end - entry)
            depth = np.array([_femur_distance(point, femur.numbers())[0] for point in at])
            assert abs(_femur_distance(entry, femur.numbers())[0]) < 1e-6
            assert (depth < 0).all()
            assert depth[at @ along[0] > -35.0].max() < -4.9  # neck and head: a screw and more


def test_the_volume_is_bone_where_the_femur_is(femur_and_volume):
    femur, volume = femur_and_volume
    entry, end = femur.wire_mm()
    along = (end - entry) / np.linalg.norm(end - entry)
    assert share_at(volume, [entry - 3 * along])[0] == 0.0  # outside
    assert share_at(volume, [entry + 2 * along])[0] > 0.7  # cortex
    inside = share_at(volume, entry + np.arange(15, 80, 2)[:, None] * along)
    assert (inside < 0.5).all()  # cancellous bone
    assert inside.mean() > 0.01
    x, y, z = femur.base_mm
    middle_of_cortex = (femur.shaft_radius_mm + femur.canal_radius_mm) / 2
    canal, cortex = share_at(volume, [[x, y + 65.0, z], [x + middle_of_cortex, y + 65.0, z]])
    assert canal == 0.0
    assert cortex > 0.7
    assert volume.values[0].max() == volume.values[-1].max() == volume.values[:, 0].max() == 0.0


def test_a_wire_that_meets_no_cortex_is_refused():
    with pytest.raises(SetUpError, match="lateral cortex"):
        Femur().wire_mm(angle_deg=45.0)


def test_a_shown_hip_has_its_wire_in_both_fields_and_its_truth_in_a_file(frame, tmp_path):
    setup, hip = shown_hip_scene(np.random.default_rng(5), frame, side="left")
    for view in setup.views.values():
        assert view.in_field(view.project(hip.wire_mm), 60.0).all()
    written = json.loads(write_truth(tmp_path / "truth.json", setup, hip).read_text())
    assert written["side"] == "left"
    assert np.allclose(written["entry_mm"], hip.wire_mm[0])
    for name, view in setup.views.items():
        one = written["views"][name]
        some = next(iter(one["beads_uv_px"]))
        assert np.allclose(one["beads_uv_px"][some], view.project(np.array(written["beads_mm"][some])))
    with pytest.raises(UnusableInputError):
        write_truth(tmp_path / "no" / "truth.json", setup, hip)


@pytest.mark.slow
def test_hard_views_show_one_scene_from_all_sides_and_tell_where_its_beads_are(frame):
    views = hard_views(np.random.default_rng(9), frame, chain="9in-pal")
    pa, lateral = views["pa"], views["lateral"]
    assert pa.scene is lateral.scene  # a scene drawn for each view has other metal in each
    assert pa.setup is lateral.setup
    assert pa.level != lateral.level
    image, truth = lateral.exposed(np.random.default_rng(9), "high")
    assert image.shape == preset("9in-pal").shape
    assert len(set(truth.ids) & set(frame.view("lateral").by_id)) > 60
    exact = {b.id: pa.setup.views["lateral"].project(np.array([b.xyz_mm]))[0] for b in pa.setup.true_frame.fiducials}
    assert np.allclose(truth.uv_px, [exact[i] for i in truth.ids], atol=1e-6)
    alone = (truth.gap_px > 4) & (truth.rim_px > 4) & (truth.saturated == 0)
    assert alone.sum() > 5
    assert (truth.contrast[alone] < -0.05).mean() > 0.9
    assert (truth.quanta > 0).all()
    assert ((truth.blur_px > 0.5) & (truth.blur_px < 1.3)).all()
    darker = []
    for (u, v), radius in zip(truth.uv_px[alone], truth.radius_px[alone], strict=True):
        angle, at = np.linspace(0, 6.2, 12), np.rint([v, u]).astype(int)
        around = np.rint([v + 1.6 * radius * np.sin(angle), u + 1.6 * radius * np.cos(angle)]).astype(int)
        darker.append(image.pixels[tuple(at)] < image.pixels[around[0], around[1]].mean())
    assert np.mean(darker) > 0.9


def test_bad_dose_class(frame):
    with pytest.raises(SetUpError, match="low, medium, high"):
        hard_scene(np.random.default_rng(8), "none", frame)


@pytest.mark.parametrize("seed", range(2))
def test_what_is_left_out_of_a_hip_is_empty(seed):
    """Points 5 mm apart where no femur or no socket is computed. Fails for a limit 16 mm nearer to the femur, or 30 mm
    nearer to the socket."""
    femur = draw_femur(np.random.default_rng(seed))
    n = femur.numbers()
    axes = [np.arange(low, high, 5.0) for low, high in zip(BOX_LOW_MM, LONG_HIGH_MM, strict=True)]
    points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    medial = points[points[:, 0] < _medial_limit(n)]
    assert len(medial) > 0.3 * len(points)
    assert min(_femur_distance(p, n)[0] for p in medial) > VOXEL_MM / 2
    heads = np.linalg.norm(points, axis=1) - femur.head_radius_mm
    away = [(p, head) for p, head in zip(points, heads.tolist(), strict=True) if _without_socket(p, head)]
    assert len(away) > 0.3 * len(points)
    assert max(_socket(p, head, 3.0, n[7]) for p, head in away) == 0.0
