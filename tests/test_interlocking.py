"""From strokes and clicks in rendered images to the hole of a nail."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.scenes.nails import scored
from tests.nail_images import NailImages, nail_images

from sightline.errors import ReconstructionRefusedError, SightlineError, UnusableInputError, WireRefusedError
from sightline.from_images.interlocking import find_hole, find_holes, find_nail
from sightline.imaging import Radiograph
from sightline.planning import Nail
from sightline.twin.anatomy.nailed_femur import DistalNail
from sightline.twin.objects.things import Scene, rod_between
from sightline.twin.xray.distributions import beam_at

NAIL = DistalNail(np.array([2.3, -3.1, 4.7]), np.array([0.0, 1.0, 0.0]), beam_at(0.02), bend=0.02, bend_angle=2.0)
MAX_MM, MAX_DEG = 0.3, 0.7


@pytest.fixture(scope="module")
def titanium() -> NailImages:
    return nail_images(NAIL, 1)


@pytest.fixture(scope="module")
def steel() -> NailImages:
    return nail_images(replace(NAIL, material="steel", diameter_mm=10.0), 2)


def _known(nail: DistalNail) -> Nail:
    return Nail(nail.diameter_mm, nail.hole_diameter_mm, nail.bore_mm, nail.material)


@pytest.fixture(scope="module")
def found(titanium: NailImages):
    """The nail in its images."""
    return find_nail(titanium.views, titanium.images, titanium.strokes_px, _known(NAIL))


def _found(images: NailImages, rng: np.random.Generator, off_px: float = 2.0):
    strokes = images.strokes_px + off_px * rng.standard_normal(images.strokes_px.shape)
    nail = find_nail(images.views, images.images, strokes, _known(images.nail))
    return find_hole(nail, images.clicks_px + off_px * rng.standard_normal((2, 2)))


@pytest.mark.slow
@pytest.mark.parametrize("which", ["titanium", "steel"])
def test_hole_is_found_from_clicks_two_pixels_off(which, request):
    images = request.getfixturevalue(which)
    hole = _found(images, np.random.default_rng(0))
    score = scored(hole, images.nail)
    assert hole.passed
    assert score.off_mm < MAX_MM
    assert score.off_deg < MAX_DEG
    assert score.square < 18.5  # 99.9 % of a chi-square of 4


@pytest.mark.slow
def test_a_rim_hidden_in_part_is_found_or_refused():
    """A steel wire across the edge of the lens, in both images."""
    aside = np.cross(NAIL.along, NAIL.axis)
    at = NAIL.hole_mm + 1.9 * aside - 9.0 * NAIL.axis
    wire = rod_between(at - 30.0 * NAIL.along, at + 30.0 * NAIL.along, 0.8)
    images = nail_images(NAIL, 3, Scene(solids=(wire,)))
    try:
        hole = _found(images, np.random.default_rng(0), 1.0)
    except SightlineError:
        return
    score = scored(hole, NAIL)
    assert not hole.passed or (score.off_mm < MAX_MM and score.off_deg < 2 * MAX_DEG and score.square < 18.5)


def test_clicks_beside_the_holes_are_refused(titanium, found):
    between = titanium.clicks_px + np.array([0.0, 12.0 / 0.12])
    with pytest.raises(ReconstructionRefusedError):
        find_hole(found, between)


def test_clicks_on_two_holes_are_refused(titanium, found):
    other = titanium.views[1].project(NAIL.holes[1, :1])[0]
    with pytest.raises(ReconstructionRefusedError, match="two different holes"):
        find_hole(found, [titanium.clicks_px[0], other])


def test_one_hole_clicked_twice_is_refused(titanium, found):
    with pytest.raises(ReconstructionRefusedError, match="the same one"):
        find_holes(found, titanium.clicks_px, titanium.clicks_px + 1.0, "right")


def test_sizes_of_another_nail_are_refused(titanium):
    nail = find_nail(titanium.views, titanium.images, titanium.strokes_px, Nail(12.0, 5.0, 5.0))
    with pytest.raises(ReconstructionRefusedError, match="another nail"):
        find_hole(nail, titanium.clicks_px)


def test_a_stroke_without_an_edge_is_refused(titanium):
    strokes = titanium.strokes_px.copy()
    strokes[0, 0] += [40.0 * np.sign(strokes[0, 0, 0, 0] - strokes[0, 1, 0, 0]), 0.0]
    with pytest.raises((WireRefusedError, ReconstructionRefusedError)):
        find_hole(find_nail(titanium.views, titanium.images, strokes, _known(NAIL)), titanium.clicks_px)


def test_a_narrow_lens_is_refused():
    """One view looks through the hole so obliquely that it shows four points of each rim, the other shows twelve."""
    images = nail_images(replace(NAIL, axis=beam_at(0.14)), 3)
    with pytest.raises(ReconstructionRefusedError, match=r"only \d points? of a rim \(at least 5 .* lens is narrow"):
        _found(images, np.random.default_rng(0), 1.0)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1])
def test_an_image_without_a_nail_is_refused(titanium, noise):
    """A fit finds an offset that is best in any image: one that asks nothing of the light takes it for an edge."""
    rng = np.random.default_rng(4)
    level = float(np.median(titanium.images[0].pixels))
    flat = [
        Radiograph(
            np.clip(level * (1 + noise * rng.standard_normal(one.pixels.shape)), 0, one.white).astype(one.pixels.dtype),
            one.white,
        )
        for one in titanium.images
    ]
    with pytest.raises(WireRefusedError, match=r"no edge of a nail .* light falls by \d+%"):
        find_nail(titanium.views, flat, titanium.strokes_px, _known(NAIL))
    one_without = [titanium.images[0], flat[1]]
    with pytest.raises(WireRefusedError, match="no edge of a nail"):
        find_nail(titanium.views, one_without, titanium.strokes_px, _known(NAIL))


def test_bad_clicks_and_strokes_are_refused(titanium, found):
    with pytest.raises(UnusableInputError, match="strokes"):
        find_nail(titanium.views, titanium.images, titanium.strokes_px[:, 0], _known(NAIL))
    short = titanium.strokes_px.copy()
    short[0, 0, 1] = short[0, 0, 0] + 10.0
    with pytest.raises(UnusableInputError, match="longer"):
        find_nail(titanium.views, titanium.images, short, _known(NAIL))
    with pytest.raises(UnusableInputError, match="click"):
        find_hole(found, [[np.nan, 1.0], [2.0, 3.0]])
