"""Linear fits of tracked beads are as accurate as fits, say so, and hold only where they are."""

from dataclasses import replace

import numpy as np
import pytest
from tests.detection.track_images import FRAME, SIZE, beads, image, place

from sightline.detection import columns, detect, label, look_again
from sightline.detection.linear import LinearFits, reach_px
from sightline.detection.log_image import log_image
from sightline.detection.track import Track
from sightline.imaging import Radiograph

IMAGES = 24
SHOWN = beads()


@pytest.fixture(scope="module")
def track() -> Track:
    """A track with linear fits: its first tracked image."""
    first = image(SHOWN, 1)
    found = detect(first)
    seen = look_again(first, found, label(found, FRAME), FRAME)
    return Track.begin(first, found, seen, FRAME).follow(image(SHOWN, 2))[0]


@pytest.fixture(scope="module")
def linear(track: Track) -> LinearFits:
    return track.linear[0]


def truth_px(track: Track, linear: LinearFits) -> np.ndarray:
    return np.array([(SHOWN[track.ids[k]].u, SHOWN[track.ids[k]].v) for k in linear.which])


def full(track: Track, linear: LinearFits, one: Radiograph) -> np.ndarray:
    return track.fit.on(log_image(one, track.mask))(track.rows, linear.which)


def normalised(fits: np.ndarray, at_px: np.ndarray) -> np.ndarray:
    return (fits[..., :2] - at_px) / np.sqrt(fits[..., [columns.CUU, columns.CVV]])


def test_linear_fits_are_as_accurate_as_fits_and_as_they_state(track: Track, linear: LinearFits) -> None:
    """A wrong derivative or weight, or a covariance of another image's noise, fails it."""
    images = [image(SHOWN, 100 + k) for k in range(IMAGES)]
    said, held = (np.array(all_) for all_ in zip(*(linear(one) for one in images), strict=True))
    whole = np.array([full(track, linear, one) for one in images])
    clear = (np.abs(whole[..., columns.CUU]).max(axis=0) < 0.1) & held.all(axis=0)
    assert held.mean() > 0.97 and clear.mean() > 0.9
    errors, of_whole = (normalised(fits, truth_px(track, linear))[:, clear] for fits in (said, whole))
    # 24 x 90 x 2 values that a mean of 24 leaves independent: 1.5 % of an rms is one s.d.
    assert 0.9 < np.sqrt((errors**2).mean()) < 1.15
    assert np.sqrt((errors**2).mean()) < 1.02 * np.sqrt((of_whole**2).mean())
    assert np.abs(errors.mean(axis=(0, 1))).max() < 3 / np.sqrt(errors[..., 0].size)
    ratio = said[:, clear, columns.CUU] / whole[:, clear, columns.CUU]
    assert abs(np.median(ratio) - 1) < 0.02
    assert np.sqrt(((errors - of_whole) ** 2).mean()) < 0.4  # of the noise


def test_in_its_own_image_a_linear_fit_is_the_fit(linear: LinearFits) -> None:
    """A model that is kept wrongly fails it: a step from the fit to itself is zero."""
    again, holds = linear(image(SHOWN, 2))
    off = normalised(again, linear.fitted[:, :2])[holds & linear.linear]
    assert np.sqrt((off**2).mean()) < 0.06 and np.abs(off).max() < 0.25


def test_more_noise_is_stated(linear: LinearFits) -> None:
    """Covariances of the earlier image alone fail it."""
    one = image(SHOWN, 3)
    rough = one.pixels + np.random.default_rng(4).normal(0.0, 60.0, one.shape)
    noisy, _ = linear(Radiograph(rough.clip(0, 4095).astype(np.uint16), one.white))
    ratio = noisy[:, columns.CUU] / linear.fitted[:, columns.CUU]
    assert np.median(ratio[linear.linear]) > 1.05 and np.median(noisy[linear.linear, columns.CHI2]) > 1.05


def test_beads_that_move_further_than_the_reach_are_left_to_the_fit(track: Track, linear: LinearFits) -> None:
    """A linear fit that is kept while its bead moves is wrong by the square of the movement."""
    far = np.median(reach_px(linear.fitted))
    scale = place(np.zeros((1, 3)))[1][0]
    for share, kept in ((0.3, True), (1.5, False)):
        moved = image(beads((share * far / scale, 0.0, 0.0)), 5)
        after, _ = track.follow(moved)
        assert (after.linear is track.linear) == kept


def test_a_rotation_about_the_middle_is_left_to_the_fit(track: Track, linear: LinearFits) -> None:
    """Its mean movement is zero; a program that looks at that alone keeps linear fits of beads that moved."""
    middle = SIZE / 2
    places = np.array([(bead.u, bead.v) for bead in SHOWN.values()]) - middle
    far = np.median(reach_px(linear.fitted)) / np.median(np.hypot(*places.T))
    for share, kept in ((0.3, True), (1.5, False)):
        c, s = np.cos(share * far), np.sin(share * far)
        rotated = places @ np.array([[c, s], [-s, c]]) + middle
        moved = {name: replace(bead, u=u, v=v) for (name, bead), (u, v) in zip(SHOWN.items(), rotated, strict=True)}
        after, _ = track.follow(image(moved, 9))
        assert (after.linear is track.linear) == kept


def test_a_bead_that_is_covered_does_not_hold(track: Track, linear: LinearFits) -> None:
    """A fit that never looks at its residual fails it: half a bead under metal still gives numbers."""
    covered = image(SHOWN, 6).pixels.copy()
    k = int(np.flatnonzero(linear.linear)[0])
    u, v = np.rint(linear.fitted[k, :2]).astype(int)
    covered[v + 2 : v + 20, u - 25 : u + 25] = 300
    _, holds = linear(Radiograph(covered, 4095))
    assert not holds[k]
    assert holds.mean() > 0.8


def test_light_that_changes_is_left_to_the_fit(linear: LinearFits) -> None:
    brighter = (image(SHOWN, 7).pixels * 1.3).astype(np.uint16)
    assert not linear(Radiograph(brighter, 4095))[1].any()


def test_pixels_outside_the_field_do_not_matter(track: Track, linear: LinearFits) -> None:
    """Reading them as light fails it: the filter reaches beyond the field's edge."""
    one, edge = image(SHOWN, 8), np.ones((SIZE, SIZE), dtype=bool)
    edge[:, : int(linear.fitted[linear.linear, 0].min()) - 12] = False
    dark = one.pixels.copy()
    dark[~edge] = 0
    there = replace(linear, mask=linear.mask & edge, kept=linear.kept._replace(whole=np.zeros_like(linear.kept.whole)))
    seen, _ = there(Radiograph(dark, 4095))
    expected, _ = linear(one)
    off = (seen[:, :2] - expected[:, :2])[linear.linear]
    assert np.abs(off).max() < 0.1 and np.median(np.abs(off)) < 1e-6
