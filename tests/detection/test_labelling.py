"""Beads are labelled correctly, or not at all."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from benchmarks.scenes.plates import Hiding, Scene, clean_views, draw_scene

from sightline.detection import Detections, Observations, label
from sightline.detection.labelling.label import MAY_BE_TWO
from sightline.errors import FrameError, LabellingRefusedError, ObservationsError
from sightline.frame import Fiducial, Frame, FrameView, Plate
from sightline.frame.designs import BUILTIN
from sightline.twin.xray.presets import PRESETS

GAMMA = Frame.load("gamma")
ALL_SEEN = Hiding(most=0.15)


def scene(seed: int, view: str = "pa", frame: Frame = GAMMA, hiding: Hiding = ALL_SEEN, false: int = 10) -> Scene:
    return draw_scene(np.random.default_rng(seed), frame, view, hiding, false)


def truth_of(found: Observations, one: Scene) -> list[frozenset[str]]:
    at = {tuple(uv): truth for uv, truth in zip(one.detections.uv_px, one.truth, strict=True)}
    return [at[tuple(uv)] for uv in found.uv_px]


def assert_right(found: Observations, one: Scene) -> None:
    assert all(name in truth for name, truth in zip(found.ids, truth_of(found, one), strict=True))
    assert (found.view, found.mirrored) == (one.view, one.mirrored)


def turned(detections: Detections, linear: np.ndarray) -> Detections:
    """Return the image rotated or mirrored about its middle; radii and noise stay."""
    middle = (np.array(detections.image_shape[::-1]) - 1) / 2
    return replace(detections, uv_px=(detections.uv_px - middle) @ linear.T + middle)


def frame_without_datums() -> Frame:
    def plain(plate: Plate) -> Plate:
        return Plate(tuple(replace(f, diameter_mm=3.0) for f in plate.fiducials))

    views = {name: FrameView(plain(v.xrii), plain(v.source)) for name, v in GAMMA.views.items()}
    return replace(GAMMA, views=views)


def frame_without_a_row(role: str) -> Frame:
    """Return the frame without the last row of a plate of the lateral view."""
    view = GAMMA.view("lateral")
    plate = getattr(view, role)
    along = plate.plane.to_plane(plate.xyz_mm)[:, 0]
    kept = Plate(tuple(f for f, x in zip(plate.fiducials, along, strict=True) if x < along.max() - 1.0))
    return replace(GAMMA, views=dict(GAMMA.views) | {"lateral": replace(view, **{role: kept})})


def given_pixels(one: Scene, role: str) -> dict[str, tuple[float, float]]:
    plate = getattr(GAMMA.view(one.view), role)
    seen = {next(iter(t)): uv for t, uv in zip(one.truth, one.detections.uv_px, strict=True) if len(t) == 1}
    names = [f.id for f in plate.fiducials if f.datum and f.id in seen]
    return {name: (seen[name][0] + 2.0, seen[name][1] - 1.0) for name in names}


@pytest.mark.parametrize(
    ("linear", "flips"),
    [
        ([[1, 0], [0, 1]], False),
        ([[0, -1], [1, 0]], False),
        ([[-1, 0], [0, -1]], False),
        ([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]], False),
        ([[-1, 0], [0, 1]], True),
        ([[0, 1], [1, 0]], True),
    ],
)
@pytest.mark.parametrize("view", ["pa", "lateral"])
def test_turned_and_mirrored_images_are_labelled_alike_and_mirroring_is_said(
    view: str, linear: list[list[float]], flips: bool
) -> None:
    one = scene(3, view)
    straight = label(one.detections, GAMMA)
    found = label(turned(one.detections, np.array(linear, dtype=float)), GAMMA)
    assert_right(straight, one)
    assert len(found) >= 0.9 * len(straight)
    assert found.mirrored == (straight.mirrored != flips)
    of = dict(zip(straight.ids, straight.uv_px.tolist(), strict=True))
    middle = (np.array(one.detections.image_shape[::-1]) - 1) / 2
    for name, uv in zip(found.ids, found.uv_px, strict=True):
        if name in of:
            np.testing.assert_allclose((uv - middle) @ np.array(linear), np.array(of[name]) - middle, atol=1e-9)


def test_a_hundred_scenes_are_right_or_refused() -> None:
    rng = np.random.default_rng(77)
    solved = solvable = 0
    for _ in range(100):
        one = draw_scene(rng, GAMMA)
        solvable += one.solvable
        try:
            found = label(one.detections, GAMMA)
        except LabellingRefusedError:
            continue
        assert_right(found, one)
        solved += one.solvable
    assert solvable > 70
    # 98 % of 10,000 scenes (benchmarks/bench_labelling.py), less two standard deviations of the share of 80.
    assert solved >= 0.95 * solvable


@pytest.mark.parametrize("seed", [5, 11, 12, 46])
def test_labels_do_not_depend_on_the_rounding_of_pixels(seed: int) -> None:
    """Fails where rounding decides which of several places at the same distance is counted as a neighbour."""
    one = draw_scene(np.random.default_rng([77, seed]), GAMMA).detections
    labels = [label(replace(one, uv_px=one.uv_px * (1 + k * 1e-14)), GAMMA).ids for k in (0, 1, -1, 3, -3)]
    assert len(labels[0]) > 40 and labels == labels[:1] * 5


@pytest.mark.parametrize("cropped", [False, True])
@pytest.mark.parametrize("chain", PRESETS)
def test_clean_views_of_every_image_chain_are_labelled(chain: str, cropped: bool) -> None:
    """Of the views that can be labelled; a 17 cm field shows few datum markers."""
    drawn = (clean_views(np.random.default_rng([9, seed]), GAMMA, chain, cropped=cropped) for seed in range(6))
    able = [one for views in drawn for one in views if one.solvable]
    for one in able:
        assert_right(label(one.detections, GAMMA), one)
    assert able


@pytest.mark.parametrize("name", ["biplane", "stereo"])
def test_the_other_built_in_frames_are_labelled(name: str) -> None:
    frame = Frame.load(name)
    for seed, view in enumerate(frame.views):
        one = scene(seed, view, frame)
        found = label(one.detections, frame, view=view)
        assert_right(found, one)
        assert len(found) > 0.8 * sum(len(t) == 1 for t in one.truth)


@pytest.mark.parametrize(("role", "said"), [("xrii", "XRII"), ("source", "source")])
def test_balls_where_the_grid_would_go_on_are_refused(role: str, said: str) -> None:
    frame = frame_without_a_row(role)
    for seed in (3, 5):
        one = scene(seed, "lateral")
        assert_right(label(one.detections, GAMMA), one)
        with pytest.raises(LabellingRefusedError, match=f"balls are seen beyond the edge of the {said} plate"):
            label(one.detections, frame)


def test_washers_can_be_datum_markers() -> None:
    def washers(plate: Plate) -> Plate:
        out: list[Fiducial] = [replace(f, shape="washer", diameter_mm=4.0) if f.datum else f for f in plate.fiducials]
        return Plate(tuple(out))

    views = {name: FrameView(washers(v.xrii), washers(v.source)) for name, v in GAMMA.views.items()}
    frame = replace(GAMMA, views=views)
    one = scene(5, "pa", frame)
    assert "washer" in one.detections.kind
    assert_right(label(one.detections, frame), one)


def test_the_view_given_is_kept_when_right_and_refused_when_wrong() -> None:
    one = scene(8, "lateral")
    assert label(one.detections, GAMMA, view="lateral").view == "lateral"
    with pytest.raises(LabellingRefusedError, match="shows the lateral view, not pa; are the two images exchanged"):
        label(one.detections, GAMMA, view="pa")
    with pytest.raises(FrameError, match="no view 'oblique'"):
        label(one.detections, GAMMA, view="oblique")


@pytest.mark.parametrize(("shown", "used"), list(permutations(BUILTIN, 2)))
def test_the_image_of_another_frame_is_refused(shown: str, used: str) -> None:
    other = Frame.load(shown)
    for seed in range(2):
        one = scene(seed, list(other.views)[seed], other)
        with pytest.raises(LabellingRefusedError) as refusal:
            label(one.detections, Frame.load(used))
        assert refusal.type is LabellingRefusedError


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_balls_of_another_size_are_refused_with_both_sizes(factor: float) -> None:
    one = scene(3)
    sized = replace(one.detections, radius_px=one.detections.radius_px * factor)
    with pytest.raises(LabellingRefusedError, match=r"and the frame says 3\.00 mm") as refusal:
        label(sized, GAMMA)
    looks = float(str(refusal.value).split(" look ")[1].split(" mm")[0])
    assert looks == pytest.approx(3.0 * factor, rel=0.06)  # the scene's own factor lies within 0.98-1.04


def only(d: Detections, rows: np.ndarray) -> Detections:
    """Return some of the detections (bool or indices)."""
    kinds = tuple(np.array(d.kind, dtype=object)[rows])
    return Detections(d.uv_px[rows], d.radius_px[rows], d.covariance_px2[rows], kinds, d.contrast[rows], d.image_shape)


@pytest.mark.parametrize("count", [0, 3, 15])
def test_too_few_beads_are_refused_with_their_number(count: int) -> None:
    with pytest.raises(LabellingRefusedError, match=f"^{count} beads were found"):
        label(only(scene(1).detections, np.arange(count)), GAMMA)


def test_one_plate_alone_is_refused_by_its_name() -> None:
    one = scene(4)
    alone = only(one.detections, np.array([any("-s-" in name for name in t) for t in one.truth]))
    with pytest.raises(LabellingRefusedError, match="source plate of the pa view; move the C-arm or the frame"):
        label(alone, GAMMA)


def test_noise_and_a_pattern_that_cannot_be_told_are_refused() -> None:
    rng, n = np.random.default_rng(4), 120
    frame = frame_without_datums()
    plain = draw_scene(np.random.default_rng(2), frame, "pa", ALL_SEEN).detections
    radius_px = rng.choice([8.0, 9.5, 13.0, 15.5], n, p=[0.4, 0.4, 0.1, 0.1]) * rng.uniform(0.95, 1.05, n)
    covariance = 0.04 * np.broadcast_to(np.eye(2), (n, 2, 2))
    noise = [
        Detections(rng.uniform(0, 1023, (n, 2)), radius_px, covariance, ("ball",) * n, np.full(n, -0.5), (1024, 1024))
        for _ in range(3)
    ]
    for seen, of in ((plain, frame), *((one, GAMMA) for one in noise)):
        with pytest.raises(LabellingRefusedError):
            label(seen, of)


def test_pixels_given_for_datums_label_the_rest() -> None:
    one = scene(7)
    datums = given_pixels(one, "xrii") | given_pixels(one, "source")
    found = label(one.detections, GAMMA, datums=datums)
    assert_right(found, one)
    assert len(found) > 0.8 * sum(len(t) == 1 for t in one.truth)


def test_pixels_given_in_the_wrong_order_are_refused() -> None:
    one = scene(7)
    xrii = given_pixels(one, "xrii")
    a, b, c, *_ = xrii
    wrong = xrii | {a: xrii[b], b: xrii[c], c: xrii[a]} | given_pixels(one, "source")
    with pytest.raises(LabellingRefusedError):
        label(one.detections, GAMMA, datums=wrong)


def test_unusable_pixels_for_datums_say_what_to_give() -> None:
    one = scene(7)
    xrii, source = given_pixels(one, "xrii"), given_pixels(one, "source")
    with pytest.raises(ObservationsError, match="three or more datum markers of the source plate"):
        label(one.detections, GAMMA, datums=xrii)
    with pytest.raises(ObservationsError, match="not fiducials of one view"):
        label(one.detections, GAMMA, datums=xrii | {"nobody": (1.0, 2.0)})
    name = next(iter(xrii))
    with pytest.raises(LabellingRefusedError, match=f"no bead was found at the pixel given for {name}"):
        label(one.detections, GAMMA, datums=xrii | source | {name: (-50.0, -50.0)})


def test_labels_come_with_radii_covariances_and_what_was_not_labelled() -> None:
    """Each dark detection is labelled, or rejected with a reason; false beads are never labelled."""
    one = scene(9)
    found = label(one.detections, GAMMA)
    assert found.radius_px is not None and found.covariance_px2 is not None
    assert found.rejected
    rows = [one.detections.uv_px.tolist().index(uv) for uv in found.uv_px.tolist()]
    np.testing.assert_array_equal(found.radius_px, one.detections.radius_px[rows])
    np.testing.assert_array_equal(found.covariance_px2, one.detections.covariance_px2[rows])
    assert found.image_shape == one.detections.image_shape
    dark = {tuple(uv) for uv, kind in zip(one.detections.uv_px, one.detections.kind, strict=True) if kind != "hole"}
    labelled, left = {tuple(uv) for uv in found.uv_px}, {rejected.uv_px for rejected in found.rejected}
    assert labelled | left == dark
    assert not labelled & left
    truth = dict(zip(map(tuple, one.detections.uv_px), one.truth, strict=True))
    nowhere = [r for r in found.rejected if r.reason != MAY_BE_TWO]
    assert nowhere
    assert all(len(truth[r.uv_px]) != 1 for r in nowhere)  # false beads, and two that touch
