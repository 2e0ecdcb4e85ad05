"""What labelling builds on: three datums tell plate, orientation and handedness."""

import numpy as np
import pytest

from sightline.frame import Frame
from sightline.frame.designs import BUILTIN, builtin_design, grid_places, patterns_for
from sightline.frame.patterns import Triples, hidden_blocks, in_steps, nearest_likeness, resemblance, search
from sightline.frame.plate import ROLES

TURNS = [np.array(m).reshape(2, 2) for m in ((1, 0, 0, 1), (0, -1, 1, 0), (-1, 0, 0, -1), (0, 1, -1, 0))]
PLACINGS = [turn @ np.diag([1, flip]) for flip in (1, -1) for turn in TURNS]


def plates(name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """(points in steps, which are datums) of each plate."""
    frame = Frame.load(name)
    every = [getattr(view, role) for view in frame.views.values() for role in ROLES]
    return [(in_steps(p.plane.to_plane(p.xyz_mm)), p.is_datum) for p in every]


@pytest.mark.parametrize("name", BUILTIN)
def test_no_wrong_placement_agrees_in_three_datums(name):
    """Every rotation, mirror image and shift by grid steps of one pattern against every pattern, itself included."""
    patterns = [points[datum] for points, datum in plates(name)]
    for i, mine in enumerate(patterns):
        for j, theirs in enumerate(patterns):
            for index, placing in enumerate(PLACINGS):
                shifts = (theirs[:, None] - mine @ placing.T).reshape(-1, 2).round(3)
                found, agreeing = np.unique(shifts, axis=0, return_counts=True)
                if i == j and index == 0:
                    agreeing = agreeing[np.abs(found).max(axis=1) > 0.01]
                assert agreeing.max() <= 2


@pytest.mark.parametrize(
    ("one", "other", "most"), [("gamma", "biplane", 3), ("biplane", "stereo", 3), ("gamma", "stereo", 4)]
)
def test_no_placement_of_one_frame_on_another_agrees_in_most_datums_of_six(one, other, most):
    for mine in (points[datum] for points, datum in plates(one)):
        for points, datum in plates(other):
            for placing in PLACINGS:
                shifts = (points[datum][:, None] - mine @ placing.T).reshape(-1, 2)
                apart = np.linalg.norm(shifts[:, None] - shifts, axis=2)
                assert (apart < 0.01).sum(axis=1).max() <= most


@pytest.mark.slow
def test_frames_of_other_names_have_other_patterns_and_one_name_always_the_same():
    beams = builtin_design("gamma").beams
    ours, again, theirs = (patterns_for(beams, name=name) for name in ("ours", "ours", "theirs"))
    assert ours == again
    assert all(a != b for view in beams for a, b in zip(ours[view], theirs[view], strict=True))


@pytest.mark.parametrize("name", BUILTIN)
def test_no_three_datums_are_collinear_and_few_are_slender(name):
    triples = [Triples.of(points[datum]) for points, datum in plates(name)]
    assert min(t.height.min() for t in triples) > 0.1
    assert sum(len(t.broad().area) for t in triples) >= 60


@pytest.mark.parametrize("name", BUILTIN)
def test_no_broad_triple_resembles_another_within_what_an_image_stretches(name):
    """1.09 in stretch or scale; a tilt of 20° stretches by 1.064."""
    patterns = [points[datum] for points, datum in plates(name)]
    for i, mine in enumerate(patterns):
        own = nearest_likeness(mine)
        across = nearest_likeness(mine, [p for j, p in enumerate(patterns) if j != i])
        assert 1.10 ** min(own.min(), across.min()) > 1.09


@pytest.mark.parametrize("name", BUILTIN)
def test_three_datums_are_left_wherever_a_block_hides_40_percent(name):
    for points, datum in plates(name):
        assert (~hidden_blocks(points)[:, datum]).sum(axis=1).min() >= 3


def test_resemblance_is_the_stretch_and_scale_of_the_map():
    points = np.array([[0.0, 0.0], [3.0, 1.0], [-1.0, 4.0]])
    cosine, sine = np.cos(0.7), np.sin(0.7)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    for stretch, scale, expected in ((1.06, 1.0, np.log(1.06)), (1.0, 1.07, np.log(1.07)), (1.05, 0.93, -np.log(0.93))):
        shape = turn @ np.diag([scale * stretch**0.5, -scale * stretch**-0.5])
        far = resemblance(Triples.of(points @ shape.T + 5), Triples.of(points))
        assert far[0, 0, 0] == pytest.approx(expected / np.log(1.10), rel=1e-6)


def test_a_search_leaves_fewer_lookalikes_than_a_draw_and_repeats_itself():
    places = [np.array(grid_places(rows), dtype=float) for rows in (7, 8)]
    first, again, drawn = (search(places, 6, np.random.default_rng(4), moves=moves) for moves in (1500, 1500, 1))
    np.testing.assert_array_equal(first, again)

    def lookalikes(chosen: list[np.ndarray]) -> int:
        one, other = (points[mine] for points, mine in zip(places, chosen, strict=True))
        likeness = [nearest_likeness(one), nearest_likeness(other), nearest_likeness(one, [other])]
        return int((np.concatenate(likeness) < 1).sum())

    assert lookalikes(first) < lookalikes(drawn) / 3
