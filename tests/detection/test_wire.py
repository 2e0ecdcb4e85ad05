"""The wire in an image: centre line and tip against the truth, and refusals."""

from dataclasses import replace

import numpy as np
import pytest
from tests.detection.wire_images import PX_PER_MM, SIZE, Drawn, expected, image_of

from sightline.detection import Detections
from sightline.detection.wire import WireShadow, _left_out_residuals, _Piece, find_wire
from sightline.detection.wire_model import BEND, WireFit
from sightline.errors import UnusableInputError, WireRefusedError
from sightline.imaging import Radiograph

WIRE = Drawn((391.37, 301.62), 0.43)
ACROSS = np.array([-WIRE.along[1], WIRE.along[0]])
PLANNED = expected(WIRE)
V, U = np.mgrid[:SIZE, :SIZE]


def drawn(*wires: Drawn, seed: int = 1, **light: float | np.ndarray) -> Radiograph:
    return image_of(list(wires), np.random.default_rng(seed), **light)


def clear(*wires: Drawn) -> Radiograph:
    """Return an image with hardly any noise."""
    return drawn(*wires, seed=3, quanta=2e4)


def off_line(seen: WireShadow, wire: Drawn) -> np.ndarray:
    """Return the errors (N,), px, of the centre line across the true one."""
    return (seen.uv_px - wire.tip_px) @ [-wire.along[1], wire.along[0]]


def at_tip(seen: WireShadow, wire: Drawn) -> float:
    """Return the error of the tip along the wire, px."""
    return float((seen.tip_uv_px - wire.tip_px) @ wire.along)


@pytest.mark.parametrize("diameter_mm", [2.5, 3.2])
def test_with_hardly_any_noise_line_and_tip_lie_where_they_are(diameter_mm):
    wire = Drawn((391.37, 301.62), 0.43, diameter_mm, 1.5 * diameter_mm)
    seen = find_wire(clear(wire), expected(wire, aside_mm=2.0, turned_rad=0.02), diameter_mm)
    assert np.abs(off_line(seen, wire)).max() < 0.03
    assert abs(at_tip(seen, wire)) < 0.3
    assert seen.width_mm == pytest.approx(diameter_mm, rel=0.03)
    assert seen.contrast < -0.8


def test_a_plain_end_is_found_where_it_is_said_to_be_one():
    wire = Drawn((391.37, 301.62), 0.43, point_mm=0.0)
    seen = find_wire(clear(wire), expected(wire), 2.5, point_mm=0.0)
    assert abs(at_tip(seen, wire)) < 0.3
    assert seen.point_mm == 0.0


def test_far_in_the_corridor_and_across_a_bone_edge():
    image = drawn(WIRE, seed=5, background=0.65 + 0.35 * np.tanh((U + 0.4 * V - 320) / 3))
    seen = find_wire(image, expected(WIRE, aside_mm=7.0, turned_rad=0.06), 2.5)
    assert np.sqrt((off_line(seen, WIRE) ** 2).mean()) < 0.15
    assert abs(at_tip(seen, WIRE)) < 1.0


def band_across(wire: Drawn, first_mm: float, last_mm: float) -> np.ndarray:
    """Return a band (4, 2), px, across a wire, from and to these lengths behind its tip."""
    corners = [(first_mm, -30.0), (first_mm, 30.0), (last_mm, 30.0), (last_mm, -30.0)]
    across = np.array([-wire.along[1], wire.along[0]])
    return np.array([wire.tip_px + PX_PER_MM * (b * across - a * wire.along) for a, b in corners])


def test_the_tip_of_a_drill_beyond_a_nail_has_the_scale_of_its_own_place():
    """With the width that the drill has before the nail, the tip lay 0.8 px short."""
    drill = Drawn((431.37, 321.62), 0.43, 4.0, 6.0, widening_per_mm=1.5e-3)
    nail = [band_across(drill, 10.0, 24.0)]
    seen = find_wire(clear(drill), expected(drill, aside_mm=1.0, length_mm=56.0), 4.0, covered_px=nail)
    assert abs(at_tip(seen, drill)) < 0.3


def test_a_bone_edge_beyond_the_tip_of_a_drill_is_not_part_of_its_background():
    """A window of three radii reached across the far cortex: the stated error was 1.1 px, and with a nail's drill the
    tip was refused."""
    drill = Drawn((391.37, 301.62), 0.43, 4.0, 6.0)
    beyond = (np.stack([U, V], axis=-1) - drill.tip_px) @ drill.along
    bone = 0.4 + 0.6 / (1 + np.exp((25.0 - beyond) / 2))
    image = drawn(drill, quanta=2e3, background=bone)
    seen = find_wire(image, expected(drill, aside_mm=1.0), 4.0)
    assert abs(at_tip(seen, drill)) < 0.3
    assert seen.tip_variance_px2 < 0.5**2


def detections(uv_px: np.ndarray, radius_px: np.ndarray) -> Detections:
    n = len(uv_px)
    return Detections(uv_px, radius_px, np.tile(0.01 * np.eye(2), (n, 1, 1)), ("ball",) * n, np.zeros(n), (SIZE, SIZE))


def test_beads_over_the_wire_are_left_out():
    beads = np.array([[250.0, 246.0], [330.0, 268.0], [200.0, 205.0]])
    radius = np.full(3, 8.0)
    background = np.ones((SIZE, SIZE))
    for (x, y), r in zip(beads, radius, strict=True):
        background[np.hypot(U - x, V - y) < r] = 0.4
    image = drawn(WIRE, seed=6, background=background)
    seen = find_wire(image, expected(WIRE), 2.5, detections(beads, radius))
    assert np.sqrt((off_line(seen, WIRE) ** 2).mean()) < 0.15
    assert (np.hypot(*(seen.uv_px[:, None] - beads).T) > 5.0).all()


def test_a_piece_is_held_against_the_others_not_against_itself():
    s, x = 30.0 * np.arange(9.0), np.random.default_rng(11).standard_normal(9)
    fits = [WireFit(np.array([offset]), np.zeros(0), np.zeros(0), 1.0, 1.0, True, np.zeros(0)) for offset in x]
    pieces = [_Piece(float(place), np.zeros(0), fit) for place, fit in zip(s, fits, strict=True)]
    for k, off in enumerate(_left_out_residuals(pieces)):
        others = np.polynomial.Polynomial.fit(np.delete(s, k), np.delete(x, k), BEND)
        assert off == pytest.approx(x[k] - others(s[k]), abs=1e-9)


def beside(aside_mm: float, turned_rad: float = 0.0, back_mm: float = 0.0) -> Drawn:
    """Return a wire beside WIRE: at its tip by `aside_mm`, rotated, and ending `back_mm` earlier."""
    away = aside_mm * ACROSS - back_mm * WIRE.along
    return Drawn(tuple(np.array(WIRE.tip_px) + PX_PER_MM * away), WIRE.turn_rad + turned_rad)


@pytest.mark.parametrize("aside_mm", [4.5])
def test_each_of_two_wires_is_found_by_its_own_plan(aside_mm):
    """A program that takes the darkest or the first line finds one of both twice."""
    other = beside(aside_mm, back_mm=4.0)
    image = drawn(WIRE, other)
    for own, rest in ((WIRE, other), (other, WIRE)):
        planned, also = expected(own, aside_mm=0.9), expected(rest, aside_mm=-0.3)
        seen = find_wire(image, planned, 2.5, others=[also])
        assert np.sqrt((off_line(seen, own) ** 2).mean()) < 0.1
        assert abs(at_tip(seen, own)) < 1.0


def test_a_wire_that_crosses_another_is_found_beside_the_crossing():
    other = beside(-20.0, turned_rad=-0.9)
    seen = find_wire(drawn(WIRE, other), expected(WIRE), 2.5, others=[expected(other)])
    assert np.abs(off_line(seen, WIRE)).max() < 0.3  # 0.04 mm
    assert seen.hidden > 0.1


def test_another_wires_line_is_not_the_planned_wire():
    image = drawn(beside(6.0))
    assert find_wire(image, expected(WIRE), 2.5) is not None  # unless the other wire is known
    with pytest.raises(WireRefusedError, match="may be the other"):
        find_wire(image, expected(WIRE), 2.5, others=[expected(beside(6.0))])
    with pytest.raises(WireRefusedError, match="may be the other"):  # halfway between both plans
        find_wire(image, expected(WIRE, aside_mm=3.0), 2.5, others=[expected(beside(6.0), aside_mm=3.0)])


@pytest.mark.parametrize("aside_mm", [0.3, 1.6])
def test_the_shadow_of_two_wires_is_not_that_of_one(aside_mm):
    """Their common shadow lies beside both."""
    other = beside(aside_mm)
    image = drawn(WIRE, other)
    with pytest.raises(WireRefusedError, match="lie over it"):
        find_wire(image, expected(WIRE), 2.5, others=[expected(other)])
    alone = drawn(WIRE)  # the other wire is planned there, but not in yet
    assert find_wire(alone, expected(WIRE), 2.5, others=[expected(other)]).hidden < 0.2


def ball(at_px: np.ndarray, radius_px: float) -> np.ndarray:
    """Return the light that a steel ball lets through."""
    return np.exp(-4 * np.sqrt(np.clip(1 - ((U - at_px[0]) ** 2 + (V - at_px[1]) ** 2) / radius_px**2, 0.0, None)))


def test_a_bead_over_the_tip_is_fitted_with_it():
    """Where the view expects it to a third of a pixel. Stated errors allow for images of bone."""
    rng, radius, squares = np.random.default_rng(41), 10.0, []
    for seed in range(3):
        along, across, *off = np.append(rng.uniform([-14.0, -8.0], [10.0, 8.0]), rng.normal(0.0, 0.3, 2))
        at = np.array(WIRE.tip_px) + along * WIRE.along + across * ACROSS
        known = replace(expected(WIRE), beads_px=np.array([[*(at + off), radius]]))
        seen = find_wire(drawn(WIRE, seed=seed, metal=ball(at, radius)), known, 2.5)
        squares.append(at_tip(seen, WIRE) ** 2 / seen.tip_variance_px2)
    assert max(squares) < 3.3**2
    assert np.mean(squares) < 1.8


def test_something_else_than_a_ball_over_the_tip_is_refused():
    """A disc with a hole; and nothing where the view expects a ball."""
    away = np.hypot(U - WIRE.tip_px[0], V - WIRE.tip_px[1])
    known = replace(expected(WIRE), beads_px=np.array([[*WIRE.tip_px, 10.0]]))
    for metal in (np.where((away < 10) & (away > 4), 0.2, 1.0), 1.0):
        with pytest.raises(WireRefusedError, match="tip is hidden"):
            find_wire(drawn(WIRE, metal=metal), known, 2.5)


@pytest.mark.parametrize(("along_px", "across_px"), [(-15.0, 12.0)])
def test_a_bead_that_touches_the_tip_is_left_out_where_the_view_knows_it(along_px, across_px):
    """Detection misses a bead that a wire touches. Unknown, it moved the tip by 5 px and more, with a small error."""
    at, radius = np.array(WIRE.tip_px) + along_px * WIRE.along + across_px * ACROSS, 9.0
    image = drawn(WIRE, metal=ball(at, radius))
    known = replace(expected(WIRE), beads_px=np.array([[*at, radius]]))
    seen = find_wire(image, known, 2.5)
    assert abs(at_tip(seen, WIRE)) < 1.2  # three standard deviations
    assert seen.tip_variance_px2 < 0.5**2
    with pytest.raises(WireRefusedError, match="tip is hidden"):
        find_wire(image, expected(WIRE), 2.5)


def bone_across_the_tip() -> np.ndarray:
    off = (np.stack([U, V], axis=-1) - WIRE.tip_px) @ (0.8 * WIRE.along + 0.6 * ACROSS)
    return 0.55 + 0.45 / (1 + np.exp(3 - np.abs(off) / 2))


THROUGH = Drawn((WIRE.tip_px[0] + 200.0, WIRE.tip_px[1] + 92.0), WIRE.turn_rad)
OVER_TIP = detections(np.array([WIRE.tip_px]), np.array([30.0]))
METAL = np.where(np.hypot(U - 270, V - 250) < 160, 0.02, 1.0)
REFUSED = {
    "no wire": (drawn, PLANNED, {}, "no wire is seen"),
    "beyond the corridor": (lambda: drawn(WIRE), expected(WIRE, aside_mm=16.0), {}, "no wire is seen"),
    "a plan elsewhere": (
        lambda: drawn(WIRE),
        replace(PLANNED, uv_px=PLANNED.uv_px + 2e3),
        {},
        "outside the image's field",
    ),
    "two wires": (lambda: drawn(WIRE, beside(5.0)), expected(WIRE, aside_mm=2.5), {}, "compete"),
    "a third line": (
        lambda: drawn(WIRE, beside(6.0), beside(-5.0)),
        PLANNED,
        {"others": [expected(beside(6.0))]},
        "compete",
    ),
    "metal": (lambda: drawn(WIRE, metal=METAL), PLANNED, {}, "too faint"),
    "a bead over the tip": (lambda: drawn(WIRE), PLANNED, {"beads": OVER_TIP}, "tip is hidden"),
    "bone across the tip": (lambda: drawn(WIRE, background=bone_across_the_tip()), PLANNED, {}, "tip is hidden"),
    "a tip outside the field": (lambda: drawn(THROUGH), PLANNED, {}, "does not end"),
    "a thicker rod": (lambda: drawn(Drawn(WIRE.tip_px, 0.43, 4.5)), PLANNED, {}, "only 1 piece"),
    "end on": (lambda: drawn(WIRE), replace(PLANNED, sine=0.1 * PLANNED.sine), {}, "end on"),
}


@pytest.mark.parametrize("why", REFUSED)
def test_what_does_not_show_the_planned_wire_alone_is_refused(why):
    image, planned, given, words = REFUSED[why]
    with pytest.raises(WireRefusedError, match=words):
        find_wire(image(), planned, 2.5, **given)


@pytest.mark.parametrize(
    ("planned", "diameter_mm"),
    [
        (PLANNED, 0.0),
        (replace(PLANNED, along_mm=PLANNED.along_mm[::-1]), 2.5),
        (replace(PLANNED, uv_px=PLANNED.uv_px[:5]), 2.5),
    ],
)
def test_what_cannot_be_a_wire_is_unusable(planned, diameter_mm):
    with pytest.raises(UnusableInputError):
        find_wire(drawn(WIRE), planned, diameter_mm)
