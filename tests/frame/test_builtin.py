import numpy as np
import pytest

from sightline.common.checks import failed
from sightline.errors import FrameError
from sightline.frame import Frame
from sightline.frame.check import check_frame
from sightline.frame.designs import BUILTIN, builtin_design, patterns_for


def test_the_gamma_frame_is_the_one_of_the_conventions():
    frame = Frame.load("gamma")
    for view, axis in (("pa", 2), ("lateral", 0)):
        plates = frame.view(view)
        assert np.all(plates.xrii.xyz_mm[:, axis] == 300)
        assert np.all(plates.source.xyz_mm[:, axis] == 150)
        assert (len(plates.xrii.ids), len(plates.source.ids)) == (49, 64)
        np.testing.assert_allclose(plates.nominal_focal_point_mm, -620 * np.eye(3)[axis], atol=1e-9)
        for plate, pitch in ((plates.xrii, 22), (plates.source, 16)):
            xy = plate.plane.to_plane(plate.xyz_mm)
            assert np.abs(np.round(np.diff(np.unique(xy[:, 0].round(6)))) - pitch).max() == 0
            assert sorted({f.diameter_mm for f in plate.fiducials}) == [3, 5]
            assert all((f.diameter_mm == 5) == f.datum for f in plate.fiducials)
            assert plate.is_datum.sum() == 6


def test_the_hip_lies_between_the_plates_of_the_biplane_frame():
    frame = Frame.load("biplane")
    for view in frame.views.values():
        along = view.axis
        assert (view.source.xyz_mm @ along).max() < 0 < (view.xrii.xyz_mm @ along).min()
        assert view.in_field(np.concatenate([view.source.xyz_mm, view.xrii.xyz_mm])).all()


def test_the_stereo_beams_converge_at_the_hip_through_parallel_plates():
    views = Frame.load("stereo").views
    axes = {name: view.axis for name, view in views.items()}
    assert np.degrees(np.arccos(axes["left"] @ axes["right"])) == pytest.approx(32, abs=1e-6)
    for name, other in (("left", "right"), ("right", "left")):
        for plate in (views[name].xrii, views[name].source):
            np.testing.assert_allclose(plate.plane.normal, [0, 0, 1], atol=1e-9)
            assert not views[other].in_field(plate.xyz_mm).any()


@pytest.mark.parametrize("name", BUILTIN)
def test_wherever_the_source_stands_few_balls_of_a_view_hide_each_other(name):
    """The source 60 mm aside moves the source plate's image by a whole step against the XRII plate's."""
    for view in Frame.load(name).views.values():
        plates = (view.xrii, view.source)
        plane, focal = view.xrii.plane, view.nominal_focal_point_mm
        scale = [abs(plane.height_mm(focal)) / view.depth_mm(p.xyz_mm) for p in plates]
        radii = [s * np.array([f.diameter_mm for f in p.fiducials]) / 2 for s, p in zip(scale, plates, strict=True)]
        for x in np.linspace(-60, 60, 13):
            for y in np.linspace(-60, 60, 13):
                source = focal + np.array([x, y]) @ plane.axes
                images = [plane.central_projection(source, plate.xyz_mm) for plate in plates]
                gaps = np.linalg.norm(images[0][:, None] - images[1], axis=-1) - radii[0][:, None] - radii[1]
                touched = (gaps < 0).any(axis=1).sum() + (gaps < 0).any(axis=0).sum()
                assert touched <= 0.2 * len(view.fiducials)


@pytest.mark.slow
def test_other_parameters_give_other_frames_with_their_own_patterns():
    design = builtin_design("gamma")
    other = type(design)("nine", design.beams, patterns_for(design.beams, rows=9), rows=9, pitch_mm=17.0)
    frame = Frame.from_design(other)
    assert len(frame.view("pa").xrii.ids) == 81
    assert failed(check_frame(frame)) == ()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rows": 2}, "at least 3 rows"),
        ({"pitch_mm": 0.0}, "pitch above zero"),
        ({"source_mm": 300.0}, "further towards the intensifier"),
        ({"source_mm": -620.0}, "behind the X-ray source"),
    ],
)
def test_parameters_that_give_no_frame_are_refused(change, words):
    design = builtin_design("gamma")
    with pytest.raises(FrameError, match=words):
        Frame.from_design(type(design)(**{"name": "x", "beams": design.beams, "patterns": design.patterns} | change))


def test_no_pattern_where_none_stays_visible():
    with pytest.raises(FrameError, match="ask for 6"):
        patterns_for(builtin_design("gamma").beams, rows=7, datums=3)
    with pytest.raises(FrameError, match="4 to 20 rows"):
        patterns_for(builtin_design("gamma").beams, rows=21)


def test_unknown_views_are_named():
    with pytest.raises(FrameError, match="pa, lateral"):
        Frame.load("gamma").view("ap")
    with pytest.raises(FrameError, match="pa, lateral"):
        Frame.load("gamma").rows("ap")
