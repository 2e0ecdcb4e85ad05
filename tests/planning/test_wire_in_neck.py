"""The wire inside the neck: its distance from the surface that the drawn borders touch, on a neck of known form."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sightline.errors import UnusableInputError
from sightline.planning import Aids, Anatomy, Circle, Line, Metric, Pick, locate
from sightline.planning.bone.drawings import _from_ellipse
from sightline.planning.bone.metrics import metric
from sightline.planning.procedures.procedure import copy_text, document_from_json

from . import bone
from .standin import StandInView

RADIUS_MM, PLACES_MM = 15.6, (-9.0, 8.0)
VIEWS = bone.views()
ACROSS = np.linalg.svd(bone.NECK[None])[2][1:]


def neck_borders(view: StandInView, turned: bool = False) -> tuple[Line, Line]:
    """Both borders of a round neck: lines that touch it, with clicks at other places of each."""
    on = bone.ON_NECK_MM + np.array(PLACES_MM)[:, None] * bone.NECK
    ray = on - view.focal_point_mm
    distance = np.linalg.norm(np.cross(ray, bone.NECK), axis=1)
    sideways = np.cross(ray, bone.NECK) / distance[:, None]
    back = np.cross(bone.NECK, sideways)
    back *= -np.sign((back * ray).sum(axis=1, keepdims=True))  # towards the X-ray source
    sine = RADIUS_MM / distance[:, None]
    touched = [on + RADIUS_MM * (way * np.sqrt(1 - sine**2) * sideways + sine * back) for way in (1.0, -1.0)]
    first, second = (view.project(points) for points in touched)
    return Line(first), Line(second[::-1] if turned else second)


def _wire(beside_mm: tuple[float, float], turned_rad: float = 0.0) -> np.ndarray:
    """A wire (2, 3) so far beside the neck's axis along both directions of ACROSS, and at an angle to it."""
    along = np.cos(turned_rad) * bone.NECK + np.sin(turned_rad) * ACROSS[0]
    return bone.ON_NECK_MM + np.array(beside_mm) @ ACROSS + np.array([-41.0, 44.0])[:, None] * along


def _found(wire_mm: np.ndarray, sd_px: float = 0.5, turned: bool = False) -> Anatomy:
    outline = tuple(tuple(replace(line, sd_px=sd_px) for line in neck_borders(view, turned)) for view in VIEWS)
    picks = [[Pick.free(view.project(point[None])[0], sd_px) for view in VIEWS] for point in wire_mm]
    return locate(VIEWS, Aids(outline=(outline[0], outline[1])), picks)


def _measured(wire_mm: np.ndarray, **drawn: float) -> Metric:
    return metric(_found(wire_mm, **drawn), "wire in neck", "right")


def _true_mm(wire_mm: np.ndarray) -> float:
    """Least distance of the wire's axis from the cylinder's surface, between the clicks."""
    points = wire_mm[0] + np.linspace(0.0, 1.0, 2001)[:, None] * (wire_mm[1] - wire_mm[0])
    off = points - bone.ON_NECK_MM
    along = off @ bone.NECK
    inside = (along >= PLACES_MM[0]) & (along <= PLACES_MM[1])
    return float((RADIUS_MM - np.linalg.norm(off - along[:, None] * bone.NECK, axis=1))[inside].min())


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    ("beside_mm", "angle_rad"), [((0.0, 0.0), 0.0), ((4.3, 0.0), 0.0), ((-2.1, 7.7), 0.05), ((8.0, 8.0), -0.08)]
)
def test_the_distance_is_that_from_the_surface(beside_mm: tuple[float, float], angle_rad: float, turned: bool):
    """0.02 mm: the distance is taken at five places of the wire; the borders' planes are not parallel."""
    wire = _wire(beside_mm, angle_rad)
    made = _measured(wire, turned=turned)
    assert made.value == pytest.approx(_true_mm(wire), abs=0.02)


def test_a_wire_outside_the_neck_has_a_negative_distance_though_each_view_shows_it_inside():
    """Beside the axis by 12 mm in both directions it lies within all four borders, and 1.4 mm outside the bone."""
    wire = _wire((12.0, 12.0))
    assert -1.4 < _true_mm(wire) < -1.3
    assert _measured(wire).value == pytest.approx(_true_mm(wire), abs=0.02)


def test_its_error_is_that_of_the_clicks():
    rng, sd_px, wire = np.random.default_rng(6), 1.0, _wire((3.2, -2.3))
    stated = _measured(wire, sd_px=sd_px)
    values = []
    for _ in range(40):
        outline = tuple(
            tuple(Line(line.uv_px + rng.normal(0.0, sd_px, (2, 2)), sd_px) for line in neck_borders(view))
            for view in VIEWS
        )
        picks = [
            [Pick.free(view.project(point[None])[0] + rng.normal(0.0, sd_px, 2), sd_px) for view in VIEWS]
            for point in wire
        ]
        found = locate(VIEWS, Aids(outline=(outline[0], outline[1])), picks)
        values.append(metric(found, "wire in neck", "right").value)
    # The views' own errors, 0.05 px of beads, are fixed here and small; 40 draws: 1 ± 0.11.
    assert stated.sd is not None and 0.7 < np.std(values) / stated.sd < 1.3


def test_an_oval_neck_is_not_taken_for_wider_than_it_is():
    """Seen in directions at 70° to each other; the axes of its section lie at 35° and -55° to the first of them."""
    angle, semi = np.deg2rad(35.0), np.array([17.5, 11.0])
    axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    matrix = axes.T @ np.diag(semi**2) @ axes
    turns = np.linspace(0.0, 2 * np.pi, 2000)
    surface = (semi * np.stack([np.cos(turns), np.sin(turns)], axis=1)) @ axes
    seen = np.deg2rad([0.0, 70.0])
    ways = np.stack([np.cos(seen), np.sin(seen)], axis=1)
    half = np.sqrt(np.einsum("ki,ij,kj->k", ways, matrix, ways))
    for point in np.array([[0.0, 0.0], [3.3, -1.7], [-6.1, -4.4], [2.0, 6.9]]):
        given = [np.array([[value]]) for value in ways @ point]
        bound = _from_ellipse((given[0], given[1]), (half[:1, None], half[1:, None]), np.cos(seen[1:, None]), "neck")
        # Two widths do not tell an ellipse: it may be rounder than this one, at most as its shorter width is.
        assert bound[0] <= half.min()
        assert bound[0] < np.linalg.norm(surface - point, axis=1).min() + (half.min() - semi.min())


def test_borders_drawn_at_different_places_are_refused():
    near = tuple(neck_borders(view) for view in VIEWS)
    away = VIEWS[1].project(bone.ON_NECK_MM + np.array([24.0, 33.0])[:, None] * bone.NECK)
    shifted = (Line(away + np.array([0.0, 60.0])), Line(away - np.array([0.0, 60.0])))
    wire = _wire((0.0, 0.0))
    picks = [[Pick.free(view.project(point[None])[0]) for view in VIEWS] for point in wire]
    made = metric(locate(VIEWS, Aids(outline=(near[0], shifted)), picks), "wire in neck", "right")
    assert made.value is None and "no common part" in made.sentence


def test_a_drawn_outline_changes_no_other_part_and_comes_back_from_a_case():
    from sightline.case.canonical import plain

    outline = (neck_borders(VIEWS[0]), neck_borders(VIEWS[1]))
    uv = bone.pixels(VIEWS)
    without, drawn = bone.aids(uv), replace(bone.aids(uv), outline=outline)
    one, other = (locate(VIEWS, aids, bone.picks(uv)) for aids in (without, drawn))
    for name in one.at:
        assert np.array_equal(one.part(name), other.part(name))
    back = Aids.of(json.loads(json.dumps(plain(drawn))))
    assert back.outline is not None and np.array_equal(back.outline[1][0].uv_px, outline[1][0].uv_px)
    old = plain(without)
    del old["outline"]  # as earlier versions wrote it
    assert Aids.of(old).outline is None and isinstance(without.head, tuple) and isinstance(without.head[0], Circle)


def test_a_file_must_ask_for_the_room_that_its_implant_needs():
    given = json.loads(copy_text("cannulated-hip-screws", "mine"))
    (rule,) = (one for one in given["checks"] if one["check"] == "wire in neck")
    assert rule["low"] == given["corridor"]["implant_mm"] / 2 + given["corridor"]["margin_mm"]
    rule["low"] -= 0.5
    with pytest.raises(UnusableInputError, match=r"'wire in neck' from 6.15 mm, less than .* 6.65 mm; raise it"):
        document_from_json(json.dumps(given))
