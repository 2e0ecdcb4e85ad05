"""Hole of a nail from its edges, against a simulator that shares nothing with the estimator."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.scenes.nails import Sight, seen
from scipy.spatial.transform import Rotation

from sightline.calibration import view_from_matrix
from sightline.errors import ErrorUnknownError, ReconstructionRefusedError
from sightline.planning import Edge, Hole, HoleSeen, Nail, fit_hole
from sightline.planning.nail.hole import farthest_apart
from sightline.twin.anatomy.nailed_femur import DistalNail
from sightline.twin.xray.distributions import beam_at

SMALL = np.eye(12) * 1e-16  # a matrix with hardly an error
ORBITS, TRIALS = (-16.0, 16.0), 25
TURN_RAD, SHIFT_MM = 1e-4, 0.05  # s.d. of a view's pose
NAIL = DistalNail(np.array([3.2, -4.1, 5.3]), np.array([0.0, 1.0, 0.0]), beam_at(0.03), bend=0.02, bend_angle=0.7)


def camera_matrix(orbit_deg: float, twist: np.ndarray | None = None) -> np.ndarray:
    """(3, 4): a camera 620 mm from the origin, after a small movement of what it sees."""
    beam = beam_at(np.deg2rad(orbit_deg))
    axes = np.stack([np.cross([0.0, 1.0, 0.0], beam), [0.0, 1.0, 0.0], beam])
    inner = np.array([[5000.0, 0.0, 511.5], [0.0, 5000.0, 511.5], [0.0, 0.0, 1.0]])
    out = inner @ np.column_stack([axes, 620.0 * axes @ beam])
    if twist is None:
        return out
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = Rotation.from_rotvec(twist[:3]).as_matrix(), twist[3:]
    return out @ move


def _sights(orbits_deg=ORBITS) -> dict[str, Sight]:
    views = [view_from_matrix(camera_matrix(angle)) for angle in orbits_deg]
    return {f"{k}": Sight(view.focal_point_mm, view.project) for k, view in enumerate(views)}


def _views(orbits_deg=ORBITS):
    return [view_from_matrix(camera_matrix(angle), SMALL, f"{k}") for k, angle in enumerate(orbits_deg)]


def _known(nail: DistalNail = NAIL) -> Nail:
    return Nail(nail.diameter_mm, nail.hole_diameter_mm, nail.bore_mm)


def _off(hole: Hole, nail: DistalNail = NAIL, which: int = 0) -> tuple[float, float]:
    """Distance of the axis from the true one, mm, and angle, °."""
    point, axis = nail.holes[which]
    angle = np.linalg.norm(np.cross(hole.direction, axis))
    return float(np.linalg.norm(np.cross(hole.middle_mm - point, axis))), float(np.rad2deg(np.arcsin(angle)))


@pytest.mark.parametrize("which", [0, 1])
def test_exact_edges_give_the_exact_hole(which):
    edges = seen(np.random.default_rng(0), NAIL, _sights(), which, noise=0.0, lens=False)
    hole = fit_hole(_views(), edges, _known())
    off_mm, off_deg = _off(hole, which=which)
    assert off_mm < 2e-3  # the bend is a parabola here, an arc there
    assert off_deg < 0.02
    assert np.linalg.norm(hole.exit_mm - hole.entry_mm) == pytest.approx(11.0, abs=5e-3)
    assert hole.entry_mm[2] < hole.exit_mm[2]  # the sources are at negative z
    assert hole.passed
    assert (hole.kept == hole.given).all()


def _spoiled(edges: list[HoleSeen], share: float, by_px: float) -> list[HoleSeen]:
    """The edges with a share of the first view's entry rim moved, as by the edge of a screw."""
    first = edges[0].entry
    uv = first.uv_px.copy()
    uv[: round(share * len(uv))] += by_px
    return [replace(edges[0], entry=Edge(uv, first.variance_px2, first.common_px)), edges[1]]


@pytest.mark.parametrize("by_px", [3.0, 12.0])
def test_edges_of_something_else_are_left_out(by_px):
    edges = seen(np.random.default_rng(3), NAIL, _sights(), every=4)
    hole = fit_hole(_views(), _spoiled(edges, 0.3, by_px), _known())
    assert hole.kept[0, 2] < hole.given[0, 2]
    off_mm, off_deg = _off(hole)
    assert off_mm < 2 * hole.axis_error_95_mm
    assert np.deg2rad(off_deg) < 2 * hole.direction_error_95_rad


def test_one_rim_is_refused():
    edges = seen(np.random.default_rng(4), NAIL, _sights())
    none = Edge(np.zeros((0, 2)), np.zeros(0))
    with pytest.raises(ReconstructionRefusedError, match="exit rim"):
        fit_hole(_views(), [replace(one, exit=none) for one in edges], _known())
    with pytest.raises(ReconstructionRefusedError, match="view '1' shows 0 points"):
        fit_hole(_views(), [edges[0], replace(edges[1], entry=none, exit=none)], _known())


@pytest.mark.parametrize(
    ("told", "what"),
    [
        (Nail(11.0, 4.5), "hole's diameter"),
        (Nail(11.0, 5.5), "hole's diameter"),
        (Nail(10.0, 5.0), "nail's diameter"),
        (Nail(12.0, 5.0), "nail's diameter"),
    ],
)
def test_a_hole_of_another_nail_is_refused(told, what):
    edges = seen(np.random.default_rng(6), NAIL, _sights(), every=4)
    with pytest.raises(ReconstructionRefusedError, match=what):
        fit_hole(_views(), edges, told)


def test_a_nail_bent_beyond_the_model_is_refused():
    bent = replace(NAIL, bend=0.25)
    with pytest.raises(ReconstructionRefusedError, match="bent"):
        fit_hole(_views(), seen(np.random.default_rng(7), bent, _sights()), _known())


def test_views_close_together_are_refused():
    near = (-9.5, 9.5)
    with pytest.raises(ReconstructionRefusedError, match="19° apart"):
        fit_hole(_views(near), seen(np.random.default_rng(8), NAIL, _sights(near)), _known())
    apart = (-10.5, 10.5)
    assert fit_hole(_views(apart), seen(np.random.default_rng(8), NAIL, _sights(apart)), _known()).passed


def test_an_unknown_error_is_refused():
    views = [view_from_matrix(camera_matrix(angle), None, f"{k}") for k, angle in enumerate(ORBITS)]
    with pytest.raises(ErrorUnknownError):
        fit_hole(views, seen(np.random.default_rng(9), NAIL, _sights()), _known())


def test_a_movement_between_the_images_fails_the_check():
    edges = seen(np.random.default_rng(10), NAIL, _sights())
    shifted = view_from_matrix(camera_matrix(16.0, np.array([0.0, 0.0, 0.0, 0.0, 1.5, 0.0])), SMALL, "1")
    hole = fit_hole([_views()[0], shifted], edges, _known())
    assert {check.name for check in hole.checks if not check.passed} & {"hole agreement", "hole rims used"}


def test_the_two_beams_farthest_apart_are_taken() -> None:
    """Of lines: opposite beams see the same."""
    angles = np.deg2rad([0.0, 66.0, 88.0, 178.0])
    beams = np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1)
    assert farthest_apart(beams[:3]) == (0, 2)
    assert farthest_apart(beams) == (2, 3)
    with pytest.raises(ReconstructionRefusedError):
        farthest_apart(beams[[0, 3]])
