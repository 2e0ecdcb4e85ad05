"""Tracked beads are those of a new detection; a lost track is reported."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.detection.bead_images import Bead
from tests.detection.track_images import FRAME, SIZE, beads, image, place

from sightline.detection import Observations, detect, label, look_again
from sightline.detection.track import Track, TrackLost
from sightline.imaging import Radiograph


def looked_at(one: Radiograph) -> tuple[Track, Observations]:
    found = detect(one)
    seen = look_again(one, found, label(found, FRAME), FRAME)
    return Track.begin(one, found, seen, FRAME), seen


def by_id(seen: Observations) -> dict[str, np.ndarray]:
    return dict(zip(seen.ids, seen.uv_px, strict=True))


def errors_px(seen: Observations, truth: dict[str, Bead]) -> np.ndarray:
    return np.array([uv - (truth[i].u, truth[i].v) for i, uv in by_id(seen).items()])


@pytest.fixture(scope="module")
def start() -> Track:
    return looked_at(image(beads(), 1))[0]


def test_a_followed_bead_is_where_it_would_be_found_anew(start: Track) -> None:
    shown = beads((0.31, -0.17, 0.0))
    following = image(shown, 2)
    _, seen = start.follow(following)
    _, anew = looked_at(following)
    there, found = by_id(seen), by_id(anew)
    common = there.keys() & found.keys()
    assert len(common) > 0.95 * len(found)
    apart = np.array([there[i] - found[i] for i in common])
    assert np.sqrt(np.median((apart**2).sum(axis=1))) < 0.01  # a tenth of the noise: steps end at 0.02 px
    assert np.sqrt(np.mean(errors_px(seen, shown) ** 2)) < 0.15
    assert len(start.follow(following)[1]) == len(seen)  # following changes nothing in the track it starts from


def test_beads_of_a_fine_panel_are_followed_in_pixels_of_twice_the_side() -> None:
    def fine(x_mm: float, seed: int) -> Radiograph:
        pixels = cv2.resize(
            image(beads((x_mm, 0.0, 0.0)), seed).pixels, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC
        )
        return Radiograph(pixels, 4095)

    first, then, later = fine(0.0, 1), fine(0.31, 2), fine(0.62, 3)
    (track, _), (halved, _) = looked_at(first), looked_at(first.binned(2))
    assert track.ids == halved.ids
    for step, one in (("follow", then), ("look", later)):
        track, seen = getattr(track, step)(one)
        halved, expected = getattr(halved, step)(one.binned(2))
        assert sorted(seen.ids) == sorted(expected.ids) and seen.image_shape == (4 * SIZE, 4 * SIZE)
        order = [seen.ids.index(one) for one in expected.ids]  # anew, beads come as they were found
        assert seen.covariance_px2 is not None and expected.covariance_px2 is not None
        apart = np.abs((seen.uv_px[order] + 0.5) / 2 - 0.5 - expected.uv_px)
        assert (apart < 0.02).mean() > 0.95  # where fits end; of beads that touch, within what is stated of them:
        assert (apart**2 < np.diagonal(expected.covariance_px2, axis1=1, axis2=2)).all()
        ratio = seen.covariance_px2[order, 0, 0] / 4 / expected.covariance_px2[:, 0, 0]
        assert (np.abs(ratio - 1) < 0.01).mean() > 0.95  # but crowded ones: their free pixels are counted in whole
    with pytest.raises(TrackLost, match="size"):
        track.follow(then.binned(2))


def test_a_steady_movement_is_followed_further_than_a_window(start: Track) -> None:
    track = start
    for k, x in enumerate((0.3, 0.9, 1.8, 2.9, 4.2, 5.5)):  # 40 px on the source plate, and a bead's radius is 11
        shown = beads((x, 0.0, 0.0))
        track, seen = track.follow(image(shown, 10 + k))
        assert np.hypot(*errors_px(seen, shown).T).max() < 1.0
    assert len(seen) > 0.75 * len(start.ids)


def test_a_bead_that_is_covered_is_left_out_and_taken_again(start: Track) -> None:
    covered = image(beads(), 3).pixels.copy()
    v = round(start.rows[0, 1])
    covered[v - 12 : v + 3, :] = 300  # a bar over half of a row of beads
    track, seen = start.follow(Radiograph(covered, 4095))
    assert start.ids[0] not in seen.ids
    assert len(seen) >= 0.75 * len(start.ids)
    assert start.ids[0] in track.follow(image(beads(), 4))[1].ids


def test_a_bead_that_comes_into_sight_is_found_by_a_whole_look() -> None:
    track, before = looked_at(image(beads(leave_out=1), 5))
    name = next(iter(beads()))
    assert name not in before.ids
    shown = beads()
    assert name not in track.follow(image(shown, 6))[1].ids
    track, seen = track.look(image(shown, 6))
    assert name in seen.ids
    assert np.hypot(*(by_id(seen)[name] - (shown[name].u, shown[name].v))) < 0.5
    assert name in track.follow(image(shown, 7))[1].ids


def test_beads_that_jumped_are_not_followed(start: Track) -> None:
    with pytest.raises(TrackLost, match="not where they were"):
        start.follow(image(beads((6.0, 3.0, 0.0)), 8))


def test_a_step_of_the_grid_is_told_by_the_sizes_of_the_balls() -> None:
    """After a shift by a step of the grid, every window holds a bead, but a datum ball where a small ball was."""
    track, seen = looked_at(image(beads(), 1))
    names = {f.id: f for f in FRAME.view("pa").fiducials}
    shifted = {}
    for name, uv in by_id(seen).items():
        xyz = np.add(names[name].xyz_mm, (20.0, 0.0, 0.0))
        other = min(names.values(), key=lambda f, xyz=xyz: np.linalg.norm(np.array(f.xyz_mm) - xyz))
        radius = place(np.array([names[name].xyz_mm]))[1][0] * other.diameter_mm / 2
        shifted[name] = Bead(*uv, radius)
    with pytest.raises(TrackLost, match="other sizes"):
        track.follow(image(shifted, 9))


def test_an_image_of_another_size_is_not_followed(start: Track) -> None:
    with pytest.raises(TrackLost, match="size"):
        start.follow(Radiograph(image(beads(), 2).pixels[:400], 4095))


def test_an_empty_image_is_not_followed(start: Track) -> None:
    with pytest.raises(TrackLost):
        start.follow(image({}, 2))
    with pytest.raises(TrackLost):
        replace(start).look(Radiograph(np.full((SIZE, SIZE), 2000, np.uint16), 4095))
