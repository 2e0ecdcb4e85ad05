"""Head, neck and shaft from what is drawn: exact without error, covariance by sampling, refused with a reason."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.errors import UnusableInputError
from sightline.planning import (
    Aids,
    Circle,
    Line,
    Pick,
    locate,
    matching_curve,
    metrics,
    outline,
    plan,
    reconstruct,
    snap,
)
from sightline.planning.bone.anatomy import Drawings
from sightline.planning.points.picks import stack
from sightline.planning.points.reconstruct import points_of
from sightline.planning.points.results import MAX_GAP_SIGMA, SpacePoints

from . import bone
from .standin import estimates, pair

VIEWS = pair()


def test_perfect_drawings_give_the_bone():
    uv = bone.pixels(VIEWS)
    found = locate(VIEWS, bone.aids(uv), bone.picks(uv))
    assert not found.absent
    assert found.undrawn("outline")  # few procedures ask for it
    np.testing.assert_allclose(found.head.centre_mm, bone.CENTRE_MM, atol=1e-6)
    assert found.head.radius_mm == pytest.approx(bone.RADIUS_MM, abs=1e-6)
    assert found.head.agreement.passed
    assert found.head.agreement.figure < 1e-6
    for axis, on_mm, along in ((found.neck, bone.ON_NECK_MM, bone.NECK), (found.shaft, bone.ON_SHAFT_MM, bone.SHAFT)):
        np.testing.assert_allclose(axis.direction, along, atol=1e-8)
        assert axis.distance_mm(on_mm) < 1e-6
    np.testing.assert_allclose(found.part("wire"), np.r_[bone.ENTRY_MM, bone.END_MM], atol=1e-7)


def test_all_covariances_by_sampling():
    """With views, frame errors and clicks drawn anew, all parts and metrics have the stated errors, jointly too."""
    views, rng = VIEWS, np.random.default_rng(12)
    uv, sd, draws = bone.pixels(views), 0.5, 60
    stated = locate(views, bone.aids(uv, sd), bone.picks(uv, sd))
    truth = metrics(stated, "right")
    parts, errors, agreements = ("wire", "neck", "shaft", "head"), [], []
    for _ in range(draws):
        clicked = {name: [each + rng.normal(0.0, sd, each.shape) for each in both] for name, both in uv.items()}
        found = locate(estimates(views, rng), bone.aids(clicked, sd), bone.picks(clicked, sd))
        agreements.append(found.head.agreement.figure)
        errors.append(
            np.r_[
                np.concatenate([found.part(name) - stated.part(name) for name in parts]),
                [(one.value - true.value) / true.sd for one, true in zip(metrics(found, "right"), truth, strict=True)],
            ]
        )
    own = [np.arange(stated.at[name].start, stated.at[name].stop) for name in parts]
    whole = np.concatenate(own)
    for rows in (*own, whole):
        at = [int(np.flatnonzero(whole == row)[0]) for row in rows]
        error, covariance = np.array(errors)[:, at], stated.covariance[np.ix_(rows, rows)]
        squares = np.einsum("ni,in->n", error, np.linalg.solve(covariance, error.T))
        # The mean of chi-square over its freedom scatters by sqrt(2 / (freedom draws)); 4 of these.
        assert squares.mean() / len(rows) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (len(rows) * draws)))
    spread = np.mean(np.square(np.array(errors)[:, len(whole) :]), axis=0)
    np.testing.assert_allclose(spread, 1.0, atol=4 * np.sqrt(2 / draws))
    # Nine clicks on the rim less four numbers of the sphere.
    assert np.mean(agreements) == pytest.approx(5.0, abs=4 * np.sqrt(2 * 5.0 / draws))


def _at_rest(views, uv_px) -> tuple[SpacePoints, SpacePoints]:
    """What entry and end show of a movement: alone, and with the head."""
    picks = bone.picks(uv_px)
    drawn = Drawings.of(views, Aids(head=bone.aids(uv_px).head), picks)
    seen = points_of(drawn.solve(stack(picks).regular(), "weighted"))
    return seen, drawn.with_head(seen)


def test_shift_and_chi_square_of_points_and_head_by_sampling():
    rng, uv, draws = np.random.default_rng(13), bone.pixels(VIEWS), 100
    found = []
    for _ in range(draws):
        clicked = {name: [each + rng.normal(0.0, 0.5, each.shape) for each in both] for name, both in uv.items()}
        seen = _at_rest(estimates(VIEWS, rng), clicked)[1]
        assert seen.head_tested
        found.append((seen.shift_mm / seen.shift_sd_mm, seen.gap_chi2))
    shift, chi2 = np.array(found).T
    assert np.mean(chi2) == pytest.approx(3.0, abs=4 * np.sqrt(6.0 / draws))
    assert np.mean(shift**2) == pytest.approx(1.0, abs=4 * np.sqrt(2.0 / draws))


def test_points_and_head_together_show_a_movement_that_each_alone_does_not():
    """Along the common normal of the beams, Y, before the second image."""
    views, uv = bone.views(), bone.pixels(bone.views())
    by_px = np.diff(views[1].project(bone.CENTRE_MM + np.array([[0.0, 0.0, 0.0], [0.0, 0.22, 0.0]])), axis=0)
    moved = {name: [each[0], *(one + by_px for one in each[1:])] for name, each in uv.items()}
    alone, together = _at_rest(views, moved)
    assert alone.shift_mm < MAX_GAP_SIGMA * alone.shift_sd_mm
    assert locate(views, bone.aids(moved)).head.agreement.passed
    assert together.shift_mm > MAX_GAP_SIGMA * together.shift_sd_mm
    assert together.shift_mm == pytest.approx(0.22, abs=0.02)
    entry, end = np.swapaxes(moved["wire"], 0, 1)
    made = plan(views, entry, end, procedure="free-wire", aids=bone.aids(moved))
    (check,) = (one for one in made.verdict.checks if one.name == "movement")
    assert not check.passed and "moved by 0.22" in check.sentence


@pytest.mark.parametrize("snapped", [False, True])
def test_the_wire_is_the_trajectory_of_the_plan(snapped):
    uv = bone.pixels(VIEWS)
    picks = bone.picks(uv)
    if snapped:
        curves = [matching_curve(VIEWS[0], first.uv_px, VIEWS[1]) for first, _ in picks]
        picks = tuple((a, snap(curve, b.uv_px)) for (a, b), curve in zip(picks, curves, strict=True))
    uv_px, covariance, across = stack(picks)
    points = reconstruct(VIEWS, uv_px, covariance, across_px=across)
    found = locate(VIEWS, bone.aids(uv), picks)
    np.testing.assert_allclose(found.part("wire"), points.xyz_mm.ravel(), atol=1e-9)
    at = found.at["wire"]
    np.testing.assert_allclose(found.covariance[at, at], points.joint_covariance_mm2, rtol=1e-8, atol=1e-12)


def test_a_drawn_circle_is_three_numbers_and_finds_the_sphere():
    """A circle cannot follow a distorted outline: 0.15 mm are left to it."""
    turns = np.deg2rad(np.arange(0.0, 360.0, 10.0))
    circles = []
    for view in VIEWS:
        rim = bone.rim(view, turns)
        design = np.column_stack([2 * rim, np.ones(len(rim))])
        u, v, rest = np.linalg.lstsq(design, (rim**2).sum(axis=1), rcond=None)[0]
        circles.append(Circle.of(np.array([u, v]), float(np.sqrt(rest + u**2 + v**2)), 0.5))
        assert np.linalg.matrix_rank(circles[-1].covariance_px2, tol=1e-9) == 3
    found = locate(VIEWS, Aids(head=(circles[0], circles[1])))
    np.testing.assert_allclose(found.head.centre_mm, bone.CENTRE_MM, atol=0.15)
    assert found.head.radius_mm == pytest.approx(bone.RADIUS_MM, abs=0.15)
    # Six numbers for four: not twenty-four.
    assert found.head.agreement.limit == pytest.approx(13.8, abs=0.1)


def test_the_centre_of_the_outline_is_not_the_image_of_the_centre():
    """What a circle fitted in the image would get wrong, and lines of sight do not: about 0.1 px here."""
    view = pair()[0]
    sphere = locate(pair(), bone.aids(bone.pixels(pair()))).head
    drawn = outline(view, sphere, 360)
    assert len(drawn) == 360
    ray = view.plane.to_space(view.to_plane(drawn)) - view.focal_point_mm
    passed = np.cross(sphere.centre_mm - view.focal_point_mm, ray)
    np.testing.assert_allclose(np.linalg.norm(passed, axis=1) / np.linalg.norm(ray, axis=1), bone.RADIUS_MM, atol=1e-5)
    off = np.linalg.norm(drawn.mean(axis=0) - view.project(bone.CENTRE_MM[None])[0])
    assert off > 0.05


def test_an_axis_in_the_plane_of_both_beams_is_refused_and_nothing_else_is():
    uv = bone.pixels(VIEWS)
    level = np.array([-0.8, 0.0, 0.6])  # beams run along Z and X
    uv["neck"] = [bone.drawn_line(view, bone.ON_NECK_MM, level, (0.0, 25.0)) for view in VIEWS]
    found = locate(VIEWS, bone.aids(uv), bone.picks(uv))
    assert set(found.absent) == {"neck"}
    assert "plane of both beams" in found.absent["neck"]
    assert found.neck is None
    np.testing.assert_allclose(found.head.centre_mm, bone.CENTRE_MM, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "name", "why"),
    [
        ({"neck": [np.array([[500.0, 500.0], [502.0, 501.0]])] * 2}, "neck", "too close together"),
        ({"shaft": [np.array([[20.0, 20.0], [500.0, 400.0]])] * 2}, "shaft", "outside the calibrated region"),
        ({"head": [500.0 + 20.0 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])] * 2}, "head", "do not fit a sphere"),
    ],
)
def test_bad_drawings_are_absent_with_the_reason(change, name, why):
    uv = bone.pixels(VIEWS) | change
    found = locate(VIEWS, bone.aids(uv), bone.picks(uv))
    assert why in found.absent[name]
    assert "wire" in found.at


def test_what_is_not_drawn_is_no_part_and_what_is_located_by_it_waits():
    uv = bone.pixels(VIEWS)
    found = locate(VIEWS, Aids(calcar=bone.aids(uv).calcar))
    assert (found.waiting, found.undrawn("calcar"), found.why_absent("calcar")) == (
        {"calcar"}, False, found.why_absent("head"),
    )  # fmt: skip
    assert all(found.undrawn(name) for name in ("head", "neck", "shaft", "outline", "cortex", "wire"))
    assert (found.head, found.neck, found.shaft) == (None, None, None)
    assert set(found.at) == {"focal"}


def test_unknown_errors_stay_unknown():
    uv = bone.pixels(VIEWS)
    found = locate([VIEWS[0], replace(VIEWS[1], factors=None)], bone.aids(uv), bone.picks(uv))
    assert found.covariance is None
    assert found.head.covariance_mm2 is None
    assert found.head.agreement is None
    assert found.neck.direction_covariance_rad2 is None
    np.testing.assert_allclose(found.head.centre_mm, bone.CENTRE_MM, atol=1e-6)
    assert all(metric.sd is None and metric.value is not None for metric in metrics(found, "right"))


def test_bad_arguments_are_refused():
    with pytest.raises(UnusableInputError, match="'pa' and 'lateral'"):
        locate(pair()[::-1], Aids())
    for bad in (np.zeros((2, 2)), np.full((3, 2), np.nan), np.zeros(4)):
        with pytest.raises(UnusableInputError, match="rim"):
            Circle.through(bad)
    for centre, radius in ((np.zeros(3), 5.0), (np.zeros(2), 0.0), (np.array([np.nan, 1.0]), 5.0)):
        with pytest.raises(UnusableInputError, match="radius"):
            Circle.of(centre, radius)
    for uv, sd in ((np.zeros((3, 2)), 0.5), (np.zeros((2, 2)), 0.0), (np.full((2, 2), np.inf), 0.5)):
        with pytest.raises(UnusableInputError):
            Line(uv, sd)
    assert Pick.free([1.0, 2.0]).uv_px.shape == (2,)
